"""Runs started by another control system: wait for its start signal, and answer with the outcome."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from labseq.errors import LabseqError
from labseq.guard import DRIVER_MARGIN_S, Guard
from labseq.messages import error_text
from labseq.model import ShotRecord
from labseq.roles import LeaderLink, find_leader, leaders
from labseq.sequencer.lab import Lab

Emit = Callable[[str, Mapping[str, Any]], None]


@dataclass(frozen=True, slots=True)
class LeaderAnswers:
    """Waits for the start signals of one attempt at a shot, and answers each of them.

    A device answers each signal once and ignores further answers, so all devices can be called at
    the end of a shot.

    Attributes:
        lab: The devices.
        guard: Runs every call into them.
        record: Record of the shot.
        emit: Receives every event: name and values.
        start_s: Start of the attempt, on the session's clock.
        place: Where the shot will be recorded if it counts: "run" and "file"; empty if nowhere.
    """

    lab: Lab
    guard: Guard
    record: ShotRecord
    emit: Emit
    start_s: float = 0.0
    place: Mapping[str, str] = field(default_factory=dict[str, str])

    def follow(self, signal: str, timeout_s: float, device: str) -> None:
        """Wait for a signal; see ``labseq.plugin.Shot.follow``."""
        name, leader = find_leader(dict(self.lab.hardware()), device)
        self._answer(name, leader, "ready", self.guard.call)  # the answer to an earlier signal in this shot
        awaited = {"shot": self.record.shot_index, "device": name, "signal": signal, "timeout_s": timeout_s}
        self.emit("leader_awaited", awaited)
        try:
            text = self.guard.call(name, timeout_s + DRIVER_MARGIN_S, leader.wait_for, signal, timeout_s)
        finally:
            self._log_events(name, leader)
        self._record(f"{name}.{signal}", text)
        self._log("leader_signal", name, f"{signal} {text}".strip())

    def ready(self) -> None:
        """Answer "ready" after the last step.

        Raises:
            DeviceError: A device fails.
            StopRequested: The run was asked to stop; the caller must answer "failed".
        """
        for name, leader in leaders(dict(self.lab.hardware())):
            self._answer(name, leader, "ready", self.guard.call)

    def failed(self, error: BaseException) -> None:
        """Answer "failed" with a reason; a device that cannot is a warning."""
        reason = error_text(error) or type(error).__name__
        for name, leader in leaders(dict(self.lab.hardware())):
            try:
                self._answer(name, leader, "failed", self.guard.call_despite_stop, reason)
            except Exception as failure:  # noqa: BLE001 - the first error is the one to report
                text = (
                    f"the failure could not be reported to the system behind '{name}': {error_text(failure)}"
                )
                self.emit("warning", {"text": text})

    def _answer(
        self,
        name: str,
        leader: LeaderLink,
        state: Literal["ready", "failed"],
        call: Callable[..., Any],
        reason: str = "",
    ) -> None:
        record = self.record
        about: dict[str, Any] = {"shot": record.shot_index, "record": record, "start_s": self.start_s}
        about |= {"target": self.lab.target, **(self.place if state == "ready" else {})}
        if state == "ready" and not math.isnan(record.filling_fraction):
            about |= {"success": record.success, "filling": record.filling_fraction}
        if reason:
            about["reason"] = reason
        if answer := call(name, self.lab.timeouts.call_s, leader.report, state, about):
            self._record(f"{name}.answer", answer)
            self._log("leader_answered", name, answer)
        self._log_events(name, leader)

    def _log_events(self, name: str, leader: LeaderLink) -> None:
        try:
            new_events = self.guard.call_despite_stop(name, self.lab.timeouts.call_s, leader.new_events)
        except LabseqError as failure:
            new_events = [str(failure)]
        for text in new_events:
            self._log("leader_event", name, text)

    def _record(self, name: str, text: str) -> None:
        """Add to a reading of the shot, which is a list because a shot may wait several times."""
        self.record.readings[name] = [*self.record.readings.get(name, ()), text]

    def _log(self, event: str, device: str, text: str) -> None:
        self.emit(event, {"shot": self.record.shot_index, "device": device, "text": text})
