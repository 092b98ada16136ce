"""The kernels of rendering: phases, combs, groups, units."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import FrequencyCourse, SiteGrid
from labseq.motion import render_comb_kernels, render_direct_kernels, render_kernels
from labseq.motion.render_kernels import (
    END,
    END_AMPLITUDE,
    FINE,
    N_FIELDS,
    START,
    START_AMPLITUDE,
    SUM,
    take_tones,
)
from labseq.motion.rendering import comb_sample_rate


@given(st.integers(-(2**31), 2**31 - 1))
def test_the_cosine_of_an_integer_phase_is_right_to_a_float32_digit(phase: int) -> None:
    cosine = render_direct_kernels.wave(phase, 0, 0, 0)
    assert cosine == pytest.approx(math.cos(2 * math.pi * phase / 2**32), abs=2.5e-7)


@pytest.mark.parametrize("kind", FrequencyCourse)
@given(u=st.floats(0, 1))
def test_courses_and_their_derivatives_belong_together(kind: FrequencyCourse, u: float) -> None:
    _, part, slope, bend = render_direct_kernels.course(kind, u)
    assert part == pytest.approx(kind.fraction(u), abs=1e-12)
    h = 1e-6
    before, after = (render_direct_kernels.course(kind, u + sign * h) for sign in (-1, 1))
    assert part == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-4)
    assert slope == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-4)
    assert bend == pytest.approx((after[2] - before[2]) / (2 * h), abs=1e-4)


@given(st.floats(0, 0.5), st.floats(-1e-6, 1e-6))
def test_a_chirp_is_filled_in_right(frequency: float, chirp: float) -> None:
    n = 300
    re, im = np.zeros((2, n + 2 * render_kernels.LANES), np.float32)
    render_kernels.fill_chirp(frequency, chirp, n, re, im, np.zeros((4, render_kernels.LANES + 1)))
    j = np.arange(n)
    expected = np.exp(2j * np.pi * (frequency * j + 0.5 * chirp * j**2))
    assert np.abs(re[:n] + 1j * im[:n] - expected).max() < 1e-7


def test_a_chirp_that_was_filled_in_is_found_again() -> None:
    chirps = np.zeros((render_kernels.N_CHIRPS, 2, 200), np.float32)
    keys = np.append(np.full(2 * render_kernels.N_CHIRPS, np.nan), 0.0)
    lanes = np.zeros((4, render_kernels.LANES + 1))
    found = [render_kernels.find_chirp(f, 1e-7, 100, chirps, keys, lanes) for f in (0.1, 0.2, 0.1, 0.3, 0.2)]
    assert found == [0, 1, 0, 2, 1]
    n = render_kernels.N_CHIRPS
    more = [render_kernels.find_chirp(0.1 + 0.01 * k, 0.0, 100, chirps, keys, lanes) for k in range(n)]
    assert more == [*range(3, n), 0, 1, 2]


@given(st.lists(st.floats(-40000, 40000, width=32), min_size=1, max_size=70))
def test_samples_are_rounded_to_the_nearest_integer_within_full_scale(values: list[float]) -> None:
    given = np.array(values, np.float32)
    out = np.zeros(len(given), np.int16)
    render_kernels.store(out, len(given), given, 0)
    assert out.tolist() == np.clip(np.rint(given), -32767, 32767).astype(int).tolist()


@given(st.floats(0, 1), st.floats(0.9, 1.1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_the_error_of_a_cubic_is_what_it_says(a: float, ratio: float, drift: float, bend: float) -> None:
    re, im = np.zeros((2, render_kernels.N_COEFFICIENTS))
    error = render_kernels.fit_cubic(a, a * ratio, drift, bend, re, im)
    u = np.linspace(0, 1, 200)
    amplitude = a * np.sqrt(1 + (ratio**2 - 1) * u)
    expected = amplitude * np.exp(2j * np.pi * (drift * u + bend * u**2))
    found = np.polynomial.polynomial.polyval(u, re + 1j * im)
    assert np.abs(found - expected).max() <= 1.3 * error + 1e-12


def test_a_moving_group_goes_on_over_many_blocks() -> None:
    n, block, frequency, chirp, x = 3000, 400, 0.1361, 1.2e-7, 0.37
    lanes, state = np.zeros((4, render_kernels.LANES + 1)), np.zeros(render_kernels.N_STATE)
    state[:2] = frequency, chirp
    j = np.arange(block)
    table = np.exp(2j * np.pi * (frequency * j + 0.5 * chirp * j**2))
    re, im = np.real(table).astype(np.float32), np.imag(table).astype(np.float32)
    acc, v = np.zeros(n, np.float32), np.zeros((2, 64), np.float32)
    render_comb_kernels.enter_block(state, lanes, x, float(block))
    render_comb_kernels.add_moving(
        acc, n, block, re, im, state, lanes[0], lanes[1], lanes[2], lanes[3], v[0], v[1]
    )
    at = np.arange(n) + x
    expected = np.cos(2 * np.pi * (frequency * at + 0.5 * chirp * at**2))
    assert np.abs(acc - expected).max() < 5e-7


def comb(n: int, start_hz: float, step_hz: float) -> NDArray[np.float64]:
    return (start_hz + step_hz * np.arange(n)).astype(np.float64)


def test_the_sample_rate_suits_both_axes() -> None:
    assert comb_sample_rate(SiteGrid()) == 624e6
    rows, columns = comb(5, 90e6, 1.5e6), comb(5, 90e6, 1.0e6)
    grid = SiteGrid(5, 5, row_frequency_hz=rows, column_frequency_hz=columns)
    assert comb_sample_rate(grid) == 624e6
    assert comb_sample_rate(SiteGrid(1, 1)) == 625e6
    rows = comb(5, 90e6, 1.6180339e6)
    with pytest.raises(LimitError, match=r"1618033\.9 Hz and 1000000 Hz"):
        comb_sample_rate(SiteGrid(5, 5, row_frequency_hz=rows, column_frequency_hz=columns))


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


def test_more_frequencies_than_a_comb_can_have() -> None:
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


RATE_HZ = 625e6
OFFSETS = np.array([0, 2, 2, 5], np.int32)


def take(**changes: tuple[int, float]) -> tuple[tuple[int, int], NDArray[np.float64]]:
    """Five tones, of which some values are changed: field -> (tone, value)."""
    names = ("start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad")
    fields = [np.full(5, value) for value in (90e6, 91e6, 0.3, 0.1, 2.0)]
    for name, (tone, value) in changes.items():
        fields[names.index(name)][tone] = value
    start_hz, end_hz, start, end, phase = fields
    tones = np.empty((N_FIELDS, 5))
    return take_tones(start_hz, end_hz, start, end, phase, OFFSETS, RATE_HZ, tones), tones


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("start_hz", -1.0, (START, 1)),
        ("end_hz", RATE_HZ / 2 + 1.0, (END, 1)),
        ("end_hz", RATE_HZ / 2, (FINE, -1)),
        ("start_amplitude", -0.1, (START_AMPLITUDE, 1)),
        ("end_amplitude", 1.1, (END_AMPLITUDE, 1)),
        ("start_amplitude", 0.8, (SUM, 0)),
        ("end_amplitude", 0.9 + render_kernels.ROUNDING / 2, (FINE, -1)),
        ("end_amplitude", 0.9 + 2 * render_kernels.ROUNDING, (SUM, 0)),
        ("phase_rad", -700.0, (FINE, -1)),
    ],
)
def test_limits_are_kept(name: str, value: float, fault: tuple[int, int]) -> None:
    assert take(**{name: (1, value)})[0] == fault
