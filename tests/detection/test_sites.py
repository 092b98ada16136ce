from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.detection.sites import (
    known_sites,
    read_sites,
    region_corners,
    site_pixels,
)
from labseq.detection.spots import spot_light
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings, pairs_within
from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.model import CalibrationEntry, Frame, SiteGrid
from labseq.roles import Context, ReportsSignals
from labseq.testing.fakes import fake_calibration

PIXEL_M = 0.35e-6


def test_neighbours_are_one_spacing_apart() -> None:
    pixels = site_pixels(SiteGrid(), PIXEL_M, (255.5, 255.5))
    along_row = np.linalg.norm(np.diff(pixels, axis=1), axis=-1)
    down_column = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    np.testing.assert_allclose(along_row, 4.49 / 0.35)
    np.testing.assert_allclose(down_column, 4.49 / 0.35)


def test_row_0_is_at_the_top_and_lower_rows_shift_with_the_shear() -> None:
    right = site_pixels(SiteGrid(shear=1), PIXEL_M, (0.0, 0.0))
    left = site_pixels(SiteGrid(shear=-1), PIXEL_M, (0.0, 0.0))
    assert (np.diff(right[..., 0], axis=0) > 0).all()
    assert (np.diff(right[..., 1], axis=0) > 0).all()
    assert (np.diff(left[..., 1], axis=0) < 0).all()
    assert (np.diff(right[..., 1], axis=1) > 0).all()


def test_the_grid_turns_clockwise_about_its_centre() -> None:
    grid = SiteGrid(1, 3, spacing_m=1e-6)
    turned = site_pixels(grid, 1e-6, (10.0, 20.0), math.pi / 2)
    np.testing.assert_allclose(turned[0], [[9.0, 20.0], [10.0, 20.0], [11.0, 20.0]])


POINTS = st.tuples(st.floats(-3, 13), st.floats(-3, 13))


@given(POINTS, st.floats(0.2, 3.0))
def test_the_light_is_that_of_photons_drawn_one_by_one(place: tuple[float, float], width: float) -> None:
    rng = np.random.default_rng(0)
    y, x = np.rint(rng.normal(place, width, (20_000, 2))).astype(int).T
    inside = (y >= 0) & (y < 11) & (x >= 0) & (x < 11)
    drawn = np.bincount(y[inside] * 11 + x[inside], minlength=121).reshape(11, 11) / 20_000
    (light,) = spot_light(np.array([place]), np.zeros((1, 2), np.int64), 11, width)
    assert np.abs(light - drawn).max() < 5 * np.sqrt(0.25 / 20_000)


@given(st.lists(POINTS, max_size=30), st.floats(0.1, 10))
def test_pairs_are_those_of_all_distances(places: list[tuple[float, float]], distance: float) -> None:
    points = np.array(places).reshape(-1, 2)
    gaps = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=-1))
    near = gaps <= distance
    np.fill_diagonal(near, False)
    assert pairs_within(points, distance).tolist() == np.argwhere(near).tolist()


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
    sources = [detector.describe()["sites"] for detector in (by_geometry, by_entry, by_file)]
    assert sources[0] == "the detector's settings"
    assert entry.id in sources[1]
    assert "sites.npy" in sources[2]


@MAKERS
def test_atoms_are_found_at_calibrated_sites(make: Maker) -> None:
    atoms = np.eye(3, 4, dtype=np.bool_)
    y, x = np.indices((64, 96))
    image = np.full((64, 96), 522.0)
    for place_y, place_x in PLACES[atoms]:
        image += 400 * np.exp(-((y - place_y) ** 2 + (x - place_x) ** 2) / (2 * 1.2**2))
    occupancy, *_ = make(calibrated_sites()).detect(Frame(image.astype(np.uint16), 0.045, 0.0))
    np.testing.assert_array_equal(occupancy, atoms)


@MAKERS
def test_a_region_over_the_edge_names_the_calibration(make: Maker) -> None:
    entry = calibrated_sites(frame=(40, 96))
    with pytest.raises(LimitError, match=rf"calibration of sites {entry.id}.*40 x 96"):
        make(entry)


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


def test_the_places_cannot_be_changed_afterwards() -> None:
    known = known_sites(ThresholdSettings(**SMALL), context(calibrated_sites()))
    with pytest.raises(ValueError, match="read-only"):
        known.positions_px[0, 0] = 0.0


def as_table(places: Floats) -> str:
    lines = [f"{row},{col},{places[row, col, 0]!s},{places[row, col, 1]!s}" for row, col in np.ndindex(3, 4)]
    return "\n".join(["row,col,y,x", *lines]) + "\n"


