from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from labseq.motion import render_comb_kernels

SPACING_HZ = 1.6e6


def spacing_of(tones_hz: NDArray[np.float64]) -> float:
    """The same by numpy, for a few tones."""
    gaps = np.diff(tones_hz)
    gaps = gaps[gaps > render_comb_kernels.TOLERANCE_HZ]
    apart = np.abs(gaps[:, None] - gaps[None, :]).ravel()
    candidates = np.unique(
        np.round(np.concatenate([gaps, apart[apart > render_comb_kernels.TOLERANCE_HZ]]), -1)
    )
    multiples = np.round(gaps[None, :] / candidates[:, None])
    fits = (np.abs(gaps[None, :] - multiples * candidates[:, None]) <= render_comb_kernels.TOLERANCE_HZ) & (
        multiples > 0
    )
    n_fitting = fits.sum(axis=1)
    best = int(np.flatnonzero(n_fitting == n_fitting.max())[-1])
    held = fits[best]
    return float(gaps[held].sum() / multiples[best, held].sum())


@given(st.lists(st.floats(80e6, 80e6 + 50), max_size=100))
def test_frequencies_are_collected_once_each_and_in_order(hz: list[float]) -> None:
    found = np.empty(render_comb_kernels.MAX_TONES, np.float64)
    n = render_comb_kernels.distinct_tones(np.array(hz), found)
    assert found[:n].tolist() == np.unique(np.round(hz)).tolist()


def test_more_frequencies_than_a_comb_can_have_are_told() -> None:
    hz = 1e6 + np.arange(render_comb_kernels.MAX_TONES + 1.0)
    assert (
        render_comb_kernels.distinct_tones(hz[:-1], np.empty(render_comb_kernels.MAX_TONES))
        == render_comb_kernels.MAX_TONES
    )
    assert render_comb_kernels.distinct_tones(hz, np.empty(render_comb_kernels.MAX_TONES)) == -1


@given(
    st.lists(st.integers(0, 40), min_size=2, max_size=20, unique=True),
    st.lists(st.floats(-1e5, 1e5), max_size=4),
    st.floats(-50, 50),
)
def test_the_spacing_is_what_numpy_finds(sites: list[int], strays: list[float], noise_hz: float) -> None:
    on_comb = 80e6 + SPACING_HZ * np.array(sites) + noise_hz * (np.array(sites) % 2)
    hz = np.unique(np.round(np.concatenate([on_comb, 120e6 + np.array(strays)])))
    assert render_comb_kernels.common_spacing(hz) == pytest.approx(spacing_of(hz), rel=1e-12)


@pytest.mark.parametrize(("sites", "steps"), [([0, 1, 2, 5], 1), ([0, 2, 5], 1), ([3, 7, 11], 4)])
def test_the_spacing_is_the_largest_that_suits(sites: list[int], steps: int) -> None:
    hz = 80e6 + SPACING_HZ * np.array(sites, np.float64)
    assert render_comb_kernels.common_spacing(hz) == steps * SPACING_HZ


def test_one_tone_has_no_spacing_and_too_many_have_none_in_common() -> None:
    assert render_comb_kernels.common_spacing(np.array([80e6])) == 0.0
    assert render_comb_kernels.common_spacing(np.array([80e6, 80e6 + 50])) == 0.0
    hz = 80e6 + SPACING_HZ * np.arange(render_comb_kernels.MAX_TEETH + 1, dtype=np.float64)
    assert render_comb_kernels.common_spacing(hz[:-1]) == SPACING_HZ
    assert render_comb_kernels.common_spacing(hz) == -1.0


@pytest.mark.parametrize(("numerator", "period"), [(1, 390), (2, 625), (0, 1), (7, 12)])
def test_teeth_turn_by_their_distance_from_the_first(numerator: int, period: int) -> None:
    angles = 2 * np.pi / period * np.arange(period)
    filled = np.empty((10, period))
    render_comb_kernels.fill_teeth(np.cos(angles), np.sin(angles), numerator, filled)
    turns = np.outer(np.arange(5), numerator / period * np.arange(period))
    assert np.allclose(filled[::2] + 1j * filled[1::2], np.exp(2j * np.pi * turns), atol=1e-11)
