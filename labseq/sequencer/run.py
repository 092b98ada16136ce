"""The sequencer: shot after shot, and every way out of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any, Protocol

from labseq.errors import LabseqError, StopRequested, TransientError
from labseq.model import ShotRecord
from labseq.model.records import ShotStatus
from labseq.roles import RunObserver, Settling, Step
from labseq.sequencer.calling import budget_s, run_step
from labseq.sequencer.clock import StopFlag
from labseq.sequencer.guard import LATE_S, Guard
from labseq.sequencer.lab import Lab, Outcome, close_all, make_safe
from labseq.sequencer.leading import Leaders
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
        self._unsafe: dict[str, LabseqError] = {}
        self._budgets = self._lay_out()

    @property
    def state(self) -> State:
        """Where the run stands."""
        return self._states.state

    def open(self) -> None:
        """Open the simulation, then each device, and turn the static tweezers on."""
        self._states.to(State.OPENING)
        self._open({"simulation", *dict(self.lab.hardware())})
        self._states.to(State.IDLE)

    def change(
        self,
        lab: Lab,
        steps: Sequence[tuple[str, Step]],
        parameters: Mapping[str, Any],
        reopened: Collection[str] = (),
    ) -> None:
        """Go on with other settings, between two shots.

        Args:
            lab: What the next shots are made with; of the devices that are not reopened, the same.
            steps: Their steps, with their names.
            parameters: What differs from the files in them: address -> value.
            reopened: Devices, "simulation" among them, that ``lab`` has anew: the present ones are
                made safe and closed, then those opened.

        Raises:
            LabseqError: A device fails; the caller must call :meth:`shut_down`.
        """
        if reopened:
            self._states.to(State.REOPENING)
            self._close(reopened)
        self.lab, self._steps, self._parameters = lab, steps, dict(parameters)
        if reopened:
            self._open(reopened)
            self._states.to(State.IDLE)
        self._budgets = self._lay_out()

    def _open(self, names: Collection[str]) -> None:
        """Open the simulation and the devices of these names; then wait for those that need time.

        Static tweezers among them are turned on.
        """
        lab, timeout_s = self.lab, self.lab.timeouts.call_s
        simulation = () if lab.simulation is None else (("simulation", lab.simulation),)
        for name, part in (*simulation, *lab.hardware()):
            if name in names:
                self._stop.check()
                # Nothing is made safe beside an open() that is only slow: what that does last would undo it.
                self.guard.call_to_the_end(name, timeout_s, part.open)
        if "static_tweezers" in names:
            self.guard.call("static_tweezers", timeout_s, lab.static_tweezers.load, None)
            self.guard.call("static_tweezers", timeout_s, lab.static_tweezers.start)
        for name, device in lab.hardware():
            if (
                name in names
                and isinstance(device, Settling)
                and (longest_s := device.settling_timeout_s) > 0
            ):
                self._emit("settling", {"device": name, "timeout_s": longest_s})
                self.guard.call(name, longest_s + LATE_S, device.settle)

    def _close(self, names: Collection[str]) -> None:
        """Make the devices of these names safe, all of them first, then close them."""
        lab, timeout_s = self.lab, self.lab.timeouts.safe_state_s
        devices = [(name, device) for name, device in lab.safe_order() if name in names]
        for name, device in devices:
            self.guard.call_to_the_end(name, timeout_s, device.safe_state)
        for name, device in devices:
            self.guard.call_to_the_end(name, timeout_s, device.close)
        if lab.simulation is not None and "simulation" in names:
            self.guard.call_to_the_end("simulation", timeout_s, lab.simulation.close)

    def _lay_out(self) -> list[float]:
        """What each step may take, in seconds."""
        context, timeout_s = self.lab.step_context, self.lab.timeouts.call_s
        return [
            self.guard.call("step", timeout_s, budget_s, step, number, name, context)
            for number, (name, step) in enumerate(self._steps)
        ]

    def run(self, shot_indices: Sequence[int]) -> None:
        """Take the shots, repeating each that fails with ``TransientError``.

        Raises:
            LabseqError: Whatever ended the run before its last shot. The caller
                must call :meth:`shut_down` on this way out too.
        """
        for index in shot_indices:
            for attempt in range(self._attempts):
                self._stop.check()
                if self._take(index, attempt, last=attempt + 1 == self._attempts):
                    break

    def shut_down(self) -> Mapping[str, LabseqError]:
        """Safe state of every device, then close; from any state, any number of times.

        Returns:
            The devices that could not be made safe, and why.
        """
        if self.state is not State.CLOSED:
            if self.state is not State.SAFE:
                self._secure()
            self._states.to(State.CLOSING)
            with self._stop.held():
                outcome = close_all(self.lab, self.guard)
            self._tell("closed", outcome)
            self.guard.end()
            self._states.to(State.CLOSED)
        return self._unsafe

    def _secure(self) -> None:
        self._states.to(State.MAKING_SAFE)
        with self._stop.held():
            outcome = make_safe(self.lab, self.guard)
        self._unsafe = {name: error for name, error in outcome.items() if error is not None}
        self._tell("safe_state", outcome)  # only now: neither a screen nor a disk shall delay the devices
        self._states.to(State.SAFE)

    def _take(self, index: int, attempt: int, *, last: bool) -> bool:
        """Take one attempt at a shot and write it; whether the shot is done."""
        self._states.to(State.SHOT)
        record = ShotRecord(index, attempt, self._seed, _utc_now(), parameters=self._parameters)
        record.calibrations = {kind: entry.id for kind, entry in self.lab.calibrations.items()}
        failure: TransientError | None = None
        try:
            try:
                self._perform(record)
            except TransientError as error:
                if last:
                    raise
                failure = error
                self._recover()
                self._leaders(record).failed(error)
        except BaseException as error:  # KeyboardInterrupt too, where no signal handler could be set
            stopped = isinstance(error, StopRequested | KeyboardInterrupt)
            self._abort(record, "interrupted" if stopped else "failed", error)
            raise
        self._close_record(record, "complete" if failure is None else "failed", failure)
        self._states.to(State.WRITING)
        self._sink.write_shot(record)
        self._emit("shot_finished" if failure is None else "shot_repeated", {"shot": record})
        self._states.to(State.IDLE)
        return failure is None

    def _perform(self, record: ShotRecord) -> None:
        for stream in self.lab.random_streams:
            stream.begin_shot(record.shot_index, record.attempt)
        if self.lab.simulation is not None:
            self.guard.call("simulation", self.lab.timeouts.call_s, self.lab.simulation.begin_shot)
        self._emit("shot_started", {"shot": record.shot_index, "attempt": record.attempt})
        shot = RunningShot(self.lab, self.guard, record, self._emit)
        shot.poll()
        shot.check_interlocks()
        for number, (name, step) in enumerate(self._steps):
            self._stop.check()
            shot.begin_step(number)
            with shot.stage(f"step {number} {name}", self._budgets[number]):
                self.guard.run_step(partial(run_step, step, number, name, shot))
        shot.leaders.ready()  # before the shot is written: atoms do not wait for a disk
        shot.note_truth()

    def _recover(self) -> None:
        """Silence what may still be busy."""
        self._states.to(State.RECOVERING)
        lab, timeout_s = self.lab, self.lab.timeouts.safe_state_s
        with self._stop.held():
            self.guard.call_to_the_end("mobile_tweezers", timeout_s, lab.mobile_tweezers.safe_state)
            self.guard.call_to_the_end("camera", timeout_s, lab.camera.safe_state)

    def _abort(self, record: ShotRecord, status: ShotStatus, error: BaseException) -> None:
        """Safety first; only then is who leads told, and what the shot has written down."""
        self._secure()
        self._leaders(record).failed(error)
        self._close_record(record, status, error)
        try:
            self._sink.write_shot(record)
        except LabseqError as failure:
            self._emit("warning", {"text": f"the interrupted shot could not be written: {failure}"})
        self._emit("shot_finished", {"shot": record})

    def _leaders(self, record: ShotRecord) -> Leaders:
        return Leaders(self.lab, self.guard, record, self._emit)

    def _close_record(self, record: ShotRecord, status: ShotStatus, error: BaseException | None) -> None:
        record.status = status
        record.error = "" if error is None else f"{type(error).__name__}: {error}"
        record.t_end_utc = _utc_now()

    def _tell(self, event: str, outcome: Outcome) -> None:
        for name, error in outcome.items():
            self._emit(event, {"device": name, "ok": error is None, "error": str(error or "")})

    def _emit(self, name: str, values: Mapping[str, Any]) -> None:
        self._observer.event(name, values)


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="microseconds")
