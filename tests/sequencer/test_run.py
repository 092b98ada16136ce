"""Whole runs on fakes: order of calls, what is recorded, retries, changes between shots."""

import gc
import re
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.builtin.steps import DeviceStep, WaitStep
from labseq.errors import DeviceError, DeviceTimeoutError, LabseqError, StopRequested, TransientError
from labseq.messages import MAX_ERROR
from labseq.model.policies import Timeouts
from labseq.sequencer.run import TRANSITIONS, State
from labseq.testing.fakes import ListSink
from labseq.watchdog import Watchdog
from tests.hostile import HOSTILE
from tests.sequencer.rig import EMPTY, FULL, IMAGE, LOAD, SAFE_ORDER, Rig, given


def test_devices_open_before_and_are_safe_and_closed_after(monkeypatch):
    rig, n_safe = Rig(), []

    def count(name, values):
        if name == "safe_state":
            n_safe.append((values["device"], len(rig.made_safe())))

    monkeypatch.setattr(rig.observer, "event", count)
    rig.run()
    names = rig.lab.calls.names()
    opened = [n for n in names if n.endswith(".open")]
    assert opened == ["static_tweezers.open", "camera.open", "shutter.open", "mobile_tweezers.open"]
    assert names[-4:] == [f"{device}.close" for device in SAFE_ORDER]
    assert rig.made_safe() == SAFE_ORDER
    assert n_safe == [(name, 4) for name in SAFE_ORDER]  # observers are called after all devices are safe
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
    assert list(steps) == ["step_0_load", "step_1_image", "step_2_pause"]
    assert [t.duration_s for t in steps.values()] == pytest.approx([0.5, 0.045, 0.2])
    assert [t.budget_s for t in steps.values()] == pytest.approx([0.5, 0.045, 0.2])
    assert not any(t.over_budget for t in steps.values())


def test_the_simulation_is_called_for_each_shot_and_load():
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


def test_a_transient_failure_repeats_the_shot_and_keeps_the_attempt():
    rig = Rig(fail_on={"camera.read": [TransientError("frame lost", "camera"), None]})
    rig.run(2)
    outcome = [(s.shot_index, s.attempt, s.status) for s in rig.sink.shots]
    assert outcome == [(0, 0, "failed"), (0, 1, "complete"), (1, 0, "complete")]
    assert rig.sink.shots[0].error == "TransientError: camera: frame lost"
    assert rig.observer.names.count("shot_repeated") == 1
    recovered = rig.lab.calls.names()[: rig.lab.calls.names().index("camera.safe_state") + 1]
    assert recovered[-2:] == ["mobile_tweezers.safe_state", "camera.safe_state"]


def test_a_recovery_that_fails_keeps_the_attempt():
    lost, jammed = TransientError("frame lost", "camera"), OSError("jammed")
    rig = Rig(fail_on={"camera.read": lost, "camera.safe_state": [jammed]})
    with pytest.raises(DeviceError, match=r"camera: safe_state\(\) raised OSError: jammed"):
        rig.run()
    assert rig.record().status == "failed"
    assert rig.record().timing
    assert rig.made_safe() == ["mobile_tweezers", "camera", *SAFE_ORDER]
    assert not rig.unsafe


def test_between_shots_a_device_is_made_safe_closed_and_opened_again():
    rig = Rig()
    rig.sequencer.open()
    rig.sequencer.take(0)
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
    rig.sequencer.take(1)
    assert rig.record().parameters == {"profile.camera.gain": 2}
    assert not rig.sequencer.shut_down()


@pytest.mark.parametrize(
    ("ended_well", "camera", "leaves"),
    [(True, None, True), (True, None, False), (True, None, None), (False, None, True), (True, "stuck", True)],
)
def test_static_tweezers_stay_on_only_after_a_good_run_with_all_else_safe(ended_well, camera, leaves):
    rig = Rig(fail_on={"camera.safe_state": DeviceError("camera", camera)} if camera else {})
    asked = []

    def leave_on(_):
        asked.append(rig.made_safe())
        if leaves is None:
            raise DeviceError("static_tweezers", "the stream is dead")
        return leaves

    tweezers = rig.lab.static_tweezers
    tweezers.__class__ = type("LeftOn", (type(tweezers),), {"leave_on": leave_on})
    rig.sequencer.open()
    rig.sequencer.take(0)
    rig.sequencer.shut_down(ended_well=ended_well)
    assert asked == ([SAFE_ORDER[:-1]] if ended_well and not camera else [])
    assert rig.made_safe() == SAFE_ORDER, "of no effect on a device that has disconnected"
    assert rig.observer.of("left_on") == ([{"device": "static_tweezers"}] if asked and leaves else [])
    warnings = [event["text"] for event in rig.observer.of("warning")]
    assert len(warnings) == (leaves is None)
    assert all("static_tweezers" in text and "the stream is dead" in text for text in warnings)


