from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.builtin.equalise import equalise, factors
from labseq.errors import DeviceError

shapes = st.tuples(st.integers(2, 12), st.integers(2, 12))
seeds = st.integers(0, 2**32 - 1)


@given(shapes, seeds, st.floats(0.01, 0.3), st.floats(1e-3, 1e6))
def test_factors_of_rows_and_columns_are_found(
    shape: tuple[int, int], seed: int, spread: float, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    row, col = (rng.normal(0, spread, n) for n in shape)
    row, col = row - row.mean(), col - col.mean()
    found = factors(scale * np.exp(row[:, None] + col))
    assert found.row == pytest.approx(row, abs=1e-9)
    assert found.column == pytest.approx(col, abs=1e-9)
    assert found.separable_spread == pytest.approx(np.std(row[:, None] + col), rel=1e-6)
    assert found.residual_spread < 1e-9


def test_a_few_sites_may_be_missing() -> None:
    rng = np.random.default_rng(1)
    row, col = rng.normal(0, 0.1, 20), rng.normal(0, 0.1, 20)
    power = np.exp(row[:, None] + col)
    power[rng.random((20, 20)) < 0.2] = np.nan
    power[3, 4] = 0.0
    found = factors(power)
    assert found.row - found.row.mean() == pytest.approx(row - row.mean(), abs=1e-9)
    assert np.isnan(found.residual[3, 4])


def test_what_is_not_separable_is_told_apart() -> None:
    rng = np.random.default_rng(2)
    power = np.exp(rng.normal(0, 0.04, (20, 20)) + rng.normal(0, 0.1, (20, 1)))
    found = factors(power)
    assert found.residual_spread == pytest.approx(0.04, rel=0.1)
    assert np.nanmean(found.residual, axis=0) == pytest.approx(np.zeros(20), abs=1e-12)


@given(shapes, seeds)
def test_one_step_makes_powers_of_squared_amplitudes_even(shape: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, cols = (rng.uniform(0.5, 1.0, n) / n for n in shape)
    bias_row, bias_col = (rng.uniform(0.7, 1.3, n) for n in shape)

    def power(rows: Any, cols: Any) -> Any:
        return np.outer(bias_row * rows**2, bias_col * cols**2)

    step = equalise(power(rows, cols), rows, cols)
    even = power(step.row_amplitudes, step.column_amplitudes)
    assert even == pytest.approx(np.full(shape, even[0, 0]), rel=1e-9)
    assert step.row_amplitudes.sum() == pytest.approx(rows.sum())
    assert step.column_amplitudes.sum() == pytest.approx(cols.sum())


def test_amplitudes_stay_within_full_scale() -> None:
    rows, cols = np.full(4, 0.4), np.full(4, 0.25)
    step = equalise(np.ones((4, 4)), rows, cols, max_sum=1.0)
    assert step.row_amplitudes == pytest.approx(np.full(4, 0.25))
    weak = equalise(np.outer([1.0, 1e-1], [1.0, 1.0]), np.full(2, 0.8), np.full(2, 0.8), max_sum=2.0)
    assert weak.row_amplitudes.max() == 1.0


@pytest.mark.parametrize("light", [0.0, 1e-3, -0.01, np.nan])
def test_a_row_or_column_without_light_is_named(light: float) -> None:
    power = np.ones((6, 5))
    power[:, 3] = light
    with pytest.raises(DeviceError, match=r"static_tweezers: no light on column 3: is its tone on"):
        factors(power)
    with pytest.raises(DeviceError, match=r"no light on row 3"):
        factors(power.T)


def test_a_black_measurement_is_refused() -> None:
    with pytest.raises(DeviceError, match=r"no light on row 0, 1, 2, 3, 4, \.\.\.: "):
        factors(np.zeros((6, 6)))


@pytest.mark.parametrize(
    ("rows", "cols", "message"),
    [
        (np.ones(3), np.ones(4), r"powers of shape \(4, 4\); expected \(3, 4\)"),
        (np.array([1.0, 0.0, 1.0, 1.0]), np.ones(4), "an amplitude is not above 0"),
    ],
)
def test_amplitudes_that_do_not_belong_are_refused(rows: Any, cols: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        equalise(np.ones((4, 4)), rows, cols)
