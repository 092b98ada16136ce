import threading
from contextlib import suppress
from functools import partial

import pytest

from labseq.errors import (
    DeviceError,
    DeviceHungError,
    DeviceTimeoutError,
    LimitError,
    PlanError,
    StopRequested,
)
from labseq.guard import Guard, StopFlag


@pytest.fixture
def stop():
    return StopFlag()


@pytest.fixture
def guard(stop):
    guard = Guard(stop)
    yield guard
    guard.end()


def test_a_call_returns_what_the_function_returns(guard):
    assert guard.call("camera", 10.0, lambda a, b: a + b, 1, b=2) == 3


def test_all_calls_of_a_device_come_from_one_thread_of_its_own(guard):
    names = {guard.call("camera", 10.0, lambda: threading.current_thread().name) for _ in range(5)}
    assert names == {"labseq camera"}


def test_labseq_errors_pass_as_they_are(guard):
    def refuse():
        raise LimitError("exposure", 100, 10)

    with pytest.raises(LimitError, match="exposure is 100; the limit is 10"):
        guard.call("camera", 10.0, refuse)


@pytest.mark.parametrize(
    ("owner", "kind", "error"),
    [
        ("camera", DeviceError, ZeroDivisionError("0")),
        ("planner", PlanError, OSError()),
        ("camera", DeviceError, SystemExit(3)),
    ],
)
def test_anything_else_is_named(guard, owner, kind, error):
    def fail():
        raise error

    with pytest.raises(kind, match=f"raised {type(error).__name__}") as caught:
        guard.call(owner, 10.0, fail)
    assert caught.value.__cause__ is error


def test_a_call_that_hangs_is_given_up(guard):
    release = threading.Event()
    with pytest.raises(DeviceTimeoutError, match=r"camera: wait\(\) did not answer within 0\.02 s") as caught:
        guard.call("camera", 0.02, release.wait)
    assert caught.value.timeout_s == 0.02
    release.set()


def test_a_planner_that_hangs_is_a_plan_error(guard):
    release = threading.Event()
    with pytest.raises(PlanError, match="did not answer within"):
        guard.call("planner", 0.02, release.wait)
    release.set()


def test_after_a_hang_the_device_can_still_be_made_safe(guard):
    release, safe = threading.Event(), threading.Event()
    with pytest.raises(DeviceTimeoutError):
        guard.call("camera", 0.02, release.wait)
    guard.call_despite_stop("camera", 10.0, safe.set)
    assert safe.is_set()
    assert not release.is_set()
    release.set()


def test_no_call_is_made_after_a_stop_request(guard, stop):
    called = threading.Event()
    stop.request()
    with pytest.raises(StopRequested):
        guard.call("camera", 10.0, called.set)
    assert not called.is_set()
    guard.call_despite_stop("camera", 10.0, called.set)  # as safe states are
    assert called.is_set()


def test_no_call_is_made_while_a_stop_request_is_held(guard, stop):
    called = threading.Event()
    stop.request()
    with stop.held(), pytest.raises(StopRequested):
        guard.call("static_tweezers", 10.0, called.set)  # a step that was abandoned and has come back
    assert not called.is_set()


def test_a_step_that_hangs_is_left_at_a_stop_request(guard, stop, monkeypatch):
    monkeypatch.setattr("labseq.guard.SHOT_GRACE_S", 0.01)
    release = threading.Event()

    def hang():
        stop.request(15)
        release.wait()

    with pytest.raises(StopRequested, match="SIGTERM"):
        guard.run_shot(partial(hang))
    release.set()


def test_a_stop_request_does_not_wait_for_a_call_that_hangs(guard, stop, monkeypatch):
    monkeypatch.setattr("labseq.guard.GRACE_S", 0.01)
    release, entered = threading.Event(), threading.Event()

    def hang():
        entered.set()
        release.wait()

    def ask():
        entered.wait()
        stop.request()

    threading.Thread(target=ask).start()
    with pytest.raises(StopRequested):
        guard.call("camera", 1000.0, hang)
    release.set()


def test_a_call_that_comes_back_in_time_after_a_stop_request_keeps_its_result(guard, stop):
    def answer():
        stop.request()
        return 7

    assert guard.call("camera", 10.0, answer) == 7


def test_a_shot_calls_planner_and_detector_in_its_own_thread(guard):
    guard.direct = frozenset({"planner"})
    threads = {}

    def shot():
        for owner in ("step", "planner", "camera"):
            name = threading.current_thread().name
            threads[owner] = name if owner == "step" else guard.call(owner, 10.0, named)

    def named():
        return threading.current_thread().name

    guard.run_shot(partial(shot))
    assert threads == {"step": "labseq step", "planner": "labseq step", "camera": "labseq camera"}
    assert guard.call("planner", 10.0, named) == "labseq planner"  # not within a shot


@pytest.mark.parametrize(
    ("owner", "error"),
    [("planner", PlanError), ("mobile_tweezers", DeviceHungError), ("step", DeviceHungError)],
)
def test_a_shot_is_abandoned_if_what_it_calls_directly_hangs_and_calls_nothing_after(guard, owner, error):
    guard.direct = frozenset({"planner", "mobile_tweezers"})
    release, ended, called = threading.Event(), threading.Event(), threading.Event()

    def shot():
        try:
            if owner == "step":
                with guard.step("step 0 (load) ", 0.02):
                    release.wait()
            else:
                guard.call(owner, 0.02, release.wait)
        finally:
            with suppress(StopRequested):
                guard.call("camera", 10.0, called.set)
            ended.set()

    with pytest.raises(error, match=r"^.*did not answer within 0\.02 s and is abandoned"):
        guard.run_shot(partial(shot))
    guard.run_shot(partial(lambda: None))  # the next shot has a thread of its own
    guard.call_despite_stop("mobile_tweezers", 10.0, lambda: None)  # as the safe state
    release.set()
    assert ended.wait(10.0)
    assert not called.is_set()


def test_an_error_of_a_direct_call_is_named(guard):
    guard.direct = frozenset({"detector"})

    def detect():
        raise ZeroDivisionError("0")

    with pytest.raises(DeviceError, match=r"detector: detect\(\) raised ZeroDivisionError"):
        guard.run_shot(partial(guard.call, "detector", 10.0, detect))


def test_a_thread_serves_its_owner_again_unless_it_hangs(guard):
    def serve(owner, work):
        call = guard.run(owner, 0.05, partial(work))
        return None if call is None else call.result

    first, again, other = (serve(f"plugin {name}", threading.current_thread) for name in "aab")
    assert first is again
    assert other not in (None, first)  # a thread keeps what a plugin sets there, such as an event loop
    release = threading.Event()
    assert serve("plugin a", release.wait) is None
    another = serve("plugin a", threading.current_thread)
    release.set()
    assert another not in (None, first)
