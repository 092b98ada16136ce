"""The EM register, against a simulation of every electron in every stage and against theory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_virtual.sensors import N_ONE_BY_ONE, CountDistribution, Register, power_of_two
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

GAINS = (1.0, 1.02, 1.5, 3.0, 10.0, 100.0, 300.0, 1000.0)
KOLMOGOROV = 1.95
"""Over the root of the number of draws: the distance that 1 of 1,000 right samples exceeds."""


def exact(register: Register, n_electrons: int) -> Floats:
    """Law of the output for a fixed number of electrons in, worked out beside the plugin."""
    n_values = power_of_two((n_electrons + 9 * (2 * n_electrons) ** 0.5 + 45) * register.gain)
    s = np.exp(-2j * np.pi * np.fft.rfftfreq(n_values))
    for _ in range(register.n_stages):
        s = s * (1 - register.p) + register.p * s**2
    return np.fft.irfft(s**n_electrons, n_values)


def stage_by_stage(register: Register, n_electrons: Ints, rng: np.random.Generator) -> Ints:
    """Every electron in every stage; charge of a stage's own comes behind its multiplication."""
    n = n_electrons.copy()
    for _ in range(register.n_stages):
        n += rng.binomial(n, register.p)
        if register.spurious:
            n += rng.poisson(register.spurious / register.n_stages, len(n))
    return n


def distance(sample: Ints, other: Ints) -> float:
    """Kolmogorov-Smirnov distance of two samples, in units of its scale."""
    edges = np.arange(max(sample.max(), other.max()) + 2)
    one, two = (np.searchsorted(np.sort(x), edges, "right") / len(x) for x in (sample, other))
    return float(np.abs(one - two).max() / np.sqrt(1 / len(sample) + 1 / len(other)))


def distance_to(sample: Ints, law: Floats) -> float:
    """The same of a sample and a law."""
    found = np.cumsum(np.bincount(sample, minlength=len(law))) / len(sample)
    return float(np.abs(found[: len(law)] - np.cumsum(law)).max() * np.sqrt(len(sample)))


@pytest.mark.parametrize("gain", [1.0, 1.5, 10.0, 300.0])
@pytest.mark.parametrize("n_electrons", [1, 4, N_ONE_BY_ONE + 1])
def test_the_output_is_that_of_every_electron_in_every_stage(gain: float, n_electrons: int) -> None:
    register, rng = Register(536, gain), np.random.default_rng(5)
    n = np.full(4000, n_electrons)
    assert distance(register.multiply(n, rng), stage_by_stage(register, n, rng)) < KOLMOGOROV


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("n_electrons", [1, 2, 10])
def test_few_electrons_follow_the_exact_law(gain: float, n_electrons: int) -> None:
    register = Register(604, gain)
    drawn = register.multiply(np.full(100_000, n_electrons), np.random.default_rng(1))
    assert distance_to(drawn, exact(register, n_electrons)) < KOLMOGOROV


@pytest.mark.parametrize("gain", GAINS[:-1])
def test_many_electrons_follow_it_within_two_in_ten_thousand(gain: float) -> None:
    register, n_electrons = Register(536, gain), N_ONE_BY_ONE + 1
    drawn = register.multiply(np.full(100_000, n_electrons), np.random.default_rng(2))
    allowed = 2e-4 * np.sqrt(len(drawn))
    assert distance_to(drawn, exact(register, n_electrons)) < KOLMOGOROV + allowed


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("n_stages", [100, 536])
def test_gain_and_excess_noise_are_those_of_theory(gain: float, n_stages: int) -> None:
    """Variance over gain^2 for a Poisson input of 1: Robbins and Hadwen 2003."""
    register = Register(n_stages, gain)
    n_values = power_of_two(60 * gain + 64)
    law, n = register.output(1.0, n_values), np.arange(n_values)
    mean = law @ n
    assert mean == pytest.approx(gain, rel=1e-9)
    assert law @ (n - mean) ** 2 / gain**2 == pytest.approx(register.excess_noise, rel=1e-8)


def test_the_excess_noise_goes_from_1_to_2() -> None:
    noise = [Register(536, gain).excess_noise for gain in GAINS]
    assert noise[:-1] == sorted(noise[:-1])
    assert noise[0] == 1.0
    assert 1.97 < noise[-1] < noise[-2] < 2.0  # a larger p makes each stage less noisy
    assert Register(10**6, 1e4).excess_noise == pytest.approx(2.0, abs=2e-4)


def test_a_gain_of_1_changes_nothing() -> None:
    n = np.arange(200)
    np.testing.assert_array_equal(Register(536, 1.0).multiply(n, np.random.default_rng(0)), n)


@given(st.floats(1.0, 2000.0) | st.floats(0.0, 1e-6).map(lambda over: 1 + over), st.integers(100, 600))
def test_no_electron_is_lost_in_the_register(gain: float, n_stages: int) -> None:
    n = np.arange(300)
    out = Register(n_stages, gain).multiply(n, np.random.default_rng(0))
    assert (out >= n).all()
    assert out.sum() <= n.sum() * gain * 1.2 + 1


@pytest.mark.parametrize("gain", [1.0, 300.0])
def test_charge_of_the_registers_own_is_multiplied_only_by_the_stages_after_it(gain: float) -> None:
    register, rng = Register(536, gain, spurious=0.5), np.random.default_rng(3)
    dark = np.zeros(20_000, np.int64)
    drawn = register.multiply(dark, rng)
    assert distance(drawn, stage_by_stage(register, dark, rng)) < KOLMOGOROV
    mean = 0.5 * np.mean((1 + register.p) ** np.arange(536.0))
    assert drawn.mean() == pytest.approx(mean, rel=0.1)
    law = register.output(0.0, power_of_two(60 * gain))
    assert law @ np.arange(len(law)) == pytest.approx(mean, rel=1e-6)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=40).filter(any), st.integers(0, 1000))
def test_a_law_draws_each_number_as_often_as_it_says(weights: list[int], first: int) -> None:
    law = CountDistribution.of(np.array(weights, float), first)
    drawn = np.empty(4000, np.int32)
    law.draw(drawn, np.random.default_rng(7))
    often = np.bincount(drawn - first, minlength=len(weights))
    expected = 4000 * np.array(weights) / sum(weights)
    assert (often[expected == 0] == 0).all()
    assert (np.abs(often - expected) <= 6 * np.sqrt(expected)).all()


def test_the_ends_of_a_law_are_the_ends_of_the_random_words() -> None:
    law = CountDistribution.of(np.array([0.25, 0.75]))
    assert law.edges.tolist() == [2**30 - 1, 2**32 - 1]
    small = np.array([1e-15, 1.0, 1e-9, 1e-15])
    assert CountDistribution.of(small).first == 1
    assert len(CountDistribution.of(small).edges) == 2


def test_sums_are_those_of_single_draws() -> None:
    law, n_each = CountDistribution.of(np.array([0.5, 0.2, 0.3]), 3), np.array([0, 3, 1, 0, 5])
    drawn = np.empty(9, np.int32)
    law.draw(drawn, np.random.default_rng(1))
    ends = np.cumsum(n_each)
    expected = [int(drawn[end - n : end].sum()) for n, end in zip(n_each, ends, strict=True)]
    assert law.draw_sums(n_each, np.random.default_rng(1)).tolist() == expected
