from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.bench.report import ratio_of_means

from .scripts import load_script

fit_power_law = load_script("make_planner_tables").fit_power_law

POSITIVE = st.floats(1e-3, 1e3)


def test_the_error_of_a_ratio_is_that_of_repeated_ratios() -> None:
    rng = np.random.default_rng(1)
    below = rng.normal(15.0, 1.0, (400, 100))
    above = 1.3 * below + rng.normal(0.0, 1.0, below.shape)
    ratios = [ratio_of_means(a, b) for a, b in zip(above, below, strict=True)]
    scatter = np.std([ratio.value for ratio in ratios], ddof=1)
    assert np.mean([ratio.error for ratio in ratios]) == pytest.approx(scatter, rel=0.1)


@pytest.mark.parametrize("below", [[], [0.0, 0.0]])
def test_a_ratio_to_nothing_is_not_known(below: list[float]) -> None:
    assert math.isnan(ratio_of_means([1.0] * len(below), below).value)


@settings(max_examples=25)
@given(POSITIVE, st.floats(-2.0, 2.0), st.lists(st.integers(1, 10_000), min_size=3, max_size=12, unique=True))
def test_a_fit_finds_the_power_law_that_the_points_follow(
    factor: float, exponent: float, x: list[int]
) -> None:
    y = factor * np.array(x, np.float64) ** exponent
    law = fit_power_law(x, y, 0.01 * y)
    assert law is not None
    assert law.exponent.value == pytest.approx(exponent, abs=1e-6)
    assert law.exponent.error < 1e-6
    assert law.factor == pytest.approx(factor, rel=1e-4)


def test_the_error_of_an_exponent_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(2)
    x = np.array([25.0, 50.0, 100.0, 200.0, 400.0, 800.0])
    laws = [fit_power_law(x, y, 0.05 * y) for y in x**0.5 * np.exp(rng.normal(0.0, 0.05, (500, 6)))]
    exponents = [law.exponent for law in laws if law is not None]
    scatter = np.std([one.value for one in exponents], ddof=1)
    assert np.mean([one.value for one in exponents]) == pytest.approx(0.5, abs=0.005)
    assert np.sqrt(np.mean([one.error**2 for one in exponents])) == pytest.approx(scatter, rel=0.1)


def test_two_points_or_one_size_make_no_fit() -> None:
    assert fit_power_law([1.0, 2.0], [1.0, 2.0], [0.1, 0.1]) is None
    assert fit_power_law([2.0, 2.0, 2.0], [1.0, 2.0, 3.0], [0.1, 0.1, 0.1]) is None
    assert fit_power_law([1.0, 2.0, 3.0], [1.0, 2.0, math.nan], [0.1, 0.1, math.nan]) is None
