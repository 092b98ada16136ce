"""What follows when a step fails, takes too long or goes over a budget."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Sequence
from typing import Any

import pytest

from labseq.builtin.rearrange import RearrangeStep
from labseq.errors import (
    DeviceError,
    DeviceHungError,
    DeviceTimeoutError,
    InterlockError,
    LimitError,
    OverBudgetError,
    PlanError,
    StopRequested,
    TransientError,
)
from labseq.model import TimelineEntry
from labseq.model.policies import RunPolicy, StepPolicy, Timeouts
from labseq.roles import Shot, StepContext
from labseq.testing.fakes import RecordingCamera, RecordingDevice
from labseq.testing.fakes.devices import RecordingMobileTweezers
from tests.sequencer.rig import IMAGE, LOAD, SAFE_ORDER, Rig, given

LOST = DeviceTimeoutError("camera", "the frame did not come", 1.0)
SHORT = Timeouts(call_s=0.05)
AGAIN = StepPolicy(on_failure="repeat_shot")


def policy(step: StepPolicy, *, attempts: int = 3, when_exhausted: Any = "stop") -> RunPolicy:
    """For LOAD and IMAGE: this one for the image."""
    return RunPolicy(attempts, when_exhausted, steps=(StepPolicy(), step))


class Slow:
    """Takes its time, and says that it will not."""

    needs_image = takes_image = False
    repeatable = True

    def __init__(self, *duration_s: float) -> None:
        self.durations_s = list(duration_s)

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        return [TimelineEntry("slow", 0.1, 0.1)]

    def run(self, shot: Shot) -> None:
        shot.clock.sleep(self.durations_s.pop(0))
        shot.call("camera", 1.0, shot.static_tweezers.describe)


@pytest.mark.parametrize("error", [LOST, LimitError("x", 2, 1), PlanError("no")])
def test_a_shot_is_repeated_by_the_policy_of_its_step(error: Exception) -> None:
    made = Rig(policy=policy(AGAIN), fail_on={"camera.arm": [error]})
    made.run()
    assert [(shot.attempt, shot.status) for shot in made.sink.shots] == [(0, "failed"), (1, "complete")]
    assert str(error) in made.sink.shots[0].error
    assert made.given_up == {}


def test_without_a_policy_only_transient_failures_are_repeated() -> None:
    made = Rig(policy=RunPolicy(), fail_on={"camera.read": [TransientError("once"), LOST]})
    with pytest.raises(DeviceTimeoutError):
        made.run()
    assert [shot.status for shot in made.sink.shots] == ["failed", "failed"]
    assert made.made_safe()[2:] == SAFE_ORDER


def test_the_policy_of_the_run_is_for_what_is_outside_of_steps() -> None:
    lost = DeviceError("shutter", "no answer")
    again = RunPolicy(otherwise=StepPolicy(on_failure="repeat_shot"))

    class Polled(RecordingDevice):
        polls = 0

        def poll(self) -> dict[str, float]:
            self.polls += 1
            if self.polls == 1:
                raise lost
            return {"power_w": 1.0}

    made = Rig(policy=again)
    object.__setattr__(
        made.lab.devices["shutter"], "__class__", Polled
    )  # fakes are made by their role, with its methods
    made.run()
    assert [shot.status for shot in made.sink.shots] == ["failed", "complete"]


@pytest.mark.parametrize(("when_exhausted", "n_shots"), [("stop", 2), ("skip_point", 4)])
def test_attempts_are_used_up(when_exhausted: str, n_shots: int) -> None:
    made = Rig(
        policy=policy(AGAIN, attempts=2, when_exhausted=when_exhausted),
        fail_on={"camera.read": [LOST, LOST, None, None]},
    )
    if when_exhausted == "stop":
        with pytest.raises(DeviceTimeoutError):
            made.run(3)
    else:
        made.run(3)
        assert made.given_up == {0: f"DeviceTimeoutError: {LOST}"}
    taken = [(shot.shot_index, shot.attempt, shot.status) for shot in made.sink.shots]
    assert taken == [(0, 0, "failed"), (0, 1, "failed"), (1, 0, "complete"), (2, 0, "complete")][:n_shots]


def test_a_shot_is_given_up_at_once() -> None:
    made = Rig(policy=policy(StepPolicy(on_failure="skip_point")), fail_on={"camera.read": [LOST]})
    made.run(2)
    assert [*made.given_up] == [0]
    assert [shot.status for shot in made.sink.shots] == ["failed", "complete"]
    assert made.observer.names.count("shot_finished") == 2
    assert "shot_repeated" not in made.observer.names


def test_devices_that_may_be_busy_are_made_safe_before_the_next_attempt() -> None:
    made = Rig(policy=policy(AGAIN), fail_on={"camera.read": [LOST]})
    made.run()
    assert made.made_safe()[:2] == ["mobile_tweezers", "camera"]
    assert {"state": "recovering"} in made.observer.of("state")


def test_the_run_stops_if_they_cannot_be_made_safe() -> None:
    made = Rig(
        policy=policy(AGAIN),
        fail_on={"camera.read": [LOST], "mobile_tweezers.safe_state": [DeviceError("mobile_tweezers", "on")]},
    )
    with pytest.raises(DeviceError, match="on"):
        made.run()
    assert made.made_safe() == ["mobile_tweezers", "camera", *SAFE_ORDER]


def test_no_policy_continues_after_a_call_that_hangs() -> None:
    step = StepPolicy(on_failure="repeat_shot", retries=2)
    made = Rig(policy=policy(step), hang_on={"camera.arm"}, timeouts=SHORT)
    with pytest.raises(DeviceHungError):
        made.run()
    made.lab.hangs["camera.arm"].release.set()
    assert len(made.sink.shots) == 1


def test_no_policy_continues_past_an_interlock() -> None:
    class Watching(RecordingDevice):
        def check_interlocks(self) -> None:
            raise DeviceError("shutter", "power is 2 W, above its limit of 1 W")

    made = Rig(policy=RunPolicy(otherwise=StepPolicy(on_failure="skip_point")))
    object.__setattr__(made.lab.devices["shutter"], "__class__", Watching)
    with pytest.raises(InterlockError, match=r"^shutter: power is 2 W, above its limit of 1 W$") as caught:
        made.run()
    assert caught.value.device == "shutter"
    assert made.made_safe() == SAFE_ORDER


def slow_detector(made: Rig, *durations_s: float) -> Rig:
    """Let each detection take its time, the last one for all that follow."""
    sleep, detect, left = made.lab.clock.sleep, made.lab.detector.detect, list(durations_s)

    def slowly(frame: Any) -> Any:
        sleep(left.pop(0) if len(left) > 1 else left[0])
        return detect(frame)

    vars(made.lab.detector)["detect"] = slowly
    return made


@pytest.mark.parametrize("n_failures", [2, 3])
def test_a_step_is_tried_again_in_the_same_shot(n_failures: int) -> None:
    made = Rig(policy=policy(StepPolicy(retries=2)), fail_on={"camera.read": [LOST] * n_failures})
    if n_failures > 2:
        with pytest.raises(DeviceTimeoutError):
            made.run()
    else:
        made.run()
        (shot,) = made.sink.shots
        assert (shot.status, shot.attempt, len(shot.images)) == ("complete", 0, 1)
    assert made.lab.calls.names("camera").count("camera.read") == 3
    assert made.lab.calls.names("static_tweezers").count("static_tweezers.load") == 1
    assert [event["step"] for event in made.observer.of("step_repeated")] == [1, 1]
    assert [timing.stage for timing in made.record().timing].count("expose") == 3


def test_the_image_of_a_try_that_failed_is_not_kept() -> None:
    made = slow_detector(Rig(policy=policy(StepPolicy(retries=1, timeout_s=0.2))), 0.3, 0.0)
    made.run()
    (shot,) = made.sink.shots
    assert (shot.status, len(shot.images), len(made.observer.of("step_repeated"))) == ("complete", 1, 1)
    assert [timing.stage for timing in shot.timing].count("detect") == 2


def test_a_step_that_takes_too_long_has_failed() -> None:
    step = Slow(0.3, 0.1)
    made = Rig(steps=(("slow", step),), policy=RunPolicy(steps=(StepPolicy(timeout_s=0.2),)))
    made.run()
    assert [shot.status for shot in made.sink.shots] == ["failed", "complete"]
    assert re.match(r"StepTimeoutError: step 0 \(slow\) .* 200 ms", made.sink.shots[0].error)


def test_each_try_has_the_whole_timeout() -> None:
    limited = StepPolicy(timeout_s=0.2, retries=1)
    made = Rig(steps=(("slow", Slow(0.3, 0.15)),), policy=RunPolicy(steps=(limited,)))
    made.run()
    assert [shot.status for shot in made.sink.shots] == ["complete"]


def test_a_step_that_never_ends_is_given_up_and_calls_nothing_any_more() -> None:
    release, refused = threading.Event(), threading.Event()

    class Endless(Slow):
        def run(self, shot: Shot) -> None:
            release.wait(30.0)
            try:
                shot.call("camera", 1.0, shot.static_tweezers.start)
            except StopRequested:
                refused.set()

    limited = RunPolicy(steps=(StepPolicy(timeout_s=0.01, on_failure="repeat_shot"),))
    made = Rig(steps=(("slow", Endless()),), policy=limited, timeouts=SHORT)
    with pytest.raises(DeviceHungError, match="step"):
        made.run()
    n_calls = len(made.lab.calls)
    release.set()
    assert refused.wait(30.0)
    assert len(made.lab.calls) == n_calls


@pytest.mark.parametrize(
    ("then", "statuses"),
    [
        ("record", ["complete"]),
        ("warn", ["complete"]),
        ("repeat_shot", ["failed", "complete"]),
        ("skip_point", ["failed"]),
        ("stop", ["failed"]),
    ],
)
def test_a_stage_over_its_budget_follows_its_policy(then: Any, statuses: list[str]) -> None:
    made = Rig(steps=(("slow", Slow(0.3, 0.1)),), policy=RunPolicy(steps=(StepPolicy(over_budget=then),)))
    if then == "stop":
        with pytest.raises(OverBudgetError, match=r"'step_0_slow' took 300 ms; .* 100 ms"):
            made.run()
        assert made.made_safe() == SAFE_ORDER
    else:
        made.run()
    assert [shot.status for shot in made.sink.shots] == statuses
    warnings = [event["text"] for event in made.observer.of("warning")]
    assert len(warnings) == (then == "warn")
    assert all("shot 0: 'step_0_slow' took 300 ms" in text for text in warnings)
    (first, *_) = [timing for timing in made.sink.shots[0].timing if timing.stage == "step_0_slow"]
    assert first.over_budget


def test_the_budget_of_a_stage_is_the_profiles() -> None:
    made = Rig(policy=policy(StepPolicy(over_budget="warn")), budgets={"detect": 1e-3})
    slow_detector(made, 0.01).run()
    (warning,) = made.observer.of("warning")
    assert re.match(r"shot 0: 'detect' took 10 ms; .* 1 ms", warning["text"])
    assert {timing.stage: timing.budget_s for timing in made.record().timing}["detect"] == 1e-3
    made = Rig(policy=policy(StepPolicy(over_budget="stop")), budgets={"detect": 5e-3})
    slow_detector(made, 0.005).run()  # the budget of the step includes that of the detection
    assert [shot.status for shot in made.sink.shots] == ["complete"]


def test_the_read_out_is_what_comes_after_the_exposure() -> None:
    made = Rig((LOAD, IMAGE))
    read = made.lab.camera.read

    def late(timeout_s: float) -> Any:
        frame = read(timeout_s)
        made.lab.clock.sleep(0.007)
        return frame

    vars(made.lab.camera)["read"] = late
    made.run()
    stages = {timing.stage: timing for timing in made.record().timing}
    assert isinstance(made.lab.camera, RecordingCamera)
    assert stages["read_out"].duration_s == pytest.approx(0.007)
    assert stages["expose"].duration_s == pytest.approx(0.052)


def test_mobile_tweezers_may_report_their_own_stages() -> None:
    class Reporting(RecordingMobileTweezers):
        def timings(self) -> dict[str, float]:
            return {"render": 1e-3, "upload": 2e-3}

    ways = {"stop_when": "never", "window_mode": "early", "window_of": lambda _: 1.0}
    step = RearrangeStep(given(cycles=1, exposure=0.02, **ways))
    made = Rig((LOAD, IMAGE, ("rearrange", step)), occupancies=[[[1, 0]], [[0, 1]]], fill=[[0, 1]])
    object.__setattr__(made.lab.mobile_tweezers, "__class__", Reporting)
    made.run()
    stages = {timing.stage: timing for timing in made.record().timing}
    assert (stages["render"].host_s, stages["upload"].host_s) == (1e-3, 2e-3)
    assert "tones" in stages


def test_a_slow_disk_may_end_the_run_but_repeats_no_shot() -> None:
    made = Rig(policy=RunPolicy(otherwise=StepPolicy(over_budget="repeat_shot")), budgets={"write": -1.0})
    made.run()  # a shot that is on the disk is not repeated for that
    assert [shot.status for shot in made.sink.shots] == ["complete"]
    made = Rig(policy=RunPolicy(otherwise=StepPolicy(over_budget="stop")), budgets={"write": -1.0})
    with pytest.raises(OverBudgetError, match="'write'"):
        made.run(2)
    assert [shot.status for shot in made.sink.shots] == ["complete"]
    assert made.made_safe() == SAFE_ORDER


class Unknown(Slow):
    """Does not know how long it takes."""

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        return [TimelineEntry("unknown", 0.0, 0.0)]


def test_a_step_that_does_not_know_how_long_it_takes_has_no_budget() -> None:
    strict = RunPolicy(steps=(StepPolicy(over_budget="stop"),))
    made = Rig(steps=(("unknown", Unknown(0.3)),), policy=strict)
    made.run()
    (timing,) = [timing for timing in made.record().timing if timing.stage == "step_0_unknown"]
    assert math.isnan(timing.budget_s)
    assert not timing.over_budget
