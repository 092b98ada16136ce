"""Another control system leads: waiting for its signal, and reporting the outcome to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from labseq.errors import ConfigError, LabseqError, one_of
from labseq.guard import DRIVER_MARGIN_S, Guard
from labseq.model import ShotRecord
from labseq.roles import LeaderLink
from labseq.sequencer.lab import Lab

Emit = Callable[[str, Mapping[str, Any]], None]


def leaders(devices: Mapping[str, object]) -> Iterator[tuple[str, LeaderLink]]:
    """The devices, or lines, through which other control systems lead, with their names."""
    for name, device in devices.items():
        if isinstance(device, LeaderLink):
            yield name, device


def find_leader(devices: Mapping[str, object], name: str = "") -> tuple[str, LeaderLink]:
    """The device whose leader a step waits for.

    Args:
        devices: All hardware of the profile.
        name: Of the device; "" for the only one that leads.

    Raises:
        ConfigError: It cannot lead, or nobody can, or it is not clear who is meant.
    """
    able = dict(leaders(devices))
    if name in able:
        return name, able[name]
    if name:
        raise ConfigError(f"no other control system leads through '{name}'")
    if not able:
        raise ConfigError("the profile has no device through which another control system leads")
    if len(able) > 1:
        raise ConfigError(f"several devices lead; set `device` to {one_of(list(able))}")
    return next(iter(able.items()))


@dataclass(frozen=True, slots=True)
class LeaderHandshakes:
    """Those who lead a shot: whoever said `go` is told what came of it.

    A device knows itself whether it owes an answer, and gives it once; so all are told at each end of a shot.

    Attributes:
        lab: The devices.
        guard: Runs every call into them.
        record: Of the shot.
        emit: Told every event: name and values.
    """

    lab: Lab
    guard: Guard
    record: ShotRecord
    emit: Emit

    def follow(self, signal: str, timeout_s: float, device: str) -> None:
        """Wait for a signal; see ``labseq.roles.Shot.follow``."""
        name, leader = find_leader(dict(self.lab.hardware()), device)
        self._report(name, leader, "ready", self.guard.call)  # of an earlier signal in this shot
        awaited = {"shot": self.record.shot_index, "device": name, "signal": signal, "timeout_s": timeout_s}
        self.emit("leader_awaited", awaited)
        try:
            text = self.guard.call(name, timeout_s + DRIVER_MARGIN_S, leader.wait_for, signal, timeout_s)
        finally:
            self._log_news(name, leader)
        self._note(f"{name}.{signal}", text)
        self._log("leader_said", name, f"{signal} {text}".strip())

    def ready(self) -> None:
        """The last step is over.

        Raises:
            DeviceError: A device fails.
            StopRequested: The run was asked to stop; they are to be told that it failed.
        """
        for name, leader in leaders(dict(self.lab.hardware())):
            self._report(name, leader, "ready", self.guard.call)

    def failed(self, error: BaseException) -> None:
        """The shot failed, or was interrupted; no failure to tell it stands in the way of anything."""
        reason = str(error) or type(error).__name__
        for name, leader in leaders(dict(self.lab.hardware())):
            try:
                self._report(name, leader, "failed", self.guard.call_to_the_end, reason)
            except LabseqError as failure:
                text = f"the system that leads through '{name}' could not be told of the failure: {failure}"
                self.emit("warning", {"text": text})

    def _report(
        self,
        name: str,
        leader: LeaderLink,
        state: Literal["ready", "failed"],
        call: Callable[..., Any],
        reason: str = "",
    ) -> None:
        about: dict[str, bool | int | float | str] = {"shot": self.record.shot_index}
        if state == "ready" and not math.isnan(self.record.filling_fraction):
            about |= {"success": self.record.success, "filling": self.record.filling_fraction}
        if reason:
            about["reason"] = reason
        told = call(name, self.lab.timeouts.call_s, leader.report, state, about)
        if told:
            self._note(f"{name}.told", told)
            self._log("leader_told", name, told)
        self._log_news(name, leader)

    def _log_news(self, name: str, leader: LeaderLink) -> None:
        try:
            new_events = self.guard.call_to_the_end(name, self.lab.timeouts.call_s, leader.new_events)
        except LabseqError as failure:
            new_events = [str(failure)]
        for text in new_events:
            self._log("leader_news", name, text)

    def _note(self, name: str, text: str) -> None:
        """Add to the shot's readings; there may be several waits in a shot."""
        self.record.readings[name] = [*self.record.readings.get(name, ()), text]

    def _log(self, event: str, device: str, text: str) -> None:
        self.emit(event, {"shot": self.record.shot_index, "device": device, "text": text})
