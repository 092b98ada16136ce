from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import FrequencyCourse
from labseq.motion import render_comb_kernels, render_direct_kernels, render_kernels


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


@pytest.mark.parametrize("kind", FrequencyCourse)
def test_a_frequency_is_on_average_half_way(kind: FrequencyCourse) -> None:
    assert render_direct_kernels.course(kind, 1.0)[0] == pytest.approx(0.5)


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


def test_stored_waveforms_are_summed() -> None:
    stored = np.random.default_rng(0).integers(-1000, 1000, (6, 9000)).astype(np.int16)
    out = np.empty(8000, np.int16)
    render_direct_kernels.sum_stored(stored, np.array([1, 4, 5]), 700, out)
    assert np.array_equal(out, stored[[1, 4, 5], 700:8700].sum(axis=0))