def test_a_change_of_planner_and_steps_touches_no_device():
    rig = Rig()
    rig.sequencer.open()
    done = len(rig.lab.calls.names())
    rig.sequencer.change(rig.lab, (LOAD,), {})
    assert len(rig.lab.calls.names()) == done
    rig.sequencer.take(0)
    assert [t.stage for t in rig.record().timing if t.stage.startswith("step")] == ["step_0_load"]
    assert not rig.sequencer.shut_down()


def test_a_device_that_fails_to_reopen_leaves_all_devices_safe():
    rig = Rig(fail_on={"camera.safe_state": DeviceError("camera", "stuck")})
    rig.sequencer.open()
    with pytest.raises(DeviceError, match="stuck"):
        rig.sequencer.change(rig.lab, (LOAD,), {}, {"camera"})
    assert rig.sequencer.shut_down().keys() == {"camera"}
    assert rig.made_safe()[1:] == SAFE_ORDER


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "detect\\(\\) returned NoneType"),
        ((np.ones((3, 2), bool), np.ones((2, 2))), r"the occupancy is bool \(3, 2\); expected bool \(2, 2\)"),
    ],
)
def test_a_detector_of_the_wrong_shape_is_named(answer, message):
    class Wrong:
        def detect(self, frame):
            return answer

    rig = Rig(occupancies=[FULL], detector=Wrong())
    with pytest.raises(DeviceError, match=message) as caught:
        rig.run()
    assert caught.value.device == "detector"
    assert rig.made_safe() == SAFE_ORDER


def test_a_camera_that_returns_no_frame_is_named():
    rig = Rig()
    vars(rig.lab.camera)["read"] = lambda timeout_s: np.zeros((2, 2))
    with pytest.raises(DeviceError, match=r"camera: read\(\) returned ndarray; expected a Frame"):
        rig.run()


@pytest.mark.parametrize("method", ["begin_shot", "close"])
def test_a_simulation_that_fails_is_named_and_all_devices_are_safe(method):
    rig = Rig(simulated=True)

    def fail(*args):
        raise ValueError("nothing there")

    vars(rig.lab.simulation)[method] = fail
    if method == "close":
        rig.run()
        closed = rig.observer.of("closed")[-1]
        assert (closed["device"], closed["ok"]) == ("simulation", False)
        assert "ValueError: nothing there" in closed["error"]
    else:
        with pytest.raises(DeviceError, match=r"simulation: fail\(\) raised ValueError: nothing there"):
            rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert rig.sequencer.state is State.CLOSED


@pytest.mark.parametrize(
    ("method", "error"),
    [("plan_timeline", SystemExit(0)), ("run", KeyError("typo")), ("run", KeyboardInterrupt())],
)
def test_any_error_of_a_third_party_step_is_named(method, error):
    class Broken:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return []

        def run(self, shot):
            return None

    def fail(self, given):
        raise error

    setattr(Broken, method, fail)
    with pytest.raises(LabseqError, match=rf"step 0 \(mine\) raised {type(error).__name__}"):
        Rig(steps=(("mine", Broken()),)).run()


@pytest.mark.parametrize("answer", [None, [None]])
def test_a_timeline_that_is_none_is_named(answer):
    class Broken:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return answer

        def run(self, shot):
            return None

    with pytest.raises(LabseqError, match=r"step 0 \(mine\) raised (Type|Attribute)Error"):
        Rig(steps=(("mine", Broken()),))


def test_an_error_of_a_step_names_the_line_of_its_code(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.modules[__name__], "LABSEQ_API", 1, raising=False)  # as a plugin's module has it

    class Broken:
        needs_image = takes_image = False

        def plan_timeline(self, context):
            return context.durtion

        def run(self, shot):
            return None

    line = Broken.plan_timeline.__code__.co_firstlineno + 1
    with pytest.raises(LabseqError, match=re.escape(f"'durtion' ({__file__}:{line})") + "$"):
        Rig(steps=(("mine", Broken()),))


def test_a_device_that_hangs_delays_the_safe_state_of_no_other(monkeypatch: pytest.MonkeyPatch):
    static_is_safe = threading.Event()
    rig = Rig(fail_on={"camera.read": DeviceError("camera", "unplugged")})
    for device, act in ((rig.lab.camera, static_is_safe.wait), (rig.lab.static_tweezers, static_is_safe.set)):
        made_safe = device.safe_state
        monkeypatch.setattr(device, "safe_state", lambda act=act, made_safe=made_safe: (made_safe(), act()))
    with pytest.raises(DeviceError, match="unplugged"):
        rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert not rig.unsafe


