"""Whole runs on fakes: order of calls, what is recorded, retries, changes between shots."""

import pytest

from labseq.builtin.steps import DeviceStep, WaitStep
from labseq.errors import DeviceError, TransientError
from labseq.model import Frame
from labseq.sequencer import State

from .rig import EMPTY, FULL, IMAGE, LOAD, SAFE_ORDER, Rig, given


def test_devices_open_before_and_are_safe_and_closed_after():
    rig = Rig()
    rig.run()
    names = rig.lab.calls.names()
    opened = [n for n in names if n.endswith(".open")]
    assert opened == ["static_tweezers.open", "camera.open", "shutter.open", "mobile_tweezers.open"]
    assert names[-4:] == [f"{device}.close" for device in SAFE_ORDER]
    assert rig.made_safe() == SAFE_ORDER
    assert not rig.unsafe
    assert rig.sequencer.state is State.CLOSED


def test_a_complete_shot_is_judged_on_its_last_image():
    rig = Rig(occupancies=[FULL, EMPTY], steps=(LOAD, IMAGE, IMAGE))
    rig.run()
    record = rig.record()
    assert (record.status, record.success, record.filling_fraction) == ("complete", False, 0.0)
    assert [image.occupancy.sum() for image in record.images] == [4, 0]
    assert record.t_start_utc <= record.t_end_utc


def test_every_step_is_timed_against_its_budget():
    rig = Rig(steps=(LOAD, IMAGE, ("pause", WaitStep(given(duration=0.2)))))
    rig.run()
    steps = {t.stage: t for t in rig.record().timing if t.stage.startswith("step")}
    assert list(steps) == ["step 0 load", "step 1 image", "step 2 pause"]
    assert [t.duration_s for t in steps.values()] == pytest.approx([0.5, 0.045, 0.2])
    assert [t.budget_s for t in steps.values()] == pytest.approx([0.5, 0.045, 0.2])
    assert not any(t.over_budget for t in steps.values())


def test_the_simulation_is_told_of_shots_and_loading():
    rig = Rig(simulated=True)
    rig.run(2)
    names = rig.lab.calls.names("simulation")
    assert names[0] == "simulation.open"
    assert names[-1] == "simulation.close"
    assert names.count("simulation.begin_shot") == names.count("simulation.load") == 2


def test_random_streams_follow_shot_and_attempt():
    drawn = []

    class Draw:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return []

        def run(self, shot):
            drawn.append(rig.lab.random_streams[0].shot.random())

    rig = Rig(steps=(("draw", Draw()),))
    rig.run(3)
    first, drawn = drawn, []
    rig = Rig(steps=(("draw", Draw()),))
    rig.run(3)
    assert drawn == first
    assert len(set(drawn)) == 3


def test_a_device_step_sends_its_command():
    step = DeviceStep(given(name="shutter", do="on", arguments={"level": 2}, timeout=1.0))
    rig = Rig(steps=(("device", step),))
    rig.run()
    (call,) = rig.lab.calls.of("shutter.command")
    assert (call.args, dict(call.kwargs)) == (("on",), {"level": 2})
    assert rig.observer.of("device_command") == [
        {"shot": 0, "device": "shutter", "command": "on", "arguments": {"level": 2}}
    ]


def test_frames_are_kept_as_they_came():
    rig = Rig()
    rig.run()
    (image,) = rig.record().images
    assert isinstance(image.frame, Frame)
    assert image.exposure_s == 0.045


def test_a_transient_failure_repeats_the_shot_and_keeps_the_attempt():
    rig = Rig(fail_on={"camera.read": [TransientError("frame lost", "camera"), None]})
    rig.run(2)
    outcome = [(s.shot_index, s.attempt, s.status) for s in rig.sink.shots]
    assert outcome == [(0, 0, "failed"), (0, 1, "complete"), (1, 0, "complete")]
    assert rig.sink.shots[0].error == "TransientError: camera: frame lost"
    assert rig.observer.names.count("shot_repeated") == 1
    recovered = rig.lab.calls.names()[: rig.lab.calls.names().index("camera.safe_state") + 1]
    assert recovered[-2:] == ["mobile_tweezers.safe_state", "camera.safe_state"]


def test_attempts_run_out():
    rig = Rig(attempts=2, fail_on={"camera.read": TransientError("frame lost", "camera")})
    with pytest.raises(TransientError):
        rig.run(2)
    assert [(s.shot_index, s.attempt, s.status) for s in rig.sink.shots] == [
        (0, 0, "failed"),
        (0, 1, "failed"),
    ]
    assert rig.made_safe()[-4:] == SAFE_ORDER


def test_a_recovery_that_fails_keeps_the_attempt():
    lost, jammed = TransientError("frame lost", "camera"), OSError("jammed")
    rig = Rig(fail_on={"camera.read": lost, "camera.safe_state": [jammed]})
    with pytest.raises(DeviceError, match=r"camera: safe_state\(\) raised OSError: jammed"):
        rig.run()
    assert rig.record().status == "failed"
    assert rig.record().timing
    assert rig.made_safe() == ["mobile_tweezers", "camera", *SAFE_ORDER]
    assert not rig.unsafe


def test_between_shots_a_device_is_closed_through_its_safe_state_and_opened_anew():
    rig = Rig()
    rig.sequencer.open()
    rig.sequencer.run([0])
    done = len(rig.lab.calls.names())
    rig.sequencer.change(rig.lab, (LOAD, IMAGE), {"profile.camera.gain": 2}, {"camera", "static_tweezers"})
    assert rig.lab.calls.names()[done:] == [
        "camera.safe_state",
        "static_tweezers.safe_state",
        "camera.close",
        "static_tweezers.close",
        "static_tweezers.open",
        "camera.open",
        "static_tweezers.load",
        "static_tweezers.start",
    ]
    rig.sequencer.run([1])
    assert rig.record().parameters == {"profile.camera.gain": 2}
    assert not rig.sequencer.shut_down()


def test_a_change_of_planner_and_steps_touches_no_device():
    rig = Rig()
    rig.sequencer.open()
    done = len(rig.lab.calls.names())
    rig.sequencer.change(rig.lab, (LOAD,), {})
    assert len(rig.lab.calls.names()) == done
    rig.sequencer.run([0])
    assert [t.stage for t in rig.record().timing if t.stage.startswith("step")] == ["step 0 load"]
    assert not rig.sequencer.shut_down()


def test_a_device_that_fails_to_reopen_leaves_all_devices_safe():
    rig = Rig(fail_on={"camera.safe_state": DeviceError("camera", "stuck")})
    rig.sequencer.open()
    with pytest.raises(DeviceError, match="stuck"):
        rig.sequencer.change(rig.lab, (LOAD,), {}, {"camera"})
    assert rig.sequencer.shut_down().keys() == {"camera"}
    assert rig.made_safe()[1:] == SAFE_ORDER
