"""Intervals of rates."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, strategies as st
from scipy.stats import beta, binom

from labseq.analysis.statistics import ONE_SIGMA, Rate, jeffreys


@pytest.mark.parametrize(
    ("n", "n_trials", "low", "high"),
    [
        (0, 7, 0.0, 0.292),
        (1, 7, 0.016, 0.501),
        (3, 7, 0.139, 0.766),
        (2, 20, 0.021, 0.284),
        (10, 20, 0.293, 0.707),
    ],
)
def test_an_interval_is_the_known_one(n: int, n_trials: int, low: float, high: float) -> None:
    assert jeffreys(n, n_trials, 0.95) == pytest.approx((low, high), abs=6e-4)


@given(st.integers(1, 20_000), st.floats(0, 1), st.floats(0.5, 0.999))
def test_its_ends_are_quantiles_of_the_beta_distribution(n_trials: int, share: float, level: float) -> None:
    n = round(share * n_trials)
    low, high = jeffreys(n, n_trials, level)
    assert 0.0 <= low <= n / n_trials <= high <= 1.0
    law = beta(n + 0.5, n_trials - n + 0.5)
    assert low == (pytest.approx(law.ppf((1 - level) / 2), abs=1e-9) if n else 0.0)
    assert high == (pytest.approx(law.ppf((1 + level) / 2), abs=1e-9) if n < n_trials else 1.0)


@given(st.integers(0, 500), st.integers(0, 500))
def test_what_did_not_happen_mirrors_what_did(n: int, n_other: int) -> None:
    low, high = jeffreys(n, n + n_other)
    assert jeffreys(n_other, n + n_other) == pytest.approx((1 - high, 1 - low), abs=1e-9)


def test_it_holds_the_true_rate_about_as_often_as_it_says() -> None:
    p, n_trials = 0.33, 400
    held = sum(
        binom.pmf(n, n_trials, p)
        for n in range(n_trials + 1)
        if jeffreys(n, n_trials)[0] <= p <= jeffreys(n, n_trials)[1]
    )
    assert held == pytest.approx(ONE_SIGMA, abs=0.03)


def test_nothing_is_known_without_trials() -> None:
    assert jeffreys(0, 0) == (0.0, 1.0)
    assert math.isnan(Rate(0, 0).value)


@pytest.mark.parametrize(("n", "n_trials"), [(-1, 3), (4, 3), (1, 0)])
def test_more_than_all_is_refused(n: int, n_trials: int) -> None:
    with pytest.raises(ValueError, match=f"{n} of {n_trials}"):
        jeffreys(n, n_trials)


def test_a_rate_knows_its_value_and_interval() -> None:
    rate = Rate(33, 100)
    assert rate.value == 0.33
    assert rate.interval == jeffreys(33, 100)