def test_every_open_state_leads_to_safety():
    after_safety = {State.CLOSED, State.MAKING_SAFE, State.SAFE, State.CLOSING}
    for state in set(State) - after_safety:
        assert State.MAKING_SAFE in TRANSITIONS[state], state


def test_devices_are_never_closed_before_they_are_safe():
    before_closing = {state for state, then in TRANSITIONS.items() if State.CLOSING in then}
    assert before_closing == {State.SAFE}


def test_no_device_is_made_safe_beside_an_open_that_is_only_slow(monkeypatch):
    rig, looks, release = Rig(), [], threading.Event()
    camera, opened = rig.lab.camera, rig.lab.camera.open

    def now():
        if rig.lab.stop.is_set:
            looks.append(None)
        if len(looks) == 3:  # by now the stop request has been seen
            release.set()
        return 0.0

    def slow():
        rig.lab.stop.request(15)
        assert release.wait(30.0)
        opened()

    monkeypatch.setattr(camera, "open", slow)
    monkeypatch.setattr("labseq.guard.GRACE_S", 0.0)
    monkeypatch.setattr("labseq.guard.time", SimpleNamespace(monotonic=now))
    with pytest.raises(StopRequested):
        rig.run()
    names = rig.lab.calls.names()
    assert names[:3] == ["static_tweezers.open", "camera.open", "mobile_tweezers.safe_state"]
    assert rig.made_safe() == SAFE_ORDER


CALLS = [
    *(f"{name}.{call}" for name in SAFE_ORDER for call in ("open", "safe_state", "close")),
    *("camera.arm", "camera.trigger", "camera.read", "static_tweezers.start"),
]


@pytest.mark.parametrize("error", HOSTILE)
def test_any_error_of_any_call_leaves_every_device_safe_and_closed_once(error):
    for call in CALLS:
        device, method = call.split(".")
        rig = Rig(fail_on={call: HOSTILE[error]})
        if method in ("safe_state", "close"):
            rig.run()
            text = next(v["error"] for v in rig.observer.of("closed" if method == "close" else method)
                        if v["device"] == device)  # fmt: skip
        else:
            with pytest.raises(DeviceError) as caught:
                rig.run()
            assert caught.value.exit_code == 3
            text = str(caught.value)
            if method != "open" and call != "static_tweezers.start":
                assert rig.record().status == "failed"
                assert len(rig.record().error) < 2 * MAX_ERROR
        assert text.isprintable(), call
        assert 0 < len(text) < 2 * MAX_ERROR, call
        assert rig.made_safe() == SAFE_ORDER, call
        assert [c.device for c in rig.lab.calls if c.method == "close"] == SAFE_ORDER, call
        assert rig.sequencer.state is State.CLOSED


