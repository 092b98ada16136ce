"""The threshold detector."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from labseq.detection.sites import site_pixels
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.model import Frame, SiteGrid
from labseq.roles import Context
from labseq.testing import DetectorContract

GRID = SiteGrid(3, 4)
SMALL: dict[str, Any] = {"frame": (60, 90), "centre_px": (29.5, 44.5), "offset": 100.0, "threshold": 50.0}


class TestThresholdDetector(DetectorContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], ThresholdDetector]:
        return partial(ThresholdDetector, ThresholdSettings())


def detector(grid: SiteGrid = GRID, **settings: Any) -> ThresholdDetector:
    return ThresholdDetector(ThresholdSettings(**SMALL | settings), Context("detector", grid))


def frame(bright: NDArray[np.bool_], counts: int = 60) -> Frame:
    """A frame at the offset; bright sites have ``counts`` more in one corner of their 5 x 5 region."""
    image = np.full((60, 90), 100, np.uint16)
    for y, x in np.rint(site_pixels(GRID, 0.35e-6, (29.5, 44.5)))[bright].reshape(-1, 2).astype(int):
        image[y - 2, x + 2] += counts
    return Frame(image, 45e-3, 0.0)


def checkerboard() -> NDArray[np.bool_]:
    return np.indices((3, 4)).sum(axis=0) % 2 == 0


def nowhere() -> NDArray[np.bool_]:
    return np.zeros((3, 4), np.bool_)


def test_bright_sites_hold_atoms() -> None:
    occupancy, confidence = detector().detect(frame(checkerboard()))
    np.testing.assert_array_equal(occupancy, checkerboard())
    assert occupancy.dtype == np.bool_
    assert occupancy.flags.c_contiguous
    assert confidence.dtype == np.float32
    assert confidence.shape == (3, 4)


def test_counts_at_the_threshold_are_no_atom_and_no_confidence() -> None:
    occupancy, confidence = detector().detect(frame(checkerboard(), counts=50))
    assert not occupancy.any()
    assert (confidence[checkerboard()] == 0).all()


def test_confidence_grows_with_the_distance_up_to_1() -> None:
    means = [detector(width=10.0).detect(frame(checkerboard(), n))[1][0, 0] for n in (40, 50, 60, 80, 5000)]
    assert means[0] == pytest.approx(np.tanh(1))
    assert means[1] == 0
    assert means[2] == pytest.approx(np.tanh(1))
    assert means[2] < means[3] < means[4] == 1


def test_the_offset_counts_for_each_pixel_of_the_region() -> None:
    assert not detector(offset=100.0).detect(frame(nowhere()))[0].any()
    assert detector(offset=97.0).detect(frame(nowhere()))[0].all()  # 25 pixels, 3 counts each: 75 > 50


def test_a_disc_leaves_out_the_corners() -> None:
    square, _ = detector(shape="square").detect(frame(checkerboard()))
    disc, _ = detector(shape="disc").detect(frame(checkerboard()))
    assert square.any()
    assert not disc.any()


def test_each_site_can_have_its_own_threshold(tmp_path: Path) -> None:
    thresholds = np.where(checkerboard(), 50.0, 70.0)
    everywhere = np.ones((3, 4), np.bool_)
    path = tmp_path / "thresholds.npy"
    np.save(path, thresholds)
    inline = detector(threshold=thresholds.tolist())
    from_file = detector(threshold=str(path))
    for made in (inline, from_file):
        np.testing.assert_array_equal(made.detect(frame(everywhere))[0], checkerboard())


@pytest.mark.parametrize("threshold", [[[1.0, 2.0]], [[1.0], [2.0, 3.0]]])
def test_thresholds_of_another_grid_are_refused(threshold: list[list[float]]) -> None:
    with pytest.raises(LimitError, match="3 x 4 sites"):
        detector(threshold=threshold)


def test_thresholds_that_are_not_numbers_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "nan.npy", np.full((3, 4), np.nan))
    with pytest.raises(LimitError, match="not every value is finite"):
        detector(threshold=str(tmp_path / "nan.npy"))


@pytest.mark.parametrize("content", [None, b"", b"thresholds: 5", b"\x93NUMPY\x01\x00"])
def test_a_thresholds_file_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "thresholds.npy"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"thresholds\.npy"):
        detector(threshold=str(path))


def test_pickled_thresholds_are_not_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ConfigError, match=r"objects\.npy"):
        detector(threshold=str(tmp_path / "objects.npy"))


@pytest.mark.parametrize(
    "settings", [{"centre_px": (5.0, 44.5)}, {"frame": (60, 40)}, {"region": 41}, {"pixel_size": 0.2e-6}]
)
def test_a_region_over_the_edge_of_the_frame_names_the_site(settings: dict[str, Any]) -> None:
    with pytest.raises(LimitError, match=r"region of interest of site \(\d, \d\)"):
        detector(**settings)


def test_a_frame_of_another_size_names_both_sizes() -> None:
    with pytest.raises(DeviceError, match=r"uint16 \(90, 60\).*\(60, 90\)"):
        detector().detect(Frame(np.zeros((90, 60), np.uint16), 45e-3, 0.0))


def test_saturated_regions_do_not_overflow() -> None:
    image = np.full((60, 90), 65535, np.uint16)
    assert detector(region=9).detect(Frame(image, 45e-3, 0.0))[0].all()


@pytest.mark.parametrize(
    "settings",
    [{"region": 4}, {"region": 0}, {"pixel_size": 0.0}, {"width": 0.0}, {"shape": "hexagon"}, {"T": 1}],
)
def test_wrong_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        ThresholdSettings(**settings)
