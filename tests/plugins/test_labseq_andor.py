"""The Andor driver on the simulator of the SDK: series, cooling, whole runs."""

from __future__ import annotations

import ctypes
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from labseq_andor.camera import AndorCamera
from labseq_andor.codes import SDK_VERSION, Code
from labseq_andor.heads import HEADS
from labseq_andor.sdk import AndorError, AndorSdk
from labseq_andor.settings import AndorSettings

from labseq import DeviceError, DeviceTimeoutError, LimitError
from labseq.plugin import Context
from labseq.roles import Hardware, NeverStopped, overrides

from .labseq_camera_rig import Rig, assert_shown, opened_rig

unopened = partial(Rig, "andor")
rig = partial(opened_rig, "andor")

COLD: Final[dict[str, Any]] = {"temperature": "-70 degC"}


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


# cooling


def status(lab: Rig) -> int:
    return lab.sim.cooler.status


def test_it_waits_until_the_sensor_is_cold_and_the_camera_calls_it_stabilized() -> None:
    with rig(cooling=COLD) as lab:
        assert overrides(lab.camera, Hardware.settle)
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


def test_a_camera_that_never_calls_itself_stabilized() -> None:
    with rig(cooling={"temperature": "-80 degC", "tolerance": 20, "timeout": "5 min"}) as lab:
        lab.sim.faults.coldest_c = -70.0
        with pytest.raises(DeviceTimeoutError, match="stabilized temperature after 300 s"):
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
    lab.sim.cooler.SetTemperature(-70)
    lab.sim.cooler.CoolerON()
    with pytest.raises(DeviceError, match="10001, not 4711"):
        lab.camera.open()
    assert lab.sim.cooler.is_on


def test_bulb_with_frame_transfer_is_refused_as_most_heads_do_not_have_it() -> None:
    both: Final[dict[str, Any]] = {"line_trigger": "bulb", "frame_transfer": True}
    with pytest.raises(ValueError, match="`line_trigger: bulb` with frame transfer"):
        unopened(**both)
    made = unopened(**both, model="DU-885")  # a simulated 885 does not have it either
    with pytest.raises(DeviceError, match="no bulb trigger with these settings"):
        made.camera.open()


def test_a_cycle_shorter_than_exposure_and_read_out_is_refused() -> None:
    with rig(line_trigger="external_start", cycle_time="12 ms") as lab:
        with pytest.raises(LimitError, match=r"cycle_time is 12 ms; .* 13 ms"):
            lab.camera.arm(2, 0.0119, "external_start")
        lab.camera.arm(2, 5e-3, "external_start")


def test_functions_of_a_c_library_get_their_arguments_and_return_what_they_write() -> None:
    seen: list[Any] = []

    def get_speed(*arguments: Any) -> int:
        seen.extend(arguments[:3])
        arguments[3][0] = 17.0
        return Code.SUCCESS

    def get_version(kind: int, text: Any, length: int) -> int:
        seen.extend((kind, length))
        ctypes.memmove(text, b"2.104\0", 6)
        return Code.SUCCESS

    integer, pointer = ctypes.c_int32, ctypes.POINTER(ctypes.c_float)
    library = SimpleNamespace(
        GetHSSpeed=ctypes.CFUNCTYPE(ctypes.c_uint, integer, integer, integer, pointer)(get_speed),
        GetVersionInfo=ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.c_void_p, integer)(get_version),
        CoolerON=ctypes.CFUNCTYPE(ctypes.c_uint)(lambda: int(Code.NOT_SUPPORTED)),
    )
    sdk = AndorSdk(library)
    assert (sdk.GetHSSpeed(0, 1, 2), sdk.GetVersionInfo(SDK_VERSION)) == (17.0, "2.104")
    assert seen == [0, 1, 2, SDK_VERSION, 256]
    for function in (sdk.CoolerON, sdk.CoolerOFF):  # the second is missing, as from an old library
        with pytest.raises(AndorError, match=r"this camera cannot do that .*20991, DRV_NOT_SUPPORTED"):
            function()


@pytest.mark.parametrize("head", HEADS, ids=lambda head: head.model)
def test_heads_are_listed_from_fast_to_slow(head: Any) -> None:
    assert list(head.em_rates_hz) == sorted(head.em_rates_hz, reverse=True)
    assert list(head.shifts_s) == sorted(head.shifts_s)
