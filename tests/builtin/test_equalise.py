"""The step that equalises the static tweezers, on fakes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.builtin.equalise import (
    READINGS,
    EqualiseSettings,
    EqualiseStep,
    LoopResult,
    Sites,
    Tones,
    equalise_loop,
    factors,
)
from labseq.errors import ConfigError, DeviceError, StopRequested
from labseq.model import CalibrationEntry, ShotRecord, SiteGrid
from labseq.sequencer.run import Sequencer
from labseq.testing.fakes import FakeLab, ListSink, RecordingObserver, fake_calibration, fake_lab

Floats = NDArray[np.float64]

GRID = SiteGrid(6, 8)
ROW_BIAS, COLUMN_BIAS = np.linspace(0.8, 1.25, 6), np.linspace(1.2, 0.8, 8)
SITES = np.exp(np.random.default_rng(1).normal(0, 0.04, GRID.shape))
"""What no tone can change."""


class Meter:
    """Measures what the fake static tweezers play; its answer may be spoilt."""

    def __init__(self, spoil: Callable[[Floats], Any] = lambda power: power, noise: float = 0.01) -> None:
        self.spoil, self.noise = spoil, noise
        self.rng = np.random.default_rng(2)
        self.lab: FakeLab | None = None

    def powers(self) -> Floats:
        """The truth."""
        assert self.lab is not None
        rows, cols = amplitudes_of(self.lab)[-1]
        of_row, of_col = ROW_BIAS * (6 * rows) ** 2, COLUMN_BIAS * (8 * cols) ** 2
        return 700.0 * np.outer(of_row, of_col) * SITES

    def read(self, name: str) -> Any:
        assert name == "spot_powers"
        return self.spoil(self.powers() * (1 + self.noise * self.rng.normal(size=GRID.shape)))


def lab_with(meter: Meter, **parts: Any) -> FakeLab:
    meter.lab = lab = fake_lab(grid=GRID, devices=("trap_camera", "shutter"), **parts)
    vars(lab.devices["trap_camera"])["read"] = meter.read
    return lab


def run(lab: FakeLab, observer: RecordingObserver | None = None, **settings: Any) -> ShotRecord:
    sink, step = ListSink(), EqualiseStep(EqualiseSettings(**settings))
    sequencer = Sequencer(lab, [("equalise", step)], lab.stop, sink, observer or RecordingObserver(), seed=1)
    try:
        sequencer.open()
        sequencer.take(0)
    finally:
        sequencer.shut_down()
    (shot,) = sink.shots
    return shot


def amplitudes_of(lab: FakeLab) -> list[tuple[Floats, Floats]]:
    """What the step had played; the sequencer itself loads None."""
    return [call.args[0] for call in lab.calls.of("static_tweezers.load") if call.args[0] is not None]


def found_in(shot: ShotRecord) -> dict[str, Any]:
    return {name.removeprefix(READINGS): value for name, value in shot.readings.items()}


def test_rows_and_columns_become_even_and_the_record_shows_it() -> None:
    meter = Meter()
    lab = lab_with(meter)
    found = found_in(run(lab))
    even = factors(meter.powers())
    assert even.separable_spread < 0.006
    assert found["separable_spread"] <= 0.005
    assert found["noise"] <= 0.005 / 3
    assert found["residual_spread"] == pytest.approx(even.residual_spread, rel=0.1)
    assert found["spreads"][0] > 0.1
    assert found["spreads"][-1] == found["separable_spread"]
    before, after = (np.array(found[f"power_{when}"]) for when in ("before", "after"))
    assert before.shape == after.shape == GRID.shape
    (first_rows, first_cols), *_, (rows, cols) = amplitudes_of(lab)
    assert first_rows == pytest.approx(np.full(6, 1 / 6))
    assert first_cols == pytest.approx(np.full(8, 1 / 8))
    assert (found["row_amplitudes"], found["column_amplitudes"]) == (rows.tolist(), cols.tolist())
    assert factors(before).separable_spread > 10 * factors(after).separable_spread


def test_a_meter_of_the_total_light_measures_each_tone_alone() -> None:
    meter = Meter(lambda power: float(power.sum()) + 500.0)
    lab = lab_with(meter)
    found = found_in(run(lab, settle=0.25))
    assert factors(meter.powers()).separable_spread < 0.006
    assert found["noise"] <= 0.005 / 3
    assert found["residual_spread"] < 1e-4
    played = amplitudes_of(lab)
    assert (found["row_amplitudes"], found["column_amplitudes"]) == tuple(
        each.tolist() for each in played[-1]
    )
    assert {int((rows > 0).sum()) for rows, _ in played} == {0, 1, 6}
    assert lab.clock.now() >= 0.25 * len(played)


def test_a_tone_without_light_is_named_by_a_meter_of_the_total_light() -> None:
    lab = lab_with(Meter(lambda power: float(power[:, 1:].sum()) + 500.0, noise=0.0))
    with pytest.raises(DeviceError, match="no light on column 0"):
        run(lab)


def test_it_begins_at_the_calibration_in_use() -> None:
    rows, cols = ROW_BIAS**-0.5, COLUMN_BIAS**-0.5
    values = {"row_amplitudes": 0.9 * rows / rows.sum(), "column_amplitudes": cols / cols.sum()}
    entry: CalibrationEntry = fake_calibration("tweezers", GRID, values=values)
    lab = lab_with(Meter(), calibrations={"tweezers": entry})
    found = found_in(run(lab))
    first = amplitudes_of(lab)[0]
    assert first[0] == pytest.approx(values["row_amplitudes"])
    assert first[1] == pytest.approx(values["column_amplitudes"])
    assert found["spreads"][0] < 0.03 < found_in(run(lab_with(Meter())))["spreads"][0]
    assert sum(found["row_amplitudes"]) == pytest.approx(0.9)


def test_sites_that_the_meter_cannot_measure_are_left_out() -> None:
    missing = np.random.default_rng(3).random(GRID.shape) < 0.15
    meter = Meter(lambda power: np.where(missing, np.nan, power).tolist())
    found = found_in(run(lab_with(meter)))
    assert found["separable_spread"] <= 0.005
    assert np.array_equal(np.isnan(np.array(found["power_after"])), missing)
    assert factors(np.where(missing, np.nan, meter.powers())).separable_spread < 0.006


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda _power: np.ones((8, 6)), r"trap_camera: .*'spot_powers' is \(8, 6\); .*\(6, 8\)"),
        (lambda _power: "warming up", "trap_camera: .*'spot_powers' is str"),
        (lambda _power: [[1.0, 2.0], [3.0]], "trap_camera: .*'spot_powers' is list"),
    ],
)
def test_nonsense_from_the_meter_is_refused_and_everything_is_made_safe(
    spoil: Callable[[Floats], Any], message: str
) -> None:
    lab = lab_with(Meter(spoil))
    with pytest.raises(DeviceError, match=message):
        run(lab)
    assert_safe(lab)


def test_a_meter_that_does_not_follow_the_tones_ends_the_loop() -> None:
    lab = lab_with(Meter(lambda _power: 1.0 + np.add.outer(np.arange(6.0), np.arange(8.0)), noise=0.0))
    with pytest.raises(DeviceError, match="spread stays at"):
        run(lab)
    assert_safe(lab)


def test_a_device_that_the_profile_does_not_have_is_refused_before_anything_is_changed() -> None:
    lab = lab_with(Meter())
    with pytest.raises(ConfigError, match=r"'wavemeter'.* trap_camera, shutter"):
        run(lab, device="wavemeter")
    assert not amplitudes_of(lab)


def test_a_stop_request_ends_it_between_two_measurements() -> None:
    meter = Meter()
    lab = lab_with(meter)

    def stop(power: Floats) -> Floats:
        lab.stop.request()
        return power

    meter.spoil = stop
    with pytest.raises(StopRequested):
        run(lab)
    assert_safe(lab)


def assert_safe(lab: FakeLab) -> None:
    """Everything went to its safe state in the end; nothing was loaded after that."""
    names = lab.calls.names("static_tweezers")
    assert names[-2:] == ["static_tweezers.safe_state", "static_tweezers.close"]
    for device in ("trap_camera", "mobile_tweezers"):
        assert f"{device}.safe_state" in lab.calls.names(device)


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


def test_what_is_not_separable_is_the_residual() -> None:
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

    step = Tones().correct(power(rows, cols), (rows, cols), EqualiseSettings(gain=1.0))
    even = power(*step.values)
    assert even == pytest.approx(np.full(shape, even[0, 0]), rel=1e-9)
    for before, after in zip((rows, cols), step.values, strict=True):
        assert after.sum() == pytest.approx(before.sum())


@pytest.mark.parametrize("light", [1e-3, -0.01, np.nan])
def test_a_row_or_column_without_light_is_named(light: float) -> None:
    power = np.ones((6, 5))
    power[:, 3] = light
    with pytest.raises(DeviceError, match="static_tweezers: no light on column 3"):
        factors(power)
    with pytest.raises(DeviceError, match=r"no light on row 3"):
        factors(power.T)


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
    return equalise_loop(array.measure, array.apply, (rows, cols), limits)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(20, 20), (12, 30)]))
@settings(max_examples=4)
def test_the_separable_part_is_made_even_and_the_rest_is_left_alone(
    seed: int, shape: tuple[int, int]
) -> None:
    array = Array(seed, shape=shape)
    result = begin(array)
    found = factors(array.power())
    assert found.separable_spread < 0.0055
    assert found.residual_spread == pytest.approx(0.04, rel=0.2)
    assert result.residual_spread == pytest.approx(found.residual_spread, rel=0.2)
    assert result.spreads[-1] <= 0.005
    assert result.noise <= 0.005 / 3
    assert result.spreads[0] > 10 * result.spreads[-1]


@pytest.mark.parametrize("response", [lambda p: np.sin(np.minimum(p, 2.0) * 0.7) ** 2, lambda p: p**1.5])
def test_a_response_that_is_not_linear_takes_some_rounds_more(response: Any) -> None:
    array = Array(3, response=response)
    begin(array)
    assert factors(array.power()).separable_spread < 0.0055


def test_too_much_noise_ends_the_loop_and_names_the_averages_needed() -> None:
    array = Array(6, noise=0.1)
    with pytest.raises(
        DeviceError, match=r"too much noise, as 20 averages .* about \d+ averages"
    ) as reported:
        begin(array, EqualiseSettings(max_averages=20))
    needed = int(str(reported.value).split("about ")[1].split()[0])
    again = Array(6, noise=0.1)
    with pytest.raises(DeviceError, match="too much noise"):
        begin(again, EqualiseSettings(max_averages=needed // 2))
    again = Array(6, noise=0.1)
    assert begin(again, EqualiseSettings(max_averages=1000)).noise <= 0.005 / 3


def test_a_row_that_does_not_follow_its_tone_is_named() -> None:
    array = Array(8)
    apply = array.apply
    array.apply = lambda rows, cols: apply(np.where(np.arange(20) == 5, 0.7 * np.median(rows), rows), cols)
    with pytest.raises(
        DeviceError, match=r"spread stays at .*, and the spots of row 5 have 0\.\d+ times the"
    ):
        begin(array)
    with pytest.raises(DeviceError, match="after 3 rounds"):
        begin(Array(10), EqualiseSettings(gain=0.1, max_rounds=3))


def test_amplitudes_beyond_full_scale_bring_the_others_down() -> None:
    array = Array(9, shape=(2, 3), noise=0.001, disorder=0.0)
    array.bias[0][:] = 1.0, 0.1
    array.apply = lambda rows, cols: setattr(array, "amplitudes", [rows, cols])
    limits = EqualiseSettings(max_sum=2.0)
    result = equalise_loop(array.measure, array.apply, (np.ones(2), np.full(3, 1 / 3)), limits)
    assert result.values[0] == pytest.approx([0.1**0.5, 1.0], rel=0.02)


def test_weights_of_sites_make_every_site_even_also_where_a_spot_answers_by_less_than_its_weight() -> None:
    rng = np.random.default_rng(4)
    bias, weights = np.exp(rng.normal(0, 0.1, (6, 8))), np.ones((6, 8))
    exponent = np.where(bias > 1.1, 0.8, 1.0)

    def apply(played: Floats) -> None:
        weights[...] = played

    def measure() -> Floats:
        return 300.0 * bias * weights**exponent * (1 + 0.007 * rng.normal(size=weights.shape))

    result = equalise_loop(measure, apply, (np.ones((6, 8)),), control=Sites())
    even = bias * weights**exponent
    assert result.spreads[0] > 0.08
    assert np.std(even) < 0.006 * even.mean()
    assert result.noise <= 0.005 / 3
    assert weights.mean() == pytest.approx(1.0)


def test_a_site_that_does_not_follow_its_weight_is_named() -> None:
    weights = np.ones((6, 8))

    def apply(played: Floats) -> None:
        weights[...] = played
        weights[2, 3] = 1.5

    with pytest.raises(DeviceError, match=r"the spots of site \(2, 3\) have 1\.\d+ times .* a weight of 0"):
        equalise_loop(lambda: weights, apply, (np.ones((6, 8)),), control=Sites())
