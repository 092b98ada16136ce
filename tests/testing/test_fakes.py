import threading

import numpy as np
import pytest

from labseq.errors import DeviceError, StopRequested, TransientError
from labseq.guard import Guard
from labseq.model import Frame, Plan, TargetPattern
from labseq.testing.fakes import (
    FakeClock,
    Hang,
    RecordingCamera,
    RecordingDevice,
    RecordingObserver,
    ScriptedDetector,
    ScriptedPlanner,
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


def test_a_lab_is_as_large_as_its_occupancies() -> None:
    lab = fake_lab([np.zeros((2, 3)), np.ones((2, 3))], fill=[[1, 0, 0], [0, 0, 1]])
    assert lab.grid.shape == (2, 3)
    assert lab.target.n_atoms == 2
    frame = Frame(np.zeros((4, 4), np.uint16), 0.045, 0.0)
    seen = [int(lab.detector.detect(frame)[0].sum()) for _ in range(3)]
    assert seen == [0, 6, 6]


def test_an_image_taken_with_a_lab_is_what_the_test_scripted() -> None:
    from labseq.model import ShotRecord
    from labseq.sequencer.shot import RunningShot

    lab = fake_lab([[[1, 0]], [[1, 1]]])
    lab.camera.open()
    observer = RecordingObserver()
    shot = RunningShot(lab, Guard(lab.stop), ShotRecord(0, 0, 0, ""), observer.event)
    assert shot.take_image(0.045).tolist() == [[True, False]]
    assert shot.take_image(0.045).tolist() == [[True, True]]
    assert shot.elapsed_s == pytest.approx(0.09)
    assert lab.calls.names("camera")[1:4] == ["camera.arm", "camera.trigger", "camera.read"]
    assert observer.names.count("image") == 2
    assert [values["filling_fraction"] for values in observer.of("image")] == [0.5, 1.0]


def test_deciders_follow_their_script() -> None:
    plans = [Plan.from_batches([]), Plan.from_batches([([(0, 0)], [(0, 1)])])]
    planner = ScriptedPlanner(plans)
    target = TargetPattern(np.ones((1, 2), np.bool_), np.zeros((1, 2), np.bool_))
    occupancy = np.array([[True, False]])
    assert [planner.plan(occupancy, target).n_batches for _ in range(3)] == [0, 1, 1]
    occupancy[0, 0] = False
    assert planner.occupancies[0].tolist() == [[True, False]]
    with pytest.raises(DeviceError, match="expected \\(4, 4\\)"):
        ScriptedDetector([occupancy], (4, 4)).detect(Frame(np.zeros((2, 2), np.uint16), 0.1, 0.0))
    with pytest.raises(ValueError, match="at least one occupancy"):
        ScriptedDetector([])


def test_the_fake_clock_notes_waits_and_hears_the_stop() -> None:
    clock = FakeClock()
    clock.sleep(1.0)
    clock.stop.request(15)
    with pytest.raises(StopRequested):
        clock.sleep(2.0)
    assert clock.sleeps == [1.0]
    assert clock.now() == 1.0
