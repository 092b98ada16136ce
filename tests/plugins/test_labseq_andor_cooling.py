"""Cooling an Andor camera, on the session's clock."""

from __future__ import annotations

from typing import Any, Final

import pytest
from labseq_andor.codes import Code
from labseq_andor.library import load_pylablib

from labseq import DeviceError, DeviceTimeoutError, NeedsSettling

from .labseq_andor_rig import Rig, rig
from .needs import need_library

COLD: Final[dict[str, Any]] = {"temperature": "-70 degC"}


@pytest.fixture(autouse=True, scope="module")
def pylablib() -> None:
    need_library(lambda: load_pylablib("camera"))


def status(lab: Rig) -> int:
    celsius = [0.0]
    return lab.sim.cooler.get_temperature(celsius)


def test_it_waits_until_the_sensor_is_cold_and_the_camera_calls_it_stabilized() -> None:
    with rig(cooling=COLD) as lab:
        assert isinstance(lab.camera, NeedsSettling)
        assert lab.camera.settling_timeout_s == 900.0
        assert status(lab) == Code.TEMP_NOT_REACHED
        lab.camera.settle()
        assert status(lab) == Code.TEMP_STABILIZED
        assert lab.camera.describe()["temperature_k"] == pytest.approx(203.15, abs=1.0)
        assert 200.0 < lab.clock.now() < 600.0


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
        with pytest.raises(DeviceTimeoutError, match=r"does not call its temperature stabilized after 300 s"):
            lab.camera.settle()


def test_a_drift_is_waited_for_too() -> None:
    with rig(cooling={**COLD, "timeout": "10 min"}) as lab:
        lab.camera.settle()
        lab.sim.faults.drift_k = 5.0
        assert status(lab) == Code.TEMP_DRIFT
        with pytest.raises(DeviceTimeoutError, match=r"sensor is at -6\d"):
            lab.camera.settle()


def test_the_safe_state_keeps_the_cooler_on() -> None:
    with rig(cooling=COLD) as lab:
        lab.camera.settle()
        lab.camera.safe_state()
        assert lab.sim.cooler.is_on
        assert status(lab) == Code.TEMP_STABILIZED


@pytest.mark.parametrize(("after", "is_on"), [("keep", True), ("off", False)])
def test_closing_leaves_the_cooler_as_the_settings_say(after: str, is_on: bool) -> None:
    with rig(cooling=COLD, cooler_after_close=after) as lab:
        lab.camera.settle()
    assert lab.sim.cooler.is_on == is_on
    lab.clock.sleep(600.0)
    assert lab.sim.cooler.temperature_c == pytest.approx(-70.0 if is_on else 20.0, abs=0.1)


def test_a_camera_that_stayed_cold_is_ready_at_once_when_it_is_opened_again() -> None:
    with rig(cooling=COLD) as lab:
        lab.camera.settle()
    lab.camera.open()
    start_s = lab.clock.now()
    lab.camera.settle()
    assert lab.clock.now() - start_s < 10.0
    lab.camera.close()


def test_a_closed_camera_does_not_settle() -> None:
    with pytest.raises(DeviceError, match="not open"):
        Rig(cooling=COLD).camera.settle()


def test_looking_for_a_serial_number_leaves_other_cameras_cold() -> None:
    lab = Rig(serial=4711)
    lab.sim.cooler.set_temperature(-70)
    lab.sim.cooler.switch_on()
    with pytest.raises(DeviceError, match="expected 4711"):
        lab.camera.open()
    assert lab.sim.cooler.is_on
