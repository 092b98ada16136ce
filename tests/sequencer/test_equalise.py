"""The step that equalises the static tweezers, on fakes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.builtin.equalise import READINGS, EqualiseSettings, EqualiseStep, factors
from labseq.errors import ConfigError, DeviceError, StopRequested
from labseq.model import CalibrationEntry, ShotRecord, SiteGrid
from labseq.sequencer import Sequencer
from labseq.testing.fakes import FakeLab, ListSink, RecordingObserver, fake_calibration, fake_lab

Floats = NDArray[np.float64]

GRID = SiteGrid(6, 8)
ROW_BIAS, COLUMN_BIAS = np.linspace(0.8, 1.25, 6), np.linspace(1.2, 0.8, 8)
SITES = np.exp(np.random.default_rng(1).normal(0, 0.04, GRID.shape))
"""What no tone can change."""


class Meter:
    """Measures what the fake static tweezers were last told to play; what it says may be spoilt."""

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
        sequencer.run([0])
    finally:
        sequencer.shut_down()
    (shot,) = sink.shots
    return shot


def amplitudes_of(lab: FakeLab) -> list[tuple[Floats, Floats]]:
    """What the step had played; the sequencer itself loads None."""
    return [call.args[0] for call in lab.calls.of("static_tweezers.load") if call.args[0] is not None]


def found_in(shot: ShotRecord) -> dict[str, Any]:
    return {name.removeprefix(READINGS): value for name, value in shot.readings.items()}


def test_rows_and_columns_become_even_and_the_record_says_how() -> None:
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
    assert factors(before).separable_spread > 10 * factors(after).separable_spread


def test_what_it_tells_is_what_is_in_force() -> None:
    lab = lab_with(Meter())
    found = found_in(run(lab))
    rows, cols = amplitudes_of(lab)[-1]
    assert found["row_amplitudes"] == rows.tolist()
    assert found["column_amplitudes"] == cols.tolist()


def test_without_a_calibration_it_begins_with_equal_tones_at_full_scale() -> None:
    lab = lab_with(Meter())
    run(lab)
    rows, cols = amplitudes_of(lab)[0]
    assert rows == pytest.approx(np.full(6, 1 / 6))
    assert cols == pytest.approx(np.full(8, 1 / 8))


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


def test_sites_that_the_meter_cannot_tell_are_left_out() -> None:
    missing = np.random.default_rng(3).random(GRID.shape) < 0.15
    meter = Meter(lambda power: np.where(missing, np.nan, power))
    found = found_in(run(lab_with(meter)))
    assert found["separable_spread"] <= 0.005
    assert np.array_equal(np.isnan(np.array(found["power_after"])), missing)
    assert factors(np.where(missing, np.nan, meter.powers())).separable_spread < 0.006


def test_lists_serve_as_well_as_arrays() -> None:
    assert found_in(run(lab_with(Meter(lambda power: power.tolist()))))["separable_spread"] <= 0.005


def dead(power: Floats) -> Floats:
    power[3] = 0.0
    return power


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda _power: np.ones((8, 6)),
            r"trap_camera: its value 'spot_powers' is \(8, 6\); expected .*\(6, 8\)",
        ),
        (lambda power: power.ravel(), r"trap_camera: its value 'spot_powers' is \(48,\); expected"),
        (
            lambda _power: "warming up",
            "trap_camera: its value 'spot_powers' is str; expected the power of each",
        ),
        (lambda _power: None, "trap_camera: its value 'spot_powers' is NoneType; expected"),
        (lambda _power: 0.7, "trap_camera: its value 'spot_powers' is float; expected"),
        (lambda _power: [], r"trap_camera: its value 'spot_powers' is \(0,\); expected"),
        (lambda _power: [[1.0, 2.0], [3.0]], "trap_camera: its value 'spot_powers' is list; expected"),
        (lambda power: power * np.nan, "static_tweezers: no light on row 0, 1, 2, 3, 4, ...: is its tone on"),
        (lambda power: -power, "static_tweezers: no light on row 0, "),
        (dead, "static_tweezers: no light on row 3: is its tone on"),
    ],
)
def test_a_meter_that_answers_nonsense_is_told_and_everything_is_made_safe(
    spoil: Callable[[Floats], Any], message: str
) -> None:
    lab = lab_with(Meter(spoil))
    with pytest.raises(DeviceError, match=message):
        run(lab)
    assert_safe(lab)


def test_too_much_noise_says_how_many_averages_it_takes() -> None:
    lab = lab_with(Meter(noise=0.2))
    with pytest.raises(
        DeviceError, match=r"not equalised: too much noise: 10 averages .*; about \d+ averages"
    ):
        run(lab, max_averages=10)
    assert_safe(lab)


def test_a_meter_that_does_not_follow_the_tones_ends_the_loop() -> None:
    lab = lab_with(Meter(lambda _power: 1.0 + np.add.outer(np.arange(6.0), np.arange(8.0)), noise=0.0))
    with pytest.raises(DeviceError, match="not equalised: the separable spread stays at"):
        run(lab)
    assert_safe(lab)


def test_tweezers_that_refuse_the_amplitudes_are_named() -> None:
    lab = lab_with(Meter(), fail_on={"static_tweezers.load": RuntimeError("cable")})
    with pytest.raises(DeviceError, match=r"static_tweezers: .*cable"):
        run(lab)
    assert_safe(lab)


def test_a_device_that_the_profile_does_not_have_is_told_before_anything_is_changed() -> None:
    lab = lab_with(Meter())
    with pytest.raises(
        ConfigError, match="the profile has no device 'wavemeter'; it has: trap_camera, shutter"
    ):
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
