"""The common shift of the sites on one frame."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.detection.drift import Shift, measure_shift
from labseq.model import SiteGrid

from .drawn import drawn, seen_sites

SITES = seen_sites(SiteGrid(), 12.8, 3.0, 1.05, barrel=0.02, centre=(250.0, 250.0))
SHAPE = (512, 512)
SHIFT = st.tuples(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4))


@cache
def frame_of(shift: tuple[float, float], seed: int, loading: float = 0.6, hot: int = 10) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = drawn(SITES + np.array(shift), SHAPE, 1.2, rng, n_frames=1, loading=loading, hot=hot)
    return image.clip(0, 65535).astype(np.uint16)


@settings(max_examples=6)
@given(SHIFT, st.integers(0, 2**32 - 1), st.floats(0.3, 1.0))
def test_a_shift_up_to_two_pixels_is_measured_to_its_error(
    shift: tuple[float, float], seed: int, loading: float
) -> None:
    dy, dx, error = measure_shift(frame_of(shift, seed, loading), SITES, 1.2)
    assert error < 0.05
    assert np.hypot(dy - shift[0], dx - shift[1]) < 6 * error


def test_the_mean_of_many_frames_is_the_shift_and_the_error_is_that_of_the_noise() -> None:
    """The scatter of 60 values is known to 9 %."""
    scatter = list[np.ndarray]()
    for shift in ((1.4, -1.4), (0.5, 2.0)):
        measured = np.array([measure_shift(frame_of(shift, seed), SITES, 1.2) for seed in range(15)])
        assert np.abs(measured[:, :2].mean(axis=0) - shift).max() < 0.025
        scatter.append((measured[:, :2] - np.array(shift)) / measured[:, 2:])
    assert 0.95 < np.sqrt((np.stack(scatter) ** 2).mean()) < 1.4


@pytest.mark.parametrize("width", [0.8, 1.8])
def test_a_width_that_is_off_makes_no_bias(width: float) -> None:
    measured = np.array([measure_shift(frame_of((1.0, -0.7), seed), SITES, width) for seed in range(8)])
    assert np.abs(measured[:, :2].mean(axis=0) - (1.0, -0.7)).max() < 0.05


def test_few_atoms_give_a_larger_error() -> None:
    few, many = (measure_shift(frame_of((0.3, 0.3), 1, loading, 0), SITES, 1.2) for loading in (0.1, 0.9))
    assert few.error > 2 * many.error


@pytest.mark.parametrize("counts", [0, 500, 65535])
def test_a_black_or_full_frame_says_nothing(counts: int) -> None:
    shift = measure_shift(np.full(SHAPE, counts, np.uint16), SITES, 1.2)
    assert shift == Shift(0.0, 0.0, float("inf"))


def test_dark_sites_alone_have_a_large_error() -> None:
    assert measure_shift(frame_of((0.0, 0.0), 2, loading=0.0, hot=0), SITES, 1.2).error > 0.05
