"""The kernels of rendering: phases, combs, groups, units."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import FrequencyCourse, SiteGrid
from labseq.motion import (
    comb_kernels,
    render_comb_kernels,
    render_direct_kernels,
    render_group_kernels,
    render_kernels,
)
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


@given(st.floats(-0.5, 0.5), st.sampled_from([1, 2, 32, 128]))
def test_powers_of_a_wave(cycles: float, n: int) -> None:
    re, im = np.empty((2, n))
    following = complex(*render_comb_kernels.fill_powers(cycles, re, im))
    expected = np.exp(2j * np.pi * cycles * np.arange(n + 1))
    assert np.abs(np.append(re + 1j * im, following) - expected).max() < 1e-12


@given(st.floats(-1e-6, 1e-6))
def test_a_chirp_is_filled_in_right(chirp: float) -> None:
    n = 300
    re, im = np.zeros((2, n + 2 * render_kernels.LANES), np.float32)
    render_comb_kernels.fill_chirp(chirp, n, re, im, np.zeros((4, render_kernels.LANES)))
    expected = np.exp(1j * np.pi * chirp * np.arange(n) ** 2)
    assert np.abs(re[:n] + 1j * im[:n] - expected).max() < 1e-7


def test_a_chirp_that_was_filled_in_is_found_again() -> None:
    n, room = render_kernels.N_CHIRPS, render_kernels.STRIP + render_kernels.LANES
    chirps = np.zeros((n, 2, room), np.float32)
    keys = np.append(np.full(n, np.nan), 0.0)
    lanes = np.zeros((4, render_kernels.LANES))
    found = [render_comb_kernels.find_chirp(chirp * 1e-8, chirps, keys, lanes) for chirp in (1, 2, 1, 3, 2)]
    assert found == [0, 1, 0, 2, 1]
    more = [render_comb_kernels.find_chirp((4 + k) * 1e-8, chirps, keys, lanes) for k in range(n)]
    assert more == [*range(3, n), 0, 1, 2]


@given(st.floats(0, 1), st.floats(0, 1), st.integers(200, 900))
def test_an_envelope_is_that_of_a_depth_that_changes_evenly(start: float, end: float, n: int) -> None:
    values = np.ones(n + render_kernels.CHUNK, np.float32)
    render_kernels.apply_envelope(values, n, start, (end - start) / n)
    squares = start + (end - start) * np.arange(n) / n
    assert np.abs(values[:n] - np.sqrt(squares)).max() < 3e-7


@given(st.lists(st.floats(-40000, 40000, width=32), min_size=1, max_size=70))
def test_samples_are_rounded_to_the_nearest_integer_within_full_scale(values: list[float]) -> None:
    given = np.array(values, np.float32)
    out = np.zeros(len(given), np.int16)
    render_kernels.store(out, len(given), given, 0)
    assert out.tolist() == np.clip(np.rint(given), -32767, 32767).astype(int).tolist()


@given(st.floats(0, 1), st.floats(0.9, 1.1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_the_error_of_a_cubic_is_what_it_says(a: float, ratio: float, drift: float, bend: float) -> None:
    re, im = np.zeros((2, render_kernels.N_COEFFICIENTS))
    error = render_group_kernels.fit_cubic(a, a * ratio, drift, bend, re, im)
    u = np.linspace(0, 1, 200)
    amplitude = a * np.sqrt(1 + (ratio**2 - 1) * u)
    expected = amplitude * np.exp(2j * np.pi * (drift * u + bend * u**2))
    found = np.polynomial.polynomial.polyval(u, re + 1j * im)
    assert np.abs(found - expected).max() <= 1.3 * error + 1e-12


def test_a_moving_group_goes_on_over_many_periods() -> None:
    n, period, frequency, chirp = 3000, 390, 0.1361, 1.2e-7
    j = np.arange(n + render_kernels.CHUNK)
    table, bend = 2 * np.pi * frequency * j, np.pi * chirp * j**2
    waves = (np.cos(table), np.sin(table), np.cos(bend), np.sin(bend))
    re, im, bend_re, bend_im = (wave.astype(np.float32) for wave in waves)
    acc, by = np.zeros(len(j), np.float32), render_kernels.turn(frequency * period)
    render_comb_kernels.add_moving(acc, n, re, im, period, by, bend_re, bend_im)
    expected = np.cos(2 * np.pi * (frequency * j + 0.5 * chirp * j**2))
    assert np.abs(acc - expected)[:n].max() < 5e-7


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


def gaps_of(hz: NDArray[np.float64], times: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    gaps = np.diff(hz)
    return np.array([gaps, np.ones(len(gaps)) if times is None else times])


@given(st.lists(st.floats(80e6, 80e6 + 50), max_size=100))
def test_frequencies_are_collected_once_each_and_in_order(hz: list[float]) -> None:
    values = np.empty((2, comb_kernels.MAX_TONES))
    n = comb_kernels.count_tones(np.array(hz), values)
    distinct, counts = np.unique(np.round(hz), return_counts=True)
    assert values[:, :n].tolist() == [distinct.tolist(), counts.tolist()]


def test_more_frequencies_than_a_comb_can_have() -> None:
    hz, values = 1e6 + np.arange(comb_kernels.MAX_TONES + 1.0), np.empty((2, comb_kernels.MAX_TONES))
    assert comb_kernels.count_tones(hz[:-1], values) == comb_kernels.MAX_TONES
    assert comb_kernels.count_tones(hz, values) == -1


def test_gaps_are_those_between_neighbours_that_go_the_same_way() -> None:
    """In the first segment two tones go up, two wait; in the second there is one; in the third two."""
    start_mhz, end_mhz = (
        np.array([80, 81, 83.5, 84, 70, 90, 93.0]),
        np.array([81, 81, 84.5, 84, 70, 91, 94.0]),
    )
    values = np.empty((2, 5))
    offsets = np.array([0, 4, 5, 7], np.int32)
    n = comb_kernels.count_gaps(start_mhz * 1e6, end_mhz * 1e6, offsets, values)
    assert values[:, :n].tolist() == [[3e6, 3.5e6], [2, 1]]
    assert comb_kernels.count_gaps(start_mhz * 1e6, end_mhz * 1e6, offsets, values[:, :1].copy()) == 1


@given(st.lists(st.integers(1, 12), min_size=2, max_size=20), st.floats(-1, 1))
def test_the_spacing_is_the_largest_that_fits_enough_gaps(sites: list[int], noise_hz: float) -> None:
    """Gaps of one site, and of others, whose tones are a little off the comb."""
    sites = [*sites, 1]
    hz = 80e6 + SPACING_HZ * np.cumsum([0, *sites]) + noise_hz * (np.arange(len(sites) + 1) % 2)
    n_fitting = [sum(k % m == 0 for k in sites) for m in range(1, 13)]
    largest = max(m for m in range(1, 13) if n_fitting[m - 1] >= comb_kernels.ENOUGH * len(sites))
    assert comb_kernels.common_spacing(gaps_of(hz)) == pytest.approx(largest * SPACING_HZ, abs=50)


def test_a_gap_that_came_often_counts_often() -> None:
    hz = 80e6 + SPACING_HZ * np.array([0, 1, 1.5])
    assert comb_kernels.common_spacing(gaps_of(hz, np.array([9.0, 1.0]))) == SPACING_HZ
    assert comb_kernels.common_spacing(gaps_of(hz, np.array([1.0, 1.0]))) == SPACING_HZ / 2


def test_a_spacing_that_no_gap_has() -> None:
    hz = 80e6 + SPACING_HZ * np.array([0, 5, 12])
    assert comb_kernels.common_spacing(gaps_of(hz)) == SPACING_HZ


def test_one_tone_has_no_spacing_and_too_many_have_none_in_common() -> None:
    assert comb_kernels.common_spacing(np.empty((2, 0))) == 0.0
    assert comb_kernels.common_spacing(gaps_of(np.array([80e6, 80e6 + 50]))) == 0.0
    hz = 80e6 + SPACING_HZ * np.arange(comb_kernels.MAX_TEETH + 1, dtype=np.float64)
    assert comb_kernels.common_spacing(gaps_of(hz[:-1])) == SPACING_HZ
    assert comb_kernels.common_spacing(gaps_of(hz)) == -1.0


@pytest.mark.parametrize(("numerator", "period"), [(1, 390), (2, 625), (0, 1), (7, 12)])
def test_teeth_are_those_of_the_comb_of_0_hz(numerator: int, period: int) -> None:
    angles = 2 * np.pi / period * np.arange(period)
    filled = np.empty((10, period))
    comb_kernels.fill_teeth(np.cos(angles), np.sin(angles), numerator, 48, filled)
    turns = np.outer(48 + np.arange(5), numerator / period * np.arange(period))
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
