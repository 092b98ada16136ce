"""The Andor driver with the real pylablib, on the simulator of the SDK: series, cooling, whole runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_andor.camera import AndorCamera
from labseq_andor.codes import Code
from labseq_andor.library import load_pylablib
from labseq_andor.settings import AndorSettings

from labseq import DeviceError, DeviceTimeoutError, LimitError
from labseq.plugin import Context
from labseq.roles import NeverStopped, offers

from .labseq_camera_rig import Rig, assert_shown, opened_rig
from .needs import need_library

unopened = partial(Rig, "andor")
rig = partial(opened_rig, "andor")

COLD: Final[dict[str, Any]] = {"temperature": "-70 degC"}
ROOT: Final = Path(__file__).parents[2]


@pytest.fixture(autouse=True, scope="module")
def pylablib() -> None:
    need_library(lambda: load_pylablib("camera"))


def test_nothing_is_compiled_to_import_pylablib() -> None:
    from pylablib.devices.Andor.atcore_lib import read_uint12

    assert read_uint12.signatures == []


@settings(max_examples=12)
@given(data=st.data(), binning=st.integers(1, 4), isolated=st.booleans())
def test_region_and_binning_are_those_of_the_settings(data: Any, binning: int, isolated: bool) -> None:
    height, width = (binning * data.draw(st.integers(1, 96 // binning)) for _ in range(2))
    y, x = data.draw(st.integers(0, 96 - height)), data.draw(st.integers(0, 128 - width))
    region = {"y": y, "x": x, "height": height, "width": width}
    with rig(region=region, binning=binning, isolated_crop=isolated, frame_transfer=isolated) as lab:
        frame = lab.take(1, 0.1)[0]
        assert frame.image.shape == lab.camera.facts.frame_shape == (height // binning, width // binning)
    assert (lab.world.modes[0].region or (0, 0, 96, 128)) == (y, x, height, width)
    assert lab.world.modes[0].binning == binning
    assert_shown([frame], lab)


@settings(max_examples=12)
@given(
    rate=st.sampled_from([None, "17 MHz", "10 MHz", "1 MHz"]),
    shift=st.sampled_from([None, "0.3 us", "3.3 us"]),
    isolated=st.booleans(),
    binning=st.sampled_from([1, 2, 8]),
)
def test_the_read_out_time_before_opening_is_that_of_the_simulated_camera(
    rate: str | None, shift: str | None, isolated: bool, binning: int
) -> None:
    chosen: dict[str, Any] = {"readout_rate": rate, "vertical_shift_speed": shift, "binning": binning}
    region = {"y": 8, "x": 16, "height": 64, "width": 64}
    lab = unopened(region=region, isolated_crop=isolated, frame_transfer=isolated, **chosen)
    estimate = lab.camera.facts.readout_s
    lab.camera.open()
    try:
        assert lab.camera.facts.readout_s == estimate
        start_s = lab.clock.now()
        frame = lab.take(1, 0.1)[0]
        assert lab.clock.now() == pytest.approx(frame.t_start_s + 0.1 + estimate)
        assert frame.t_start_s >= start_s
    finally:
        lab.camera.close()


def test_smaller_regions_and_isolated_crop_are_read_faster() -> None:
    region = {"y": 0, "x": 0, "height": 32, "width": 32}
    whole, part = unopened(sensor_shape=(512, 512)), unopened(sensor_shape=(512, 512), region=region)
    crop = unopened(sensor_shape=(512, 512), region=region, isolated_crop=True, frame_transfer=True)
    times = [lab.camera.facts.readout_s for lab in (whole, part, crop)]
    assert times[0] > 5 * times[1] > 25 * times[2]


def test_sensor_and_read_out_of_a_known_model_are_known_before_it_is_opened() -> None:
    settings = AndorSettings.model_validate({"model": "DU-888", "readout_rate": "10 MHz"})
    facts = AndorCamera(settings, Context("camera")).facts
    assert facts.frame_shape == (1024, 1024)
    assert facts.readout_s == pytest.approx(0.109, rel=0.02)
    assert AndorCamera(AndorSettings(), Context("camera")).facts.frame_shape is None


def test_em_gain_is_on_in_a_series_only() -> None:
    with rig(em_gain=800, allow_high_gain=True) as lab:
        assert (lab.camera.facts.em_gain, lab.sim.amplifiers.em_gain) == (800, 0)
        for end in (lab.camera.disarm, lab.camera.safe_state):
            lab.take(1)
            assert lab.world.modes[-1].em_gain == lab.sim.amplifiers.em_gain == 800
            end()
            assert lab.sim.amplifiers.em_gain == 0
        lab.camera.self_test()
        assert lab.world.modes[-1].em_gain == 1
    with rig(amplifier="conventional", readout_rate="1 MHz") as lab:
        lab.take(1)
        assert lab.camera.describe()["readout_rate_hz"] == pytest.approx(1e6)
    assert lab.world.modes[0].em_gain == 1


def test_a_series_like_the_last_sets_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    set_for: list[tuple[Any, ...]] = []
    with rig(em_gain=50) as lab:
        camera = lab.camera._opened().camera
        for name in ("set_trigger_mode", "setup_cont_mode", "setup_kinetic_mode"):
            call = getattr(camera, name)
            monkeypatch.setattr(camera, name, lambda *given, call=call: (set_for.append(given), call(*given)))
        for exposure_s in (0.01, 0.01, 0.02, 0.02):
            assert lab.take(2, exposure_s)[-1].exposure_s == pytest.approx(exposure_s)
        assert set_for == [("software",), (0,)] * 2
        lab.take(2, 0.02, "external")
        assert set_for[-2:] == [("ext",), (2, 0.0)]
        lab.camera.close()
        lab.camera.open()
        lab.take(1, 0.02)
        assert set_for[4:] == [("ext",), (2, 0.0)]  # of the camera as it was before
        assert lab.sim.timing.exposure_s == pytest.approx(0.02)


def test_it_works_in_real_time_and_while_it_acquires_its_temperature_is_unknown() -> None:
    with rig(clock=NeverStopped()) as lab:
        frames = [*lab.take(2, 1e-3), *lab.take(2, 1e-3, "internal")]
        lab.camera.arm(1, 0.01, "software")
        assert lab.camera.describe()["temperature_k"] is None
        lab.camera.safe_state()
        assert lab.camera.describe()["temperature_k"] == pytest.approx(293.15)
    assert_shown(frames, lab)


def test_the_shutter_is_open_from_opening_to_the_safe_state() -> None:
    with rig() as lab:
        lab.clock.sleep(1.0)
        start_s = lab.clock.now()
        lab.take(1)
        lab.take(1)
        assert all(mode.shutter_open for mode in lab.world.modes)
        took_s = lab.clock.now() - start_s
        assert took_s == pytest.approx(2 * (0.01 + lab.camera.facts.readout_s))
        lab.camera.safe_state()
        assert lab.camera.describe()["shutter_now"] == "closed"
        start_s = lab.clock.now()
        frame = lab.take(1)[0]
        assert lab.world.modes[-1].shutter_open
        assert frame.t_start_s - start_s == pytest.approx(0.027)


def test_the_automatic_shutter_needs_no_wait() -> None:
    with rig(shutter="auto") as lab:
        assert lab.take(1)[0].t_start_s == 0.0
        assert lab.world.modes[0].shutter_open


def test_frame_transfer_exposes_while_it_reads() -> None:
    with rig(frame_transfer=True) as lab:
        lab.clock.sleep(1.0)
        frames = lab.take(4, 0.02, "internal")
        assert [frame.t_start_s for frame in frames] == pytest.approx([1.0 + k * 0.02 for k in range(4)])
        assert lab.clock.now() == pytest.approx(1.08 + lab.camera.facts.readout_s)


def test_an_exposure_shorter_than_frame_transfer_allows_is_refused() -> None:
    with rig(sensor_shape=(512, 512), frame_transfer=True) as lab:
        with pytest.raises(LimitError, match=r"1 ms.*at least 17.5 ms.*read-out"):
            lab.camera.arm(1, 1e-3, "software")
        lab.camera.self_test()  # chooses its own exposure


def test_external_triggers_may_come_before_anybody_reads() -> None:
    with rig() as lab:
        lab.camera.arm(5, 0.01, "external")
        for _ in range(5):
            assert lab.sim.trigger()
            lab.clock.sleep(0.05)
        frames = [lab.camera.read(1.0) for _ in range(5)]
    assert np.diff([frame.t_start_s for frame in frames]) == pytest.approx(0.05)
    assert_shown(frames, lab)


def test_the_baseline_clamp_and_speeds_reach_the_camera() -> None:
    chosen: dict[str, Any] = {"readout_rate": "5 MHz", "preamp_gain": 2, "vertical_shift_speed": "0.9 us"}
    with rig(baseline_clamp=False, fast_trigger=True, trigger_edge="falling", fan="low", **chosen) as lab:
        amplifiers = lab.sim.amplifiers
        assert (amplifiers.rate_hz, amplifiers.preamp_gain, amplifiers.shift_s) == (5e6, 2.0, 0.9e-6)
        assert not amplifiers.baseline_clamp
    with rig() as lab:
        assert lab.sim.amplifiers.baseline_clamp


# cooling


def status(lab: Rig) -> int:
    return lab.sim.cooler.status


def test_it_waits_until_the_sensor_is_cold_and_the_camera_calls_it_stabilized() -> None:
    with rig(cooling=COLD) as lab:
        assert offers(lab.camera, "settle")
        assert lab.camera.settling_timeout_s == 900.0
        assert status(lab) == Code.TEMP_NOT_REACHED
        lab.camera.settle()
        assert status(lab) == Code.TEMP_STABILIZED
        assert lab.camera.describe()["temperature_k"] == pytest.approx(203.15, abs=1.0)
        assert 200.0 < lab.clock.now() < 600.0


@pytest.mark.parametrize(("after", "is_on"), [("keep", True), ("off", False)])
def test_closing_leaves_the_cooler_as_the_settings_say(after: str, is_on: bool) -> None:
    with rig(cooling=COLD, cooler_after_close=after) as lab:
        lab.camera.settle()
        lab.camera.safe_state()
        assert status(lab) == Code.TEMP_STABILIZED
    assert lab.sim.cooler.is_on == is_on
    lab.clock.sleep(600.0)
    assert lab.sim.cooler.temperature_c == pytest.approx(-70.0 if is_on else 20.0, abs=0.1)
    with pytest.raises(DeviceError, match="not open"):
        lab.camera.settle()
    lab.camera.open()
    start_s = lab.clock.now()
    lab.camera.settle()
    assert (lab.clock.now() - start_s < 10.0) == is_on
    lab.camera.close()


def test_without_cooling_the_cooler_is_left_alone() -> None:
    with rig() as lab:
        assert lab.camera.settling_timeout_s == 0.0
        lab.camera.settle()
        assert (lab.clock.now(), lab.sim.cooler.is_on) == (0.0, False)


def test_a_cooler_that_never_gets_cold() -> None:
    with rig(cooling={"temperature": "-80 degC", "timeout": "10 min"}) as lab:
        lab.sim.faults.coldest_c = -60.0
        with pytest.raises(
            DeviceTimeoutError, match=r"sensor is at -60.0 degC after 600 s.*-80.0 degC.*water"
        ):
            lab.camera.settle()
        assert lab.clock.now() == pytest.approx(600.0, abs=1.5)


def test_a_camera_that_never_calls_itself_stabilized() -> None:
    with rig(cooling={"temperature": "-80 degC", "tolerance": 20, "timeout": "5 min"}) as lab:
        lab.sim.faults.coldest_c = -70.0
        with pytest.raises(DeviceTimeoutError, match=r"does not report a stabilized temperature after 300 s"):
            lab.camera.settle()


def test_a_drift_is_waited_for_too() -> None:
    with rig(cooling={**COLD, "timeout": "10 min"}) as lab:
        lab.camera.settle()
        lab.sim.faults.drift_k = 5.0
        assert status(lab) == Code.TEMP_DRIFT
        with pytest.raises(DeviceTimeoutError, match=r"sensor is at -6\d"):
            lab.camera.settle()


def test_looking_for_a_serial_number_leaves_other_cameras_cold() -> None:
    lab = unopened(serial=4711)
    lab.sim.cooler.set_temperature(-70)
    lab.sim.cooler.switch_on()
    with pytest.raises(DeviceError, match="expected 4711"):
        lab.camera.open()
    assert lab.sim.cooler.is_on


def test_bulb_with_frame_transfer_is_refused_as_most_heads_do_not_have_it() -> None:
    both: Final[dict[str, Any]] = {"line_trigger": "bulb", "frame_transfer": True}
    with pytest.raises(ValueError, match="no iXon but the 885 has `line_trigger: bulb` with frame transfer"):
        unopened(**both)
    made = unopened(**both, model="DU-885")  # a simulated 885 does not have it either
    with pytest.raises(DeviceError, match="has no bulb trigger with these settings; it has one of"):
        made.camera.open()


def test_a_cycle_shorter_than_exposure_and_read_out_is_refused() -> None:
    with rig(line_trigger="external_start", cycle_time="12 ms") as lab:
        least = "cycle_time is 12 ms; the limit is at least 13 ms with this exposure and read-out"
        with pytest.raises(LimitError, match=least):
            lab.camera.arm(2, 0.0119, "external_start")
        lab.camera.arm(2, 5e-3, "external_start")
