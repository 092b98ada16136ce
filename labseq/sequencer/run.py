"""The sequencer: takes the shots, tracks the state of the run, and makes the devices safe at its end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Protocol

from labseq.errors import LabseqError, StopRequested
from labseq.guard import DRIVER_MARGIN_S, Guard, StopFlag
from labseq.messages import error_text, format_error, format_plugin_error
from labseq.model import ShotRecord, TimelineEntry
from labseq.model.policies import RunPolicy, StepPolicy, Then, may_be_retried
from labseq.model.records import ShotStatus, unique_names
from labseq.plain import now_utc
from labseq.roles import RunObserver, Step, leaders
from labseq.sequencer.images import with_waits
from labseq.sequencer.lab import (
    Emit,
    Lab,
    Outcome,
    close_all,
    end_safely,
    make_safe,
    open_device,
)
from labseq.sequencer.shot import Events, RunningShot, ShotSettings, Stages
from labseq.watchdog import Watchdog


class State(Enum):
    """The state of a run."""

    CLOSED = "closed"
    OPENING = "opening"
    IDLE = "idle"
    """Between shots, with mobile tweezers silent, camera not exposing and static tweezers on."""
    SHOT = "shot"
    WRITING = "writing"
    RECOVERING = "recovering"
    """After a failure that does not end the run, while devices that may be busy are made safe."""
    REOPENING = "reopening"
    """Between shots, while devices whose settings change are made safe, closed and opened again."""
    MAKING_SAFE = "making safe"
    SAFE = "safe"
    CLOSING = "closing"


TRANSITIONS: Final = MappingProxyType(
    {
        State.CLOSED: frozenset({State.OPENING}),
        State.OPENING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.IDLE: frozenset({State.SHOT, State.REOPENING, State.MAKING_SAFE}),
        State.REOPENING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.SHOT: frozenset({State.WRITING, State.RECOVERING, State.MAKING_SAFE}),
        State.RECOVERING: frozenset({State.WRITING, State.SHOT, State.MAKING_SAFE}),
        State.WRITING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.MAKING_SAFE: frozenset({State.SAFE, State.MAKING_SAFE}),
        State.SAFE: frozenset({State.CLOSING}),
        State.CLOSING: frozenset({State.CLOSED, State.MAKING_SAFE}),
    }
)
"""The state table, state -> states that may follow.

Every state in which a device may be on leads to MAKING_SAFE. Making safe begins again if it was interrupted.
"""


class StateTable:
    """Holds the state of the run, and raises on a transition that the state table does not contain."""

    def __init__(self, changed: Callable[[State], None]) -> None:
        self.state = State.CLOSED
        self._changed = changed

    def to(self, state: State, *, announce: bool = True) -> None:
        """Change the state, and report it unless the devices come first."""
        if state not in TRANSITIONS[self.state]:
            raise AssertionError(f"a run cannot go from {self.state.value} to {state.value}")
        self.state = state
        if announce:
            self._changed(state)


def open_devices(
    lab: Lab, guard: Guard, stop: StopFlag, emit: Emit, names: Collection[str], watchdog: Watchdog
) -> None:
    """Open the simulation and the devices of these names, then wait for devices that need time.

    The watchdog learns how each is switched off. Then idle lines and static tweezers are turned on.

    Raises:
        LabseqError: A device fails, or the run is asked to stop.
    """
    timeout_s = lab.timeouts.call_s
    if lab.simulation is not None and "simulation" in names:
        guard.call_despite_stop("simulation", timeout_s, lab.simulation.open)
    order = {name: n for n, (name, _) in enumerate(lab.safe_order())}
    for name, part in lab.hardware():
        if name in names:
            stop.check()
            open_device(guard, name, part, timeout_s, watchdog, order[name])
    for text in watchdog.notes():
        emit("warning", {"text": text})
    if lab.lines is not None and "lines" in names:
        guard.call("lines", timeout_s, lab.lines.idle)
    if "static_tweezers" in names:
        guard.call("static_tweezers", timeout_s, lab.static_tweezers.load, None)
        guard.call("static_tweezers", timeout_s, lab.static_tweezers.start)
    # after all are open, so that a device settles while the others are opened
    for name, device in lab.hardware():
        if name not in names:
            continue
        longest_s = guard.call(name, timeout_s, partial(getattr, device, "settling_timeout_s"))
        if longest_s > 0:
            emit("settling", {"device": name, "timeout_s": longest_s})
            guard.call(name, longest_s + DRIVER_MARGIN_S, device.settle)


def _raise_first(outcome: Outcome) -> None:
    for failure in filter(None, outcome.values()):
        raise failure


def plan_timelines(lab: Lab, guard: Guard, steps: Sequence[tuple[str, Step]]) -> list[list[TimelineEntry]]:
    """The timeline of each step.

    Raises:
        LabseqError: A step fails. The error names it.
    """
    planned = [plan_timeline(lab, guard, number, *step) for number, step in enumerate(steps)]
    return with_waits(planned, lab.step_context)


def plan_timeline(lab: Lab, guard: Guard, number: int, name: str, step: Step) -> list[TimelineEntry]:
    """The timeline of one step, see :func:`plan_timelines`. ``number`` is its index in the shot."""

    def entries() -> list[TimelineEntry]:
        with _named(number, name):
            found = list(step.plan_timeline(lab.step_context))
            if other := [one for one in found if not isinstance(one, TimelineEntry)]:  # pyright: ignore[reportUnnecessaryIsInstance]
                raise TypeError(f"plan_timeline() gave {other[0]!r}; expected TimelineEntry objects")
            return found

    return guard.call("step", lab.timeouts.call_s, entries)


@contextmanager
def _named(number: int, name: str) -> Generator[None]:
    """Add the name of the step, and the line of its code, to errors that are not labseq's own."""
    try:
        yield
    except LabseqError:
        raise
    except BaseException as error:
        text = f"step {number} ({name}) raised {format_plugin_error(error)}"
        raise LabseqError(text) from error


