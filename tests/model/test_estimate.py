from __future__ import annotations

import math

import pytest
from hypothesis import given, strategies as st

from labseq.model.estimate import Estimate, mean


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (160.04, 0.21, "160.0(2)"),
        (29.614, 0.0302, "29.61(3)"),
        (0.48, 0.0196, "0.48(2)"),
        (99.96, 0.96, "100(1)"),
        (7.0, 0.0951, "7.0(1)"),
        (5988.0, 34.0, "5990(30)"),
        (0.0, 0.0, "0"),
        (14.57461, math.nan, "14.57"),
        (math.nan, math.nan, "-"),
    ],
)
def test_an_estimate_is_written_as_physicists_do(value: float, error: float, text: str) -> None:
    assert str(Estimate(value, error)) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-5, 1e4))
def test_a_written_estimate_is_within_its_error_of_the_value(value: float, error: float) -> None:
    written, _, bracket = str(Estimate(value, error)).partition("(")
    assert abs(float(written) - value) <= error
    assert bracket.endswith(")")


def test_the_mean_of_nothing_and_of_one() -> None:
    assert math.isnan(mean([]).value)
    assert mean([3.0]).value == 3.0
    assert math.isnan(mean([3.0]).error)
