"""Where the sites and thresholds come from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from labseq.detection.sites import known_sites, read_sites, site_pixels
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.model import CalibrationEntry, Frame, SiteGrid
from labseq.roles import Context, ReportsSignals
from labseq.testing.fakes import fake_calibration

Floats = NDArray[np.float64]
Maker = Callable[..., ThresholdDetector | WeightedDetector]

GRID = SiteGrid(3, 4)
PLACES = site_pixels(GRID, 0.35e-6, (31.2, 47.9), 0.05)
SMALL: dict[str, Any] = {"frame": (60, 90), "centre_px": (29.5, 44.5)}


def calibrated_sites(frame: tuple[int, int] = (64, 96)) -> CalibrationEntry:
    return fake_calibration("sites", GRID, values={"positions_px": PLACES, "frame": frame})


def calibrated_thresholds(value: float, **origin: Any) -> CalibrationEntry:
    thresholds = np.full((3, 4), value)
    return fake_calibration("thresholds", GRID, values={"thresholds": thresholds}, origin=origin)


def context(*entries: CalibrationEntry) -> Context:
    return Context("detector", GRID, calibrations={entry.kind: entry for entry in entries})


def threshold(*entries: CalibrationEntry, **settings: Any) -> ThresholdDetector:
    return ThresholdDetector(ThresholdSettings(**SMALL | settings), context(*entries))


def weighted(*entries: CalibrationEntry, **settings: Any) -> WeightedDetector:
    return WeightedDetector(WeightedSettings(**SMALL | settings), context(*entries))


MAKERS = pytest.mark.parametrize("make", [threshold, weighted])


def as_table(places: Floats) -> str:
    lines = [f"{row},{col},{y!r},{x!r}" for (row, col), (y, x) in each(places)]
    return "\n".join(["row,col,y,x", *lines]) + "\n"


def each(places: Floats) -> list[tuple[tuple[int, int], tuple[float, float]]]:
    n_rows, n_cols, _ = places.shape
    return [
        ((r, c), (float(places[r, c, 0]), float(places[r, c, 1])))
        for r in range(n_rows)
        for c in range(n_cols)
    ]


@MAKERS
def test_the_file_counts_before_the_calibration_and_that_before_the_geometry(
    make: Maker, tmp_path: Path
) -> None:
    moved = PLACES + 2.0
    np.save(tmp_path / "sites.npy", moved)
    entry = calibrated_sites()
    by_geometry, by_entry, by_file = make(), make(entry), make(entry, sites=tmp_path / "sites.npy")
    np.testing.assert_allclose(by_geometry.sites_px, site_pixels(GRID, 0.35e-6, (29.5, 44.5)))
    np.testing.assert_array_equal(by_entry.sites_px, PLACES)
    np.testing.assert_array_equal(by_file.sites_px, moved)
    told = [detector.describe()["sites"] for detector in (by_geometry, by_entry, by_file)]
    assert told[0] == "the detector's settings"
    assert entry.id in told[1]
    assert "sites.npy" in told[2]


@MAKERS
def test_atoms_are_found_at_calibrated_sites(make: Maker) -> None:
    atoms = np.eye(3, 4, dtype=np.bool_)
    y, x = np.indices((64, 96))
    image = np.full((64, 96), 522.0)
    for place_y, place_x in PLACES[atoms]:
        image += 400 * np.exp(-((y - place_y) ** 2 + (x - place_x) ** 2) / (2 * 1.2**2))
    occupancy, _ = make(calibrated_sites()).detect(Frame(image.astype(np.uint16), 0.045, 0.0))
    np.testing.assert_array_equal(occupancy, atoms)


@MAKERS
def test_a_frame_of_another_size_names_the_calibration(make: Maker) -> None:
    entry = calibrated_sites()
    with pytest.raises(DeviceError, match=rf"calibration of sites {entry.id}.*\(64, 96\)"):
        make(entry).detect(Frame(np.zeros((60, 90), np.uint16), 0.045, 0.0))


@MAKERS
def test_a_region_over_the_edge_names_the_calibration(make: Maker) -> None:
    entry = calibrated_sites(frame=(40, 96))
    with pytest.raises(LimitError, match=rf"calibration of sites {entry.id}.*40 x 96"):
        make(entry)


@MAKERS
def test_calibrated_thresholds_count_before_those_of_the_settings(make: Maker) -> None:
    frame = Frame(np.full((60, 90), 520, np.uint16), 0.045, 0.0)
    signals = make().signals(frame)
    entry = calibrated_thresholds(float(signals.min()) - 1.0)
    detector = make(entry, threshold=float(signals.max()) + 1.0)
    assert detector.detect(frame)[0].all()
    assert entry.id in detector.describe()["thresholds"]
    assert not make(threshold=float(signals.max()) + 1.0).detect(frame)[0].any()


def test_thresholds_in_another_unit_are_refused() -> None:
    entry = calibrated_thresholds(3.0, unit="log-odds")
    weighted(entry)
    with pytest.raises(ConfigError, match=f"thresholds {entry.id} is in log-odds.* compares counts"):
        threshold(entry)


@MAKERS
def test_the_signals_are_what_is_compared(make: Maker) -> None:
    image = np.random.default_rng(1).integers(480, 700, (60, 90), np.uint16)
    detector, frame = make(), Frame(image, 0.045, 0.0)
    assert isinstance(detector, ReportsSignals)
    signals = detector.signals(frame)
    assert signals.dtype == np.float64
    cut = float(np.median(signals))
    np.testing.assert_array_equal(make(threshold=cut).detect(frame)[0], signals > cut)


@given(st.lists(st.floats(-1e3, 1e3), min_size=24, max_size=24), st.randoms(use_true_random=False))
def test_a_table_is_read_in_any_order_of_lines(
    tmp_path_factory: pytest.TempPathFactory, values: list[float], random: Any
) -> None:
    places = np.array(values).reshape(3, 4, 2)
    head, *lines = as_table(places).splitlines()
    random.shuffle(lines)
    path = tmp_path_factory.mktemp("sites") / "sites.csv"
    path.write_text("\n".join([head, *lines]))
    np.testing.assert_array_equal(read_sites(path, (3, 4)), places)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no column 'row'"),
        ("row,col,y\n0,0,1\n", "no column 'x'"),
        (as_table(PLACES).replace("0,1,", "0,0,"), r"line 3 is of site \(0, 0\), like an earlier line"),
        (as_table(PLACES) + "3,0,1,1\n", r"line 14 is of site \(3, 0\), which the grid does not have"),
        ("\n".join(as_table(PLACES).splitlines()[:-2]), r"2 sites are missing, \(2, 2\) among them"),
        ("row,col,y,x\n0,0,1\n", "line 2 does not have four numbers"),
        ("row,col,y,x\n0,0,one,2\n", "line 2 does not have four numbers"),
        (as_table(np.where(PLACES[1, 1] == PLACES, np.inf, PLACES)), "not all finite"),
    ],
)
def test_mistakes_in_a_table_are_told(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "sites.csv").write_text(text)
    with pytest.raises(ConfigError, match=rf"sites\.csv.*{reason}"):
        read_sites(tmp_path / "sites.csv", (3, 4))


def test_files_that_are_no_sites_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "other.npy", PLACES[1:])
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    (tmp_path / "text.npy").write_text("row")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    for name in ("other.npy", "objects.npy", "text.npy", "bytes.csv", "none.npy", "none.csv"):
        with pytest.raises(ConfigError, match=name):
            read_sites(tmp_path / name, (3, 4))


def test_the_places_cannot_be_changed_afterwards() -> None:
    known = known_sites(ThresholdSettings(**SMALL), context(calibrated_sites()))
    with pytest.raises(ValueError, match="read-only"):
        known.positions_px[0, 0] = 0.0
