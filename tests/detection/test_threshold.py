from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.detection.sites import site_pixels
from labseq.detection.threshold import BlindDetector, ThresholdDetector, ThresholdSettings
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


def test_counts_at_the_threshold_are_no_atom_and_no_confidence() -> None:
    occupancy, confidence, *_ = detector().detect(frame(checkerboard(), counts=50))
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
    square, *_ = detector(shape="square").detect(frame(checkerboard()))
    disc, *_ = detector(shape="disc").detect(frame(checkerboard()))
    assert square.any()
    assert not disc.any()


def test_saturated_regions_do_not_overflow() -> None:
    image = np.full((60, 90), 65535, np.uint16)
    assert detector(region=9).detect(Frame(image, 45e-3, 0.0))[0].all()


@pytest.mark.parametrize("shape", [(1, 1), (64, 48)])
def test_it_sees_nothing_on_any_frame(shape: tuple[int, int]) -> None:
    detector = BlindDetector(None, Context("detector", SiteGrid(3, 4)))
    occupancy, confidence, *_ = detector.detect(Frame(np.full(shape, 65535, np.uint16), 0.1, 0.0, "camera"))
    assert (occupancy.shape, occupancy.dtype, occupancy.any()) == ((3, 4), np.bool_, False)
    assert (confidence.shape, confidence.dtype, confidence.any()) == ((3, 4), np.float32, False)