def test_without_threads_the_devices_are_made_safe_all_the_same(monkeypatch):
    rig = Rig()
    rig.sequencer.open()
    rig.sequencer.guard.end()

    def refuse(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert not rig.sequencer.shut_down()
    assert rig.made_safe() == SAFE_ORDER


def test_safety_comes_before_the_record():
    order = []

    class Sink(ListSink):
        def write_shot(self, shot):
            order.append("written")
            super().write_shot(shot)

    rig = Rig(sink=Sink(), fail_on={"camera.read": RuntimeError("cable")})
    rig.observer.event = lambda name, values: order.append(name)
    with pytest.raises(DeviceError):
        rig.run()
    assert order.index("written") > max(i for i, name in enumerate(order) if name == "safe_state")
    assert rig.record().status == "failed"
    assert rig.record().timing


@pytest.mark.parametrize("failing", SAFE_ORDER)
def test_one_device_that_cannot_be_made_safe_never_stops_the_others(failing):
    rig = Rig(fail_on={f"{failing}.safe_state": OSError("gone")})
    rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert list(rig.unsafe) == [failing]
    events = {v["device"]: v["ok"] for v in rig.observer.of("safe_state")}
    assert events == {device: device != failing for device in SAFE_ORDER}


def test_a_safe_state_that_hangs_is_given_up():
    timeouts = Timeouts(call_s=10.0, safe_state_s=0.05, plan_s=10.0)
    rig = Rig(hang_on={"mobile_tweezers.safe_state"}, timeouts=timeouts)
    rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert list(rig.unsafe) == ["mobile_tweezers"]


def test_a_device_that_hangs_is_named_and_still_made_safe():
    timeouts = Timeouts(call_s=0.05, safe_state_s=10.0, plan_s=10.0)
    rig = Rig(hang_on={"camera.trigger"}, timeouts=timeouts)
    with pytest.raises(DeviceTimeoutError, match=r"camera: trigger\(\) did not answer within"):
        rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert not rig.unsafe
    rig.lab.hangs["camera.trigger"].release.set()


def test_a_stop_request_between_shots_ends_the_run():
    rig = Rig()
    rig.observer.event = lambda name, values: rig.lab.stop.request(15) if name == "shot_finished" else None
    with pytest.raises(StopRequested) as caught:
        rig.run(5)
    assert caught.value.signal_number == 15
    assert [s.status for s in rig.sink.shots] == ["complete"]
    assert rig.made_safe() == SAFE_ORDER


def test_a_stop_request_in_a_shot_keeps_what_it_has():
    stopping = ("stop", WaitStep(given(duration=1.0)))
    rig = Rig(steps=(LOAD, IMAGE, stopping))
    rig.observer.event = lambda name, values: rig.lab.stop.request() if name == "image" else None
    with pytest.raises(StopRequested):
        rig.run()
    record = rig.record()
    assert (record.status, len(record.images)) == ("interrupted", 1)
    assert rig.made_safe() == SAFE_ORDER


def test_a_stop_request_in_a_recovery_lets_the_driver_ramp_down():
    rig = Rig(fail_on={"camera.read": TransientError("frame lost", "camera")})
    ramps = []

    def ramp_down():
        rig.lab.stop.request()
        rig.lab.clock.sleep(0.01)
        ramps.append("down")

    vars(rig.lab.mobile_tweezers)["safe_state"] = ramp_down
    vars(rig.lab.mobile_tweezers)["close"] = lambda: rig.lab.clock.sleep(0.01)
    with pytest.raises(StopRequested):
        rig.run()
    assert ramps == ["down", "down"]
    assert [s.status for s in rig.sink.shots] == ["failed"]
    assert not rig.unsafe
    assert all(values["ok"] for values in rig.observer.of("closed"))


@pytest.mark.parametrize("failing", ["mobile_tweezers", "camera"])
def test_a_device_that_cannot_be_made_safe_after_a_failed_shot_is_reported(failing):
    rig = Rig(fail_on={"camera.read": RuntimeError("cable"), f"{failing}.safe_state": OSError("gone")})
    with pytest.raises(DeviceError, match="cable"):
        rig.run()
    assert list(rig.unsafe) == [failing]
    assert list(rig.sequencer.shut_down()) == [failing]
    assert rig.made_safe() == SAFE_ORDER


def test_a_shutdown_that_was_interrupted_can_be_repeated():
    rig = Rig()
    rig.sequencer.open()

    def fail(name, values):
        raise MemoryError

    tell, rig.observer.event = rig.observer.event, fail
    with pytest.raises(MemoryError):
        rig.sequencer.shut_down()
    rig.observer.event = tell
    assert not rig.sequencer.shut_down()
    assert rig.made_safe() == SAFE_ORDER
    assert rig.sequencer.state is State.CLOSED


def test_nothing_is_reported_between_a_frame_and_the_start_of_the_moves(monkeypatch):
    settings = given(cycles=1, exposure=0.02, stop_when="never", window_mode="early", window_of=lambda _: 1.0)
    steps = LOAD, IMAGE, ("rearrange", RearrangeStep(settings))
    rig, seen = Rig(steps, occupancies=[[[1, 0]], [[0, 1]]], fill=[[0, 1]]), []
    event = rig.observer.event

    def keep(name, values):
        seen.append((name, len(rig.lab.calls)))
        event(name, values)

    monkeypatch.setattr(rig.observer, "event", keep)
    rig.run()
    names = rig.lab.calls.names()
    frame, play = (1 + names.index(name) for name in ("camera.read", "mobile_tweezers.play"))
    assert {name for name, n_calls in seen if frame <= n_calls < play} <= {"stage"}  # the exposure's
    later = [name for name, n_calls in seen if n_calls >= play]
    assert later.index("image") < later.index("cycle")
    assert gc.isenabled()


def test_the_watchdog_keeps_a_device_that_is_not_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, forgotten = Rig(fail_on={"camera.safe_state": OSError("cable")}), list[str]()
    monkeypatch.setattr(Watchdog, "forget", lambda _, names: forgotten.extend(names))
    rig.run()
    assert set(rig.unsafe) == {"camera"}
    assert set(forgotten) == {*SAFE_ORDER} - {"camera"}
