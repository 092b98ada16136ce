from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.builtin.equalise import EqualiseSettings, LoopResult, equalise_loop, factors
from labseq.errors import DeviceError


class Array:
    """Spots whose tones differ, with disorder that no tone can change, and a noisy camera.

    ``response`` is the power of the product of two amplitudes squared, each over its share of full scale.
    """

    def __init__(self, seed: int, *, noise: float = 0.03, disorder: float = 0.04, **changes: Any) -> None:
        self.rng = np.random.default_rng(seed)
        self.shape = changes.get("shape", (20, 20))
        self.bias = [self.rng.uniform(0.75, 1.3, n) for n in self.shape]
        self.disorder = np.exp(self.rng.normal(0, disorder, self.shape))
        self.noise = noise
        self.response = changes.get("response", lambda power: power)
        self.amplitudes: list[Any] = []

    def apply(self, rows: Any, cols: Any) -> None:
        assert rows.sum() <= 1 + 1e-12
        assert cols.sum() <= 1 + 1e-12
        self.amplitudes = [rows, cols]

    def power(self) -> Any:
        of_row, of_col = (b * (a * len(a)) ** 2 for a, b in zip(self.amplitudes, self.bias, strict=True))
        return 700.0 * self.response(np.outer(of_row, of_col)) * self.disorder

    def measure(self) -> Any:
        return self.power() * (1 + self.noise * self.rng.normal(size=self.shape))

    def start(self) -> list[Any]:
        return [np.full(n, 1 / n) for n in self.shape]


def begin(array: Array, limits: EqualiseSettings | None = None) -> LoopResult:
    rows, cols = array.start()
    return equalise_loop(array.measure, array.apply, rows, cols, limits)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(20, 20), (12, 30)]))
@settings(max_examples=10, deadline=None)
def test_the_separable_part_is_made_even_and_the_rest_is_left_alone(
    seed: int, shape: tuple[int, int]
) -> None:
    array = Array(seed, shape=shape)
    result = begin(array)
    found = factors(array.power())
    assert found.separable_spread < 0.0055
    assert found.residual_spread == pytest.approx(0.04, rel=0.2)
    assert result.equalised.residual_spread == pytest.approx(found.residual_spread, rel=0.2)
    assert result.equalised.separable_spread <= 0.005
    assert result.noise <= 0.005 / 3
    assert result.spreads[0] > 10 * result.spreads[-1]


@pytest.mark.parametrize(
    "response",
    [lambda p: np.sin(np.minimum(p, 2.0) * 0.7) ** 2, lambda p: p / (1 + 0.5 * p), lambda p: p**1.5],
)
def test_a_response_that_is_not_linear_takes_some_rounds_more(response: Any) -> None:
    array = Array(3, response=response)
    begin(array)
    assert factors(array.power()).separable_spread < 0.0055


def test_the_amplitudes_that_come_back_are_in_force() -> None:
    array = Array(4)
    result = begin(array)
    assert result.equalised.row_amplitudes is array.amplitudes[0]
    assert result.equalised.column_amplitudes is array.amplitudes[1]


def test_sites_that_cannot_be_measured_are_left_out() -> None:
    array = Array(5)
    missing = np.random.default_rng(1).random(array.shape) < 0.1
    measure = array.measure
    array.measure = lambda: np.where(missing, np.nan, measure())
    result = begin(array)
    assert result.equalised.separable_spread <= 0.005
    assert factors(np.where(missing, np.nan, array.power())).separable_spread < 0.0055


def test_too_much_noise_says_how_many_averages_it_takes() -> None:
    array = Array(6, noise=0.1)
    with pytest.raises(
        DeviceError, match=r"too much noise: 20 averages leave .*; about \d+ averages"
    ) as told:
        begin(array, EqualiseSettings(max_averages=20))
    needed = int(str(told.value).split("about ")[1].split()[0])
    again = Array(6, noise=0.1)
    with pytest.raises(DeviceError, match="too much noise"):
        begin(again, EqualiseSettings(max_averages=needed // 2))
    again = Array(6, noise=0.1)
    assert begin(again, EqualiseSettings(max_averages=1000)).noise <= 0.005 / 3


def test_a_dead_row_is_named() -> None:
    array = Array(7)
    array.bias[0][11] = 0.0
    with pytest.raises(DeviceError, match="no light on row 11"):
        begin(array)


def test_a_row_that_does_not_follow_its_tone_is_named() -> None:
    array = Array(8)
    apply = array.apply
    array.apply = lambda rows, cols: apply(np.where(np.arange(20) == 5, 0.7 * np.median(rows), rows), cols)
    with pytest.raises(DeviceError, match=r"spread stays at .*; the spots of row 5 have 0\.\d+ times the"):
        begin(array)


def test_amplitudes_beyond_full_scale_bring_the_others_down() -> None:
    array = Array(9, shape=(2, 3), noise=0.001, disorder=0.0)
    array.bias[0][:] = 1.0, 0.1
    array.apply = lambda rows, cols: setattr(array, "amplitudes", [rows, cols])
    limits = EqualiseSettings(max_sum=2.0)
    result = equalise_loop(array.measure, array.apply, np.ones(2), np.full(3, 1 / 3), limits)
    assert result.equalised.row_amplitudes == pytest.approx([0.1**0.5, 1.0], rel=0.02)


def test_slow_progress_ends_after_all_rounds() -> None:
    array = Array(10)
    with pytest.raises(DeviceError, match="after 3 rounds"):
        begin(array, EqualiseSettings(gain=0.1, max_rounds=3))
