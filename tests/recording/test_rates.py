"""Intervals of rates."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import betaincinv

from labseq.model.estimate import Rate, jeffreys


@settings(max_examples=30)
@given(st.integers(1, 20_000), st.floats(0, 1), st.floats(0.5, 0.999))
def test_its_ends_are_quantiles_of_the_beta_distribution(n_trials: int, share: float, level: float) -> None:
    n = round(share * n_trials)
    low, high = jeffreys(n, n_trials, level)
    assert 0.0 <= low <= n / n_trials <= high <= 1.0
    alpha, beta = n + 0.5, n_trials - n + 0.5
    assert low == (pytest.approx(betaincinv(alpha, beta, (1 - level) / 2), abs=1e-9) if n else 0.0)
    assert high == (
        pytest.approx(betaincinv(alpha, beta, (1 + level) / 2), abs=1e-9) if n < n_trials else 1.0
    )


def test_nothing_is_known_without_trials() -> None:
    assert jeffreys(0, 0) == (0.0, 1.0)
    assert math.isnan(Rate(0, 0).value)


@pytest.mark.parametrize(("n", "n_trials"), [(-1, 3), (4, 3)])
def test_more_than_all_is_refused(n: int, n_trials: int) -> None:
    with pytest.raises(ValueError, match=f"{n} events in {n_trials} trials"):
        jeffreys(n, n_trials)
