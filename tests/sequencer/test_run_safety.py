"""Every way out of a run on fakes."""

import threading
from types import SimpleNamespace

import pytest

from labseq.builtin.steps import WaitStep
from labseq.errors import DeviceError, DeviceTimeoutError, RecordingError, StopRequested, TransientError
from labseq.sequencer import State
from labseq.sequencer.lab import Timeouts
from labseq.testing.fakes import ListSink

from .rig import IMAGE, LOAD, SAFE_ORDER, Rig, given


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


@pytest.mark.parametrize(
    "call",
    [
        "camera.arm",
        "camera.trigger",
        "camera.read",
        "static_tweezers.start",
        "static_tweezers.open",
        "mobile_tweezers.open",
    ],
)
def test_any_error_leaves_every_device_safe(call):
    rig = Rig(fail_on={call: RuntimeError("cable")})
    with pytest.raises(DeviceError, match="raised RuntimeError: cable"):
        rig.run()
    assert rig.made_safe() == SAFE_ORDER
    assert rig.sequencer.state is State.CLOSED


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
    told = {v["device"]: v["ok"] for v in rig.observer.of("safe_state")}
    assert told == {device: device != failing for device in SAFE_ORDER}


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


def test_a_disk_that_is_full_ends_the_run_safely():
    class Full(ListSink):
        def write_shot(self, shot):
            raise RecordingError("shots", "no space left")

    rig = Rig(sink=Full())
    with pytest.raises(RecordingError):
        rig.run(3)
    assert rig.made_safe() == SAFE_ORDER


def test_a_stop_request_in_a_recovery_lets_the_driver_ramp_down():
    rig = Rig(fail_on={"camera.read": TransientError("frame lost", "camera")})
    ramps = []

    def ramp_down():
        rig.lab.stop.request()
        rig.lab.clock.sleep(0.01)
        ramps.append("down")

    vars(rig.lab.mobile_tweezers)["safe_state"] = ramp_down
    with pytest.raises(StopRequested):
        rig.run()
    assert ramps == ["down", "down"]
    assert [s.status for s in rig.sink.shots] == ["failed"]
    assert not rig.unsafe


@pytest.mark.parametrize("failing", SAFE_ORDER)
def test_a_device_that_cannot_be_made_safe_in_a_shot_that_failed_is_told(failing):
    rig = Rig(fail_on={"camera.read": RuntimeError("cable"), f"{failing}.safe_state": OSError("gone")})
    with pytest.raises(DeviceError, match="cable"):
        rig.run()
    assert list(rig.unsafe) == [failing]
    assert list(rig.sequencer.shut_down()) == [failing]
    assert rig.made_safe() == SAFE_ORDER


def test_nobody_is_told_before_all_devices_are_safe():
    rig = Rig()
    safe_when_told = []
    rig.observer.event = lambda name, values: (
        safe_when_told.append(len(rig.made_safe())) if name == "safe_state" else None
    )
    rig.run()
    assert safe_when_told == [4, 4, 4, 4]


def test_an_ending_that_was_cut_short_begins_anew():
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
