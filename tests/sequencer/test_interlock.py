"""No exposure with EM gain while light is on that blinds the camera; devices that need time to settle."""

from typing import Any

import numpy as np
import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.builtin.steps import DeviceStep
from labseq.errors import DeviceError, DeviceTimeoutError, StopRequested
from labseq.model import CameraFacts, SiteGrid, TargetPattern
from labseq.model.policies import Blinding
from labseq.roles import Context
from labseq.testing.fakes import RecordingCamera, RecordingDevice, RecordingMobileTweezers, ScriptedDetector
from tests.sequencer.rig import IMAGE, LOAD, Rig, given

MARKED = {"shutter": Blinding("state", ("on",))}


def command(do: str) -> tuple[str, Any]:
    return "device", DeviceStep(given(name="shutter", do=do, arguments={}, timeout=1.0))


class MultiplyingCamera(RecordingCamera):
    em_gain = 300.0

    @property
    def facts(self) -> CameraFacts:
        return CameraFacts(em_gain=self.em_gain)


def rig(*steps: tuple[str, Any], **lab: Any) -> Rig:
    made = Rig(steps, **lab)
    camera = MultiplyingCamera(calls=made.lab.calls)
    camera.clock = made.lab.clock
    object.__setattr__(made.lab, "camera", camera)
    return made


def n_exposures(made: Rig) -> int:
    return made.lab.calls.names().count("camera.trigger")


def test_a_blinding_light_refuses_the_exposure_and_ends_the_run_safely() -> None:
    made = rig(LOAD, command("on"), IMAGE, blinding=MARKED)
    with pytest.raises(DeviceError, match=r"EM gain of 300 while 'shutter' is on") as caught:
        made.run()
    assert caught.value.device == "camera"
    assert n_exposures(made) == 0
    assert "camera.arm" not in made.lab.calls.names()
    assert made.unsafe == {}


def test_each_exposure_is_checked_again() -> None:
    made = rig(LOAD, command("on"), command("off"), IMAGE, command("on"), IMAGE, blinding=MARKED)
    with pytest.raises(DeviceError, match="turn it off before the image"):
        made.run()
    assert n_exposures(made) == 1


def test_without_em_gain_no_device_is_read() -> None:
    made = rig(LOAD, command("on"), IMAGE, blinding=MARKED)
    vars(made.lab.camera)["em_gain"] = 1.0
    made.run()
    assert n_exposures(made) == 1
    assert "shutter.read" not in made.lab.calls.names()


def test_a_light_that_does_not_answer_refuses_the_exposure() -> None:
    made = rig(LOAD, IMAGE, blinding=MARKED, fail_on={"shutter.read": OSError("cable")})
    with pytest.raises(DeviceError, match=r"read\(\) raised OSError: cable"):
        made.run()
    assert n_exposures(made) == 0


class CoolingCamera(RecordingCamera):
    @property
    def settling_timeout_s(self) -> float:
        return 60.0

    fails = False

    def settle(self) -> None:
        self.use("settle")
        self.clock.sleep(30.0)
        if self.fails:
            raise DeviceTimeoutError(self.name, "the sensor is warm", self.settling_timeout_s)


def cooled(**attributes: Any) -> Rig:
    made = Rig()
    camera = CoolingCamera(calls=made.lab.calls)
    camera.clock = made.lab.clock
    vars(camera).update(attributes)
    object.__setattr__(made.lab, "camera", camera)
    return made


def test_a_device_settles_after_all_are_open_and_before_the_first_shot() -> None:
    made = cooled()
    made.run()
    names = made.lab.calls.names()
    assert names.index("mobile_tweezers.open") < names.index("camera.settle") < names.index("camera.arm")
    assert names.count("camera.settle") == 1
    assert made.observer.of("settling") == [{"device": "camera", "timeout_s": 60.0}]
    assert made.lab.clock.now() >= 30.0


class SettlingTweezers(RecordingMobileTweezers):
    @property
    def settling_timeout_s(self) -> float:
        return 0.0

    def settle(self) -> None:
        self.use("settle")


@pytest.mark.parametrize("is_virtual", [True, False])
def test_what_a_simulated_device_owes_to_the_virtual_clock_is_done_before_the_frame_counts(
    is_virtual: bool,
) -> None:
    made = Rig()
    object.__setattr__(made.lab, "mobile_tweezers", SettlingTweezers(calls=made.lab.calls))
    vars(made.lab.clock)["virtual"] = is_virtual
    made.run()
    names = made.lab.calls.names()
    assert (names[names.index("camera.read") + 1] == "mobile_tweezers.settle") == is_virtual


def test_a_device_that_does_not_settle_ends_the_run_safely() -> None:
    made = cooled(fails=True)
    with pytest.raises(DeviceTimeoutError, match="the sensor is warm"):
        made.run()
    assert set(made.made_safe()) == {"mobile_tweezers", "shutter", "camera", "static_tweezers"}


def test_a_stop_request_ends_the_wait() -> None:
    made = cooled()
    made.lab.stop.request()
    with pytest.raises(StopRequested):
        made.run()


class WatchedDevice(RecordingDevice):
    """Its value passes the limit after n_good checks."""

    n_checks = 0
    n_good = 2

    def poll(self) -> dict[str, float]:
        self.use("poll")
        return {"temperature_k": 300.0 + self.n_checks}

    def check_interlocks(self) -> None:
        self.use("check_interlocks")
        self.n_checks += 1
        if self.n_checks > self.n_good:
            raise DeviceError(self.name, "the water is at 41 degC; the limit is 40 degC")


def watched(n_good: int, *steps: tuple[str, Any]) -> Rig:
    made = Rig(steps)
    device = WatchedDevice(Context("chiller", clock=made.lab.clock), made.lab.calls)
    device.n_good = n_good
    object.__setattr__(made.lab, "devices", {"chiller": device})
    return made


def test_polled_values_are_kept_with_each_shot() -> None:
    made = watched(99, LOAD, IMAGE)
    made.run(2)
    assert [shot.readings["chiller.temperature_k"] for shot in made.sink.shots] == [300.0, 301.0]


def test_a_value_past_its_limit_ends_the_run_before_the_next_pick_up() -> None:
    rearrange = RearrangeStep(
        given(cycles=2, exposure=0.02, stop_when="never", window_mode="early", window_of=lambda _: 1.0)
    )
    made = watched(2, LOAD, IMAGE, ("rearrange", rearrange))
    object.__setattr__(made.lab, "detector", ScriptedDetector([[[1, 0]] * 2]))
    object.__setattr__(made.lab, "grid", SiteGrid(2, 2))
    object.__setattr__(made.lab, "target", TargetPattern(np.eye(2, dtype=bool)[::-1], np.zeros((2, 2), bool)))
    with pytest.raises(DeviceError, match="the water is at 41 degC"):
        made.run()
    names = made.lab.calls.names()
    assert names.count("mobile_tweezers.play") == 1
    assert names.index("mobile_tweezers.safe_state") > names.index("mobile_tweezers.play")
