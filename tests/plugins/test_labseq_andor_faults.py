"""What a user reads when something is wrong with an Andor camera; the simulator produces each fault."""

from __future__ import annotations

import re
import sys
import threading
from functools import partial
from typing import Any

import pytest
from labseq_andor.camera import AndorCamera
from labseq_andor.codes import SHUTTER_CLOSED
from labseq_andor.heads import IXON_888, IXON_897
from labseq_andor.settings import AndorSettings
from labseq_andor_sim import SimulatedCamera

from labseq import ConfigError, DeviceError, DeviceTimeoutError, TransientError
from labseq.plugin import Context

from .labseq_camera_rig import Rig, opened_rig

unopened = partial(Rig, "andor")
rig = partial(opened_rig, "andor")


def refusal(lab: Rig) -> str:
    with pytest.raises(DeviceError) as caught:
        lab.camera.open()
    assert caught.value.device == "camera"
    return str(caught.value)


def test_no_camera_is_connected() -> None:
    lab = unopened()
    lab.sim.faults.not_connected = True
    assert "no Andor camera is connected" in refusal(lab)
    lab.sim.faults.not_connected = False
    lab.camera.open()
    assert lab.take(1)
    lab.camera.close()


def test_another_program_has_the_camera() -> None:
    lab = unopened()
    lab.sim.faults.held = True
    text = refusal(lab)
    assert "close Solis" in text
    assert "(Initialize gave 20003, DRV_VXDNOTINSTALLED)" in text


def test_another_camera_answers() -> None:
    assert "10001, not 4711" in refusal(unopened(serial=4711))
    lab = unopened(model="DU-888")
    lab.sim.head = IXON_897
    assert re.search("DU-897, but .*DU-888", refusal(lab))


def two_cameras(**settings: Any) -> tuple[Rig, SimulatedCamera]:
    lab = unopened(**settings)
    other = SimulatedCamera(lab.world, lab.clock, IXON_888, (96, 128), serial=10002)
    lab.camera.connection.others.append(other)
    return lab, other


def test_with_two_cameras_the_serial_number_decides() -> None:
    lab, _ = two_cameras()
    assert re.search("2 Andor cameras .*`serial`", refusal(lab))
    lab, _ = two_cameras(serial=4711)
    assert "10001 and 10002, not 4711" in refusal(lab)
    lab, _ = two_cameras(serial=10002)
    lab.camera.open()
    assert lab.camera.describe()["model"] == "DU-888"
    lab.camera.close()


def test_unplugged_in_a_series() -> None:
    with rig() as lab:
        lab.sim.faults.unplugged_at = 3
        lab.camera.arm(4, 0.01, "internal")
        assert [lab.camera.read(1.0).number for _ in range(2)] == [0, 1]
        with pytest.raises(DeviceError, match=r"no longer answers.*20013"):
            lab.camera.read(1.0)
        with pytest.raises(DeviceError, match="no longer answers"):
            lab.camera.safe_state()
        with pytest.raises(DeviceError, match="no longer answers"):
            lab.camera.close()
        lab.sim.faults.unplugged, lab.sim.faults.unplugged_at = False, 0
        lab.camera.open()
        assert lab.take(1)


def test_a_frame_later_than_the_timeout() -> None:
    with rig() as lab:
        lab.sim.faults.late_s = 0.5
        lab.camera.arm(1, 0.01, "software")
        lab.camera.trigger()
        with pytest.raises(DeviceTimeoutError, match="200 ms: frame 0 is not ready"):
            lab.camera.read(0.2)
        assert lab.clock.now() == pytest.approx(0.027 + 0.2)
        assert lab.camera.read(0.5).number == 0


def test_a_software_trigger_during_the_read_out() -> None:
    with rig() as lab:
        lab.camera.arm(2, 0.01, "software")
        lab.camera.trigger()
        lab.clock.sleep(0.0101)
        with pytest.raises(DeviceError, match="cannot take a trigger while it reads a frame"):
            lab.camera.trigger()


