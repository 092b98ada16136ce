import threading

import pytest

from labseq.errors import StopRequested, TransientError
from labseq.testing.fakes import (
    FakeClock,
    Hang,
    RecordingCamera,
    RecordingDevice,
    fake_lab,
)


def test_devices_of_a_lab_share_calls_and_clock() -> None:
    lab = fake_lab(devices=("shutter", "laser"))
    for _, device in lab.hardware():
        device.open()
    lab.clock.sleep(0.5)
    lab.devices["laser"].command("on", power=0.5)
    assert lab.calls.names() == [
        "static_tweezers.open",
        "camera.open",
        "shutter.open",
        "laser.open",
        "mobile_tweezers.open",
        "laser.command",
    ]
    assert str(lab.calls[-1]) == "laser.command('on', power=0.5)"
    assert [call.t_s for call in lab.calls.of("laser.command")] == [0.5]
    assert lab.calls.names("laser", "shutter") == ["shutter.open", "laser.open", "laser.command"]


def test_a_planned_failure_comes_at_every_call() -> None:
    camera = RecordingCamera(fail_on={"open": OSError("cable")})
    for _ in range(2):
        with pytest.raises(OSError, match="cable"):
            camera.open()
    assert camera.calls.names() == ["camera.open", "camera.open"]


def test_planned_failures_come_in_turn_and_then_no_more() -> None:
    lost = TransientError("lost")
    device = RecordingDevice(fail_on={"describe": [None, lost]})
    device.describe()
    with pytest.raises(TransientError, match="lost"):
        device.describe()
    device.describe()


def test_a_call_hangs_until_it_is_released() -> None:
    hang = Hang()
    device = RecordingDevice(hang_on={"open": hang})
    thread = threading.Thread(target=device.open)
    thread.start()
    assert hang.reached.wait(10)
    assert not device.is_open
    hang.release.set()
    thread.join(10)
    assert device.is_open


def test_hangs_of_a_lab_are_named_by_the_call() -> None:
    lab = fake_lab(hang_on={"camera.open"})
    lab.hangs["camera.open"].release.set()
    lab.camera.open()
    assert lab.hangs["camera.open"].reached.is_set()


@pytest.mark.parametrize("call", ["camera.raed", "laser.open", "read"])
def test_a_call_that_does_not_exist_cannot_be_planned(call: str) -> None:
    with pytest.raises(ValueError, match=f"no fake has the call '{call}'"):
        fake_lab(fail_on={call: OSError()})
    with pytest.raises(ValueError, match=f"no fake has the call '{call}'"):
        fake_lab(hang_on={call})


def test_the_fake_clock_notes_waits_and_hears_the_stop() -> None:
    clock = FakeClock()
    clock.sleep(1.0)
    clock.stop.request(15)
    with pytest.raises(StopRequested):
        clock.sleep(2.0)
    assert clock.sleeps == [1.0]
    assert clock.now() == 1.0