@settings(max_examples=20)
@given(st.permutations(range(12)))
def test_a_table_is_read_in_any_order_of_lines(
    tmp_path_factory: pytest.TempPathFactory, order: list[int]
) -> None:
    head, *lines = as_table(PLACES).splitlines()
    path = tmp_path_factory.mktemp("sites") / "sites.csv"
    path.write_text("\n".join([head, *(lines[k] for k in order)]))
    np.testing.assert_array_equal(read_sites(path, (3, 4)), PLACES)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("row,col,y\n0,0,1\n", "no column 'x'"),
        (as_table(PLACES).replace("0,1,", "0,0,"), r"line 3 has site \(0, 0\), like an earlier line"),
        (as_table(PLACES) + "3,0,1,1\n", r"line 14 has site \(3, 0\), which the grid does not have"),
        ("\n".join(as_table(PLACES).splitlines()[:-2]), r"2 sites are missing, such as \(2, 2\)"),
        ("row,col,y,x\n0,0,1\n", "line 2 does not have four numbers"),
        ("row,col,y,x\n0,0,one,2\n", "line 2 does not have four numbers"),
        (as_table(np.where(PLACES[1, 1] == PLACES, np.inf, PLACES)), "not all finite"),
    ],
)
def test_mistakes_in_a_table_name_the_line(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "sites.csv").write_text(text)
    with pytest.raises(ConfigError, match=rf"sites\.csv.*{reason}"):
        read_sites(tmp_path / "sites.csv", (3, 4))


@MAKERS
@pytest.mark.parametrize("setting", ["sites", "threshold"])
def test_files_that_cannot_be_read_are_named(make: Maker, setting: str, tmp_path: Path) -> None:
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    (tmp_path / "text.npy").write_text("row")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with suppress(OSError):  # Windows needs rights for it
        (tmp_path / "zero.npy").symlink_to("/dev/zero")
    header = {"descr": "<f8", "fortran_order": False, "shape": (2**57,)}
    with (tmp_path / "huge.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    with (tmp_path / "long.csv").open("wb") as file:
        file.truncate(1 << 40)
    for name in ("objects.npy", "text.npy", "bytes.csv", "none.npy", "zero.npy", "huge.npy", "long.csv"):
        with pytest.raises(ConfigError, match=name):
            make(**{setting: tmp_path / name})


@MAKERS
def test_each_site_can_have_its_own_threshold(make: Maker, tmp_path: Path) -> None:
    frame = Frame(np.random.default_rng(2).integers(480, 700, (60, 90), np.uint16), 0.045, 0.0)
    signals = make().signals(frame)
    thresholds = signals + np.where(np.eye(3, 4), 1.0, -1.0)
    np.save(tmp_path / "thresholds.npy", thresholds)
    for given_ in (thresholds.tolist(), str(tmp_path / "thresholds.npy")):
        np.testing.assert_array_equal(make(threshold=given_).detect(frame)[0], thresholds < signals)
    entry = calibrated_thresholds(float(signals.min()) - 1.0)
    detector = make(entry, threshold=thresholds.tolist())
    assert detector.detect(frame)[0].all()
    assert entry.id in detector.describe()["thresholds"]


@MAKERS
def test_thresholds_are_one_finite_number_for_each_site(make: Maker, tmp_path: Path) -> None:
    np.save(tmp_path / "nan.npy", np.full((3, 4), np.nan))
    for threshold in ([[1.0, 2.0]], [[1.0], [2.0, 3.0]], str(tmp_path / "nan.npy")):
        with pytest.raises(LimitError, match="one finite number for each of 3 x 4 sites"):
            make(threshold=threshold)


@MAKERS
def test_a_frame_of_another_size_names_both_sizes_and_the_calibration(make: Maker) -> None:
    entry = calibrated_sites()
    with pytest.raises(DeviceError, match=rf"uint16 \(60, 90\).*calibration of sites {entry.id}.*\(64, 96\)"):
        make(entry).detect(Frame(np.zeros((60, 90), np.uint16), 0.045, 0.0))


@given(
    y=st.floats(-20, 80), x=st.floats(-20, 110), angle=st.floats(-0.3, 0.3), region=st.sampled_from([1, 5])
)
def test_squares_are_centred_on_the_sites_within_the_frame_or_refused(
    y: float, x: float, angle: float, region: int
) -> None:
    places = ThresholdSettings(frame=(60, 90), centre_px=(y, x), angle=angle, region=region)
    known = known_sites(places, context())
    try:
        corners = region_corners(known, region)
    except LimitError:
        assert (np.rint(known.positions_px) - region // 2 < 0).any() or (
            np.rint(known.positions_px) + region // 2 >= (60, 90)
        ).any()
        return
    assert (corners >= 0).all()
    assert (corners + region <= (60, 90)).all()
    assert np.abs(corners + region // 2 - known.positions_px.reshape(-1, 2)).max() <= 0.5


def test_a_square_over_the_edge_names_its_rows_and_columns() -> None:
    places = ThresholdSettings(frame=(20, 20), centre_px=(1.0, 10.0))
    known = known_sites(places, Context("detector", SiteGrid(1, 1)))
    with pytest.raises(LimitError, match=r"site \(0, 0\).*rows -1 to 3 and columns 8 to 12"):
        region_corners(known, places.region)