def test_the_computer_is_too_slow_for_the_data() -> None:
    with rig() as lab:
        lab.sim.faults.buffer_error_at = 2
        lab.camera.arm(3, 0.01, "internal")
        assert lab.camera.read(1.0).number == 0
        with pytest.raises(TransientError, match=r"frame 1 was lost.*did not take the camera's data over"):
            lab.camera.read(1.0)
        lab.sim.faults.buffer_error_at = 0
        assert len(lab.take(3, 0.01, "internal")) == 3


def test_frames_overwritten_in_the_ring_buffer() -> None:
    with rig() as lab:
        lab.sim.faults.buffer_frames = 3
        lab.camera.arm(6, 0.01, "external")
        for _ in range(5):
            lab.sim.trigger()
            lab.clock.sleep(0.05)
        with pytest.raises(TransientError, match="frames 0 to 1 were lost from a series of 6"):
            lab.camera.read(1.0)
        assert [lab.camera.read(1.0).number for _ in range(3)] == [2, 3, 4]
        lab.sim.trigger()
        frame = lab.camera.read(1.0)
        assert (frame.number, frame.t_start_s) == (5, pytest.approx(0.027 + 0.25))


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ({"preamp_gain": 5}, "`preamp_gain` is 5, which this camera does not have.*1.*2.*3"),
        ({"vertical_shift_speed": "1 us"}, "`vertical_shift_speed` is 1 us.*0.5 us.*0.9 us"),
        ({"cooling": {"temperature": "-123 degC"}}, "-123 degC; this camera takes -120 to 20 degC"),
    ],
)
def test_a_setting_that_the_camera_does_not_have(chosen: dict[str, Any], text: str) -> None:
    with pytest.raises(DeviceError, match=text):
        unopened(**chosen).camera.open()


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ({"em_gain": 301}, "em_gain is 301, but above 300 the EM register ages fast.*allow_high_gain: true"),
        ({"em_gain": 2, "amplifier": "conventional"}, "conventional amplifier has no EM register"),
        ({"isolated_crop": True}, "isolated_crop needs a `region`"),
        ({"isolated_crop": True, "region": {"height": 8, "width": 8}}, "needs `frame_transfer: true`"),
    ],
)
def test_settings_that_do_not_go_together(chosen: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        AndorSettings.model_validate(chosen)


def test_a_region_outside_of_the_sensor_is_refused_as_soon_as_the_sensor_is_known() -> None:
    region = {"y": 500, "x": 0, "height": 64, "width": 64}
    settings = AndorSettings.model_validate({"model": "DU-897", "region": region})
    with pytest.raises(ConfigError, match="`region` ends at row 564 and column 64, beyond the sensor"):
        AndorCamera(settings, Context("camera"))
    lab = unopened(region={"height": 64, "width": 64})
    lab.sim.optics.sensor_shape = (48, 48)
    with pytest.raises(ConfigError, match="beyond the sensor of 48 x 48 pixels"):
        lab.camera.open()


def test_the_safe_state_comes_through_while_a_call_hangs() -> None:
    with rig(em_gain=100) as lab:
        lab.camera.arm(1, 0.01, "software")
        lab.camera.trigger()
        lab.sim.faults.hang = threading.Event()
        seen: list[Exception] = []

        def read() -> None:
            try:
                lab.camera.read(1.0)
            except Exception as error:  # noqa: BLE001 - whatever comes of a call that hung
                seen.append(error)

        reader = threading.Thread(target=read)
        reader.start()
        assert lab.sim.acquisition.hangs.wait(10.0)
        lab.camera.safe_state()
        assert lab.sim.optics.shutter == SHUTTER_CLOSED
        assert (lab.sim.amplifiers.em_gain, lab.sim.acquisition.is_acquiring) == (0, False)
        lab.sim.faults.hang.set()
        reader.join(10.0)
        assert not reader.is_alive()


@pytest.mark.skipif(sys.platform == "win32", reason="there Andor's library may be installed")
def test_without_andors_library_the_error_says_what_to_install() -> None:
    camera = AndorCamera(AndorSettings(sdk="/nowhere/libandor.so"), Context("camera"))
    with pytest.raises(DeviceError, match=r"'/nowhere/libandor.so' .*install Andor SDK2"):
        camera.open()
