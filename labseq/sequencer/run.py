"""The sequencer: shot after shot, and every way out of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any, Protocol

from labseq.errors import LabseqError, StopRequested, TransientError
from labseq.model import ShotRecord
from labseq.model.records import ShotStatus
from labseq.roles import RunObserver, Step
from labseq.sequencer.clock import StopFlag
from labseq.sequencer.guard import Guard
from labseq.sequencer.lab import Lab, close_all, make_safe
from labseq.sequencer.shot import RunningShot
from labseq.sequencer.states import State, StateTable


class ShotSink(Protocol):
    """Where finished shots go."""

    def write_shot(self, shot: ShotRecord) -> object:
        """Make a shot durable."""
        ...


class Sequencer:
    """Runs shots on open devices and brings the devices to safety on every way out.

    Args:
        lab: The devices.
        steps: The steps of a shot, with their names.
        stop: The request to stop.
        sink: Where shots are written.
        observer: Told everything that happens.
        seed: The run's seed.
        attempts: How often a shot is tried when it fails with ``TransientError``.
        parameters: What differs from the files, kept with each shot: address -> value.
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
        attempts: int = 3,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        self.lab = lab
        self.guard = Guard(stop)
        self._steps = steps
        self._stop = stop
        self._sink = sink
        self._observer = observer
        self._seed = seed
        self._attempts = attempts
        self._parameters = dict(parameters or {})
        self._states = StateTable(lambda state: self._emit("state", {"state": state.value}))
        self._budgets = [sum(e.duration_s for e in step.plan_timeline(lab.step_context)) for _, step in steps]

    @property
    def state(self) -> State:
        """Where the run stands."""
        return self._states.state

    def open(self) -> None:
        """Open the simulation, then each device, and turn the static tweezers on."""
        self._states.to(State.OPENING)
        lab, timeout_s = self.lab, self.lab.timeouts.call_s
        if lab.simulation is not None:
            lab.simulation.open()
        for name, device in lab.hardware():
            self.guard.call(name, timeout_s, device.open)
        self.guard.call("static_tweezers", timeout_s, lab.static_tweezers.load, None)
        self.guard.call("static_tweezers", timeout_s, lab.static_tweezers.start)
        self._states.to(State.IDLE)

    def run(self, shot_indices: Sequence[int]) -> None:
        """Take the shots, repeating each that fails with ``TransientError``.

        Raises:
            LabseqError: Whatever ended the run before its last shot. The caller
                must call :meth:`shut_down` on this way out too.
        """
        for index in shot_indices:
            self._stop.check()
            for attempt in range(self._attempts):
                if self._take(index, attempt):
                    break
            self._states.to(State.IDLE)

    def shut_down(self) -> bool:
        """Safe state of every device, then close; from any state, any number of times.

        Returns:
            Whether every device is in its safe state.
        """
        if self.state is State.CLOSED:
            return True
        self._stop.hold()
        all_safe = True
        if self.state is not State.SAFE:
            all_safe = self._secure()
        self._states.to(State.CLOSING)
        close_all(self.lab, self.guard, partial(self._device_event, "closed"))
        if self.lab.simulation is not None:
            self.lab.simulation.close()
        self.guard.end()
        self._states.to(State.CLOSED)
        return all_safe

    def _secure(self) -> bool:
        self._stop.hold()
        self._states.to(State.MAKING_SAFE)
        all_safe = make_safe(self.lab, self.guard, partial(self._device_event, "safe_state"))
        self._states.to(State.SAFE)
        return all_safe

    def _take(self, index: int, attempt: int) -> bool:
        """Take one attempt at a shot and write it; whether the shot is done."""
        self._states.to(State.SHOT)
        record = ShotRecord(index, attempt, self._seed, _utc_now(), parameters=self._parameters)
        try:
            self._perform(record)
        except TransientError as error:
            if attempt + 1 < self._attempts:
                self._close_record(record, "failed", error)
                self._recover(record)
                return False
            self._abort(record, "failed", error)
            raise
        except BaseException as error:  # KeyboardInterrupt too, where no signal handler could be set
            stopped = isinstance(error, StopRequested | KeyboardInterrupt)
            self._abort(record, "interrupted" if stopped else "failed", error)
            raise
        self._close_record(record, "complete", None)
        self._states.to(State.WRITING)
        self._sink.write_shot(record)
        self._emit("shot_finished", {"shot": record})
        return True

    def _perform(self, record: ShotRecord) -> None:
        for stream in self.lab.random_streams:
            stream.begin_shot(record.shot_index, record.attempt)
        if self.lab.simulation is not None:
            self.lab.simulation.begin_shot()
        self._emit("shot_started", {"shot": record.shot_index, "attempt": record.attempt})
        shot = RunningShot(self.lab, self.guard, record, self._emit)
        for number, (name, step) in enumerate(self._steps):
            self._stop.check()
            shot.begin_step(number)
            with shot.stage(f"step {number} {name}", self._budgets[number]):
                _run_step(step, shot, number, name)
        shot.note_truth()

    def _recover(self, record: ShotRecord) -> None:
        """Silence what may still be busy, keep the failed attempt, and go back to idle."""
        self._states.to(State.RECOVERING)
        lab, timeout_s = self.lab, self.lab.timeouts.safe_state_s
        self.guard.call("mobile_tweezers", timeout_s, lab.mobile_tweezers.safe_state)
        self.guard.call("camera", timeout_s, lab.camera.safe_state)
        self._states.to(State.WRITING)
        self._sink.write_shot(record)
        self._emit("shot_repeated", {"shot": record})
        self._states.to(State.IDLE)

    def _abort(self, record: ShotRecord, status: ShotStatus, error: BaseException) -> None:
        """Safety first; only then is what the shot has written down."""
        self._secure()
        self._close_record(record, status, error)
        try:
            self._sink.write_shot(record)
        except LabseqError as failure:
            self._emit("warning", {"text": f"the interrupted shot could not be written: {failure}"})
        self._emit("shot_finished", {"shot": record})

    def _close_record(self, record: ShotRecord, status: ShotStatus, error: BaseException | None) -> None:
        record.status = status
        record.error = "" if error is None else f"{type(error).__name__}: {error}"
        record.t_end_utc = _utc_now()

    def _device_event(self, event: str, name: str, error: LabseqError | None) -> None:
        self._emit(event, {"device": name, "ok": error is None, "error": str(error or "")})

    def _emit(self, name: str, values: Mapping[str, Any]) -> None:
        self._observer.event(name, values)


def _run_step(step: Step, shot: RunningShot, number: int, name: str) -> None:
    try:
        step.run(shot)
    except LabseqError:
        raise
    except Exception as error:
        text = f"step {number} ({name}) raised {type(error).__name__}: {error}"
        raise LabseqError(text) from error


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")