class ShotSink(Protocol):
    """Receives finished shots, to write them to disk."""

    def write_shot(self, shot: ShotRecord) -> object:
        """Write a shot to disk."""
        ...


class Sequencer:
    """Runs shots on open devices and makes the devices safe however the run ends.

    Args:
        policy: Reactions to failures and exceeded budgets.
        parameters: Settings that differ from the files, address -> value, recorded with each shot.
        watchdog: Switches the outputs off if this process dies or hangs. Default is one without a log.
        place_of: Index of a shot -> the "run" and "file" where it will be recorded if it counts.
        settings_for: The settings of a shot with values of another control system, by address. Raises
            ConfigError for values that are wrong or not allowed. None allows none.

    Attributes:
        lab: The devices.
        unsafe: Devices that could not be made safe -> the reason. Complete once the run is shut down.

    Raises:
        LabseqError: A step fails to lay out its timeline.
    """

    def __init__(
        self,
        lab: Lab,
        steps: Sequence[tuple[str, Step]],
        stop: StopFlag,
        sink: ShotSink,
        observer: RunObserver,
        *,
        seed: int,
        policy: RunPolicy = RunPolicy(),  # noqa: B008 - frozen
        parameters: Mapping[str, Any] | None = None,
        watchdog: Watchdog | None = None,
        place_of: Callable[[int], Mapping[str, str]] = lambda _: {},
        settings_for: Callable[[Mapping[str, str]], ShotSettings] | None = None,
    ) -> None:
        self.lab = lab
        self._watchdog = watchdog or Watchdog()
        self.guard = Guard(stop)
        self.guard.direct = lab.direct_calls
        self._events = Events(observer, self.guard)
        self._steps = steps
        self._stop = stop
        self._sink = sink
        self._seed = seed
        self._place_of = place_of
        self._settings_for = settings_for
        self._policy = policy
        self._parameters = dict(parameters or {})
        self._states = StateTable(self._announce)
        self.unsafe: dict[str, LabseqError] = {}
        self._timelines = plan_timelines(self.lab, self.guard, self._steps)

    @property
    def state(self) -> State:
        """The state of the run."""
        return self._states.state

    def open(self) -> None:
        """Open the simulation, then each device, and turn the static tweezers on."""
        self._states.to(State.OPENING)
        self._open(self.lab, {"simulation", *dict(self.lab.hardware())})
        self._states.to(State.IDLE)

    def change(
        self,
        lab: Lab,
        steps: Sequence[tuple[str, Step]],
        parameters: Mapping[str, Any],
        reopened: Collection[str] = (),
    ) -> None:
        """Continue with other settings, between two shots.

        Args:
            lab: The lab of the next shots. Devices that are not reopened are the same objects.
            steps: Their steps, with their names.
            parameters: Their settings that differ from the files, address -> value.
            reopened: Devices, or "simulation", that are new in ``lab``. The present ones are made safe and
                closed, then the new ones opened.

        Raises:
            LabseqError: A device fails. The caller must call :meth:`shut_down`.
        """
        if reopened:
            self._states.to(State.REOPENING)
            _raise_first(make_safe(self.lab, self.guard, reopened))  # all of them before any is closed
            _raise_first(close_all(self.lab, self.guard, reopened))
            self._watchdog.forget(reopened)
        # before they are opened, because after a failure to open the new devices must be made safe
        self.lab, self._steps, self._parameters = lab, steps, dict(parameters)
        self.guard.direct = lab.direct_calls
        if reopened:
            self._open(lab, reopened)
            self._states.to(State.IDLE)
        self._timelines = plan_timelines(self.lab, self.guard, self._steps)

    def _open(self, lab: Lab, names: Collection[str]) -> None:
        open_devices(lab, self.guard, self._stop, self._emit, names, self._watchdog)

    def take(self, index: int) -> str:
        """Take and write a shot. If it fails, repeat it as the policy says.

        Returns:
            "" for a shot that counts. Else why it failed for good, and its scan point must be skipped.

        Raises:
            LabseqError: The error that ended the run. The caller must call :meth:`shut_down` then, too.
        """
        attempt = 0
        while True:
            self._stop.check()
            then, why = self._attempt(index, attempt)
            if then != "repeat_shot":
                return why
            attempt += 1

    def shut_down(self, *, ended_well: bool = False) -> Mapping[str, LabseqError]:
        """Make every device safe, then close it. May be called in any state, any number of times.

        Args:
            ended_well: Whether the run took all its shots. Static tweezers may then be left on, if every
                other device is safe.

        Returns:
            Devices that could not be made safe -> the reason.
        """
        if self.state is not State.CLOSED:
            if self.state is not State.SAFE:
                self._secure(ended_well=ended_well)
            self._states.to(State.CLOSING, announce=False)
            with self._stop.held():
                outcome = close_all(self.lab, self.guard)
            self._watchdog.forget(name for name in outcome if name not in self.unsafe)
            self._watchdog.end()
            self._announce(State.CLOSING)
            self._report("closed", outcome)
            self._warn_of_watchdog()
            self.guard.end()
            self._states.to(State.CLOSED)
        return self.unsafe

    def _secure(self, *, ended_well: bool = False) -> None:
        self._states.to(State.MAKING_SAFE, announce=False)
        with self._stop.held():
            event, after_s = None, dict[str, float]()
            if ended_well:
                others = {name for name, _ in self.lab.hardware()} - {"static_tweezers"}
                outcome = make_safe(self.lab, self.guard, others)
                event = self._leave_on() if not any(outcome.values()) else None
                outcome |= make_safe(self.lab, self.guard, {"static_tweezers"})
            else:
                outcome, after_s = end_safely(self.lab, self.guard)
        self.unsafe = {name: error for name, error in outcome.items() if error is not None}
        self._states.to(State.SAFE, announce=False)
        self._announce(State.MAKING_SAFE)  # only now, because no screen or disk may delay the devices
        self._report("safe_state", outcome, after_s)
        if event is not None:
            self._emit(*event)
        self._announce(State.SAFE)

    def _leave_on(self) -> tuple[str, dict[str, Any]] | None:
        """Leave the static tweezers on if the profile asks for it. Returns the event that reports it."""
        name, device = "static_tweezers", self.lab.static_tweezers
        try:
            left = self.guard.call_despite_stop(name, self.lab.timeouts.safe_state_s, device.leave_on)
        except LabseqError as failure:
            return "warning", {"text": f"{name} cannot be left on and are switched off: {failure}"}
        return ("left_on", {"device": name}) if left else None

    def _attempt(self, index: int, attempt: int) -> tuple[Then | None, str]:
        """Make one attempt at a shot and write it. Returns the reaction and the reason if it failed."""
        self._states.to(State.SHOT)
        self._warn_of_watchdog()
        record = ShotRecord(index, attempt, self._seed, now_utc())
        record.calibrations = {kind: entry.id for kind, entry in self.lab.calibrations.items()}
        settings = ShotSettings(self.lab, self._steps, self._timelines, self._parameters)
        shot = RunningShot(settings, self.guard, record, self._events)
        if any(leaders(dict(self.lab.hardware()))):
            from labseq.sequencer.leader import LeaderAnswers  # most profiles have no leader

            place = self._place_of(index)
            shot.leaders = LeaderAnswers(shot, self.guard, self._events, place, self._settings_for)
        failure: LabseqError | None = None
        then: Then | None = None
        try:  # catches failures that end the run, the inner one failures after which it continues
            try:
                self.guard.run_shot(partial(self._perform, shot))
            except LabseqError as error:
                then = self._policy.after(error, shot.step if shot.in_step else None, attempt)
                if then == "stop":
                    raise
                failure = error
                self._recover()
                self._tell_leaders(shot, error)
        except BaseException as error:  # KeyboardInterrupt too, where no signal handler could be set
            stopped = isinstance(error, StopRequested | KeyboardInterrupt)
            self._abort(shot, "interrupted" if stopped else "failed", error)
            raise
        self._close_record(record, "complete" if failure is None else "failed", failure)
        self._states.to(State.WRITING)
        start_s = time.perf_counter()
        row = self._sink.write_shot(record)
        host_s = time.perf_counter() - start_s
        event = "shot_repeated" if then == "repeat_shot" else "shot_finished"
        self._emit(event, {"shot": record, "row": row, "write_s": host_s})
        self._states.to(State.IDLE)
        self._check_writing_time(shot.stages, host_s)
        return then, record.error

    def _check_writing_time(self, stages: Stages, host_s: float) -> None:
        """Record how long writing took. A simulated run has no disk, so there it takes no time.

        Raises:
            OverBudgetError: It took longer than its budget, and the run's policy is to stop.
        """
        # a shot that is on the disk is neither repeated nor skipped, so these reactions become a warning
        then = self._policy.otherwise.over_budget
        stages.policy = StepPolicy(over_budget=then if then in (None, "record", "stop") else "warn")
        stages.done("write", 0.0 if self.lab.clock.virtual else host_s, host_s, math.nan, 0)

    def _perform(self, shot: RunningShot) -> None:
        """Take a shot, in the thread of its steps."""
        record = shot.record
        for stream in self.lab.random_streams:
            stream.begin_shot(record.shot_index, record.attempt)
        if self.lab.simulation is not None:
            self.guard.call("simulation", self.lab.timeouts.call_s, self.lab.simulation.begin_shot)
        self._emit("shot_started", {"shot": record.shot_index, "attempt": record.attempt})
        # the previous shot may have ramped them
        shot.call("static_tweezers", shot.call_timeout_s, shot.static_tweezers.start)
        shot.poll()
        shot.check_interlocks()
        images = unique_names([name for name, _ in self._steps])
        for number in range(len(self._steps)):
            self._stop.check()
            name, step = shot.steps[number]  # a leader may have set other values in an earlier step
            policy = self._policy.of_step(number)
            with shot.of_step(number, name, policy, images[number], needs_image=step.needs_image):
                self._run_step(shot, number, name, step)
        shot.series.end()
        if shot.leaders is not None:
            shot.leaders.ready()  # before the shot is written, because atoms are lost while the disk writes
        shot.record_truth()

    def _run_step(self, shot: RunningShot, number: int, name: str, step: Step) -> None:
        """Run a step, and retry it if it fails and its policy allows that."""
        policy, images = self._policy.of_step(number), shot.record.images
        n_before = len(images)
        for left in range(policy.retries, -1, -1):
            shot.stages.begin_attempt()
            try:
                longest_s = policy.limit_s + self.lab.timeouts.call_s
                with self.guard.step(f"step {number} ({name}) ", longest_s), _named(number, name):
                    step.run(shot)
                shot.stages.check_timeout()
            except LabseqError as error:
                if not (left and may_be_retried(error)):
                    raise
                del images[n_before:]  # image n must be the same one in every shot
                self._recover()
                shot.series.forget()
                self._states.to(State.SHOT)
                self._emit("step_repeated", {"shot": shot.index, "step": number, "error": str(error)})
            else:
                return

    def _recover(self) -> None:
        """Make the devices safe that may still be busy."""
        self._states.to(State.RECOVERING)
        with self._stop.held():
            _raise_first(make_safe(self.lab, self.guard, {"mobile_tweezers", "camera", "lines"}))

    def _abort(self, shot: RunningShot, status: ShotStatus, error: BaseException) -> None:
        """Make the devices safe before answering the other control system and writing the shot."""
        self._secure()
        with self._stop.held():  # a driver may have to wait for its device in order to answer
            self._tell_leaders(shot, error)
        self._close_record(shot.record, status, error)
        try:
            row = self._sink.write_shot(shot.record)
        except Exception as failure:  # noqa: BLE001 - the first error is the one to report
            text = f"the interrupted shot could not be written: {error_text(failure)}"
            self._emit("warning", {"text": text})
        else:
            self._emit("shot_finished", {"shot": shot.record, "row": row})

    def _tell_leaders(self, shot: RunningShot, error: BaseException) -> None:
        if shot.leaders is not None:
            shot.leaders.failed(error, self._emit)

    def _close_record(self, record: ShotRecord, status: ShotStatus, error: BaseException | None) -> None:
        record.status = status
        record.error = "" if error is None else format_error(error)
        record.t_end_utc = now_utc()

    def _report(self, event: str, outcome: Outcome, after_s: Mapping[str, float] | None = None) -> None:
        for name, error in outcome.items():
            times = {"after_s": after_s[name]} if after_s and name in after_s else {}
            self._emit(event, {"device": name, "ok": error is None, "error": str(error or ""), **times})

    def _warn_of_watchdog(self) -> None:
        for text in self._watchdog.notes():
            self._emit("warning", {"text": text})

    def _announce(self, state: State) -> None:
        self._emit("state", {"state": state.value})

    def _emit(self, name: str, values: Mapping[str, Any]) -> None:
        self._events.release()
        self._events(name, values)
