"""Waits for the start signal of another control system, and answers with the outcome of the shot."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from labseq.errors import ConfigError, LabseqError
from labseq.guard import DRIVER_MARGIN_S, Guard
from labseq.messages import error_text
from labseq.model import ImageRecord
from labseq.roles import LeaderDialogue, LeaderLink, find_leader, leaders
from labseq.sequencer.lab import Emit

if TYPE_CHECKING:
    from labseq.sequencer.shot import RunningShot, ShotSettings


@dataclass(slots=True)
class LeaderAnswers:
    """Waits for the start signals of one attempt at a shot, and answers each of them.

    A device answers each signal once and ignores further answers, so all devices can be called at
    the end of a shot.

    Attributes:
        shot: The shot.
        guard: Runs every call into the devices.
        emit: Receives every event as name and values.
        place: "run" and "file" where the shot will be recorded if it counts. Empty if nowhere.
        settings_for: The settings of a shot with values of the other system. None if it may set none.
    """

    shot: RunningShot
    guard: Guard
    emit: Emit
    place: Mapping[str, str]
    settings_for: Callable[[Mapping[str, str]], ShotSettings] | None
    _dialogues: dict[str, LeaderDialogue] = field(default_factory=dict[str, LeaderDialogue])
    _values: dict[str, str] = field(default_factory=dict[str, str])

    def __post_init__(self) -> None:
        """Find the devices that carry more than start signals, and let them check values that come early."""
        devices = self.shot.lab.hardware()
        self._dialogues |= {name: device for name, device in devices if isinstance(device, LeaderDialogue)}
        for dialogue in self._dialogues.values():
            dialogue.expect_values(self._check)

    def follow(self, signal: str, timeout_s: float, device: str) -> None:
        """Wait for a signal. See ``labseq.plugin.Shot.follow``."""
        name, leader = find_leader(dict(self.shot.lab.hardware()), device)
        self._answer(name, leader, "ready", self.guard.call)  # the answer to an earlier signal in this shot
        awaited = {"shot": self.shot.index, "device": name, "signal": signal, "timeout_s": timeout_s}
        self.emit("leader_awaited", awaited)
        end_s = self.shot.clock.now() + timeout_s
        while True:
            left_s = max(0.0, end_s - self.shot.clock.now())
            try:
                text = self.guard.call(name, left_s + DRIVER_MARGIN_S, leader.wait_for, signal, left_s)
            finally:
                self._log_events(name, leader)
            try:
                self._take_values()
            except ConfigError as error:
                self._answer(name, leader, "failed", self.guard.call, str(error), refused=True)
            else:
                break
        self._record(f"{name}.{signal}", text)
        self._log("leader_signal", name, f"{signal} {text}".strip())

    def _take_values(self) -> None:
        """Give the rest of the shot the values that the other system has sent.

        Raises:
            ConfigError: A value is wrong. The shot is unchanged.
        """
        values = dict(self._values)
        for name, dialogue in self._dialogues.items():
            values |= self.guard.call(name, self.shot.call_timeout_s, dialogue.take_values)
        if values or self.settings_for is not None:
            settings, before = self._check(values), self.shot.lab.random_streams
            self.shot.use(settings)
            for stream in settings.lab.random_streams:
                if stream not in before:  # the others began this shot before its first step
                    stream.begin_shot(self.shot.index, self.shot.record.attempt)
        self._values = values

    def _check(self, values: Mapping[str, str]) -> ShotSettings:
        """The settings with these values.

        Raises:
            ConfigError: A value is wrong, or the sequence does not allow it.
        """
        if self.settings_for is None:
            address = next(iter(values))
            what = f"the sequence does not let the leader set '{address}'"
            raise ConfigError(f"{what}; add 'leader: {{may_set: [{address}]}}' to it")
        return self.settings_for(values)

    def take_turn(self, step: str, timeout_s: float, device: str) -> None:
        """Let the other system do a step of its own. See ``labseq.plugin.Shot.leave_to_leader``."""
        name, leader = self._dialogue(device)
        limit_s, shot = timeout_s + DRIVER_MARGIN_S, self.shot
        self._log("leader_turn", name, step)
        try:
            text = self.guard.call(name, limit_s, leader.take_turn, step, timeout_s, shot.index)
        finally:
            self._log_events(name, leader)
        self._record(f"{name}.{step}", text)

    def image(self, image: ImageRecord) -> None:
        """Send an image, as soon as it is known, to systems that have asked for images."""
        shot = self.shot
        about = {"shot": shot.index, "image": image, "target": shot.target, "start_s": shot.start_s}
        for name, dialogue in self._dialogues.items():
            self.guard.call(name, shot.call_timeout_s, dialogue.report_image, about)

    @contextmanager
    def light(self, exposure_s: float) -> Generator[None]:
        """Have the other system turn its imaging light on for an exposure, if the profile says so."""
        lit = [(name, leader) for name, leader in self._dialogues.items() if leader.asks_for_light]
        limit_s, shot = self.shot.call_timeout_s, self.shot
        try:
            for name, leader in lit:
                self.guard.call(name, limit_s, leader.light_on, exposure_s, shot.index)
            yield
        finally:
            for name, leader in lit:
                self.guard.call_despite_stop(name, limit_s, leader.light_off, shot.index)

    def ready(self) -> None:
        """Answer "ready" after the last step.

        Raises:
            DeviceError: A device fails.
            StopRequested: The run was asked to stop. The caller must answer "failed".
        """
        for name, leader in leaders(dict(self.shot.lab.hardware())):
            self._answer(name, leader, "ready", self.guard.call)

    def failed(self, error: BaseException, emit: Emit) -> None:
        """Answer "failed" with a reason. A device that cannot answer causes a warning."""
        reason, self.emit = error_text(error) or type(error).__name__, emit
        for name, leader in leaders(dict(self.shot.lab.hardware())):
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
        *,
        refused: bool = False,
    ) -> None:
        shot, record = self.shot, self.shot.record
        about: dict[str, Any] = {"shot": shot.index, "record": record, "start_s": shot.start_s}
        about |= {"target": shot.target, **(self.place if state == "ready" else {})}
        if state == "ready" and not math.isnan(record.filling_fraction):
            about |= {"success": record.success, "filling": record.filling_fraction}
        if reason:
            about |= {"reason": reason, **({"refused": True} if refused else {})}
        if answer := call(name, shot.call_timeout_s, leader.report, state, about):
            self._record(f"{name}.answer", "refused" if refused else answer)
            self._log("leader_answered", name, answer)
        self._log_events(name, leader)

    def _dialogue(self, device: str) -> tuple[str, LeaderDialogue]:
        """The device that connects to the other system. "" for the only one.

        Raises:
            ConfigError: There is no such device, or there are several.
        """
        found = {name: leader for name, leader in self._dialogues.items() if device in ("", name)}
        if len(found) != 1:
            names = ", ".join(self._dialogues) or "none"
            raise ConfigError(
                f"a step of the leader needs exactly one device that connects to it; there is {names}"
            )
        return next(iter(found.items()))

    def _log_events(self, name: str, leader: LeaderLink) -> None:
        try:
            new_events = self.guard.call_despite_stop(name, self.shot.call_timeout_s, leader.new_events)
        except LabseqError as failure:
            new_events = [str(failure)]
        for text in new_events:
            self._log("leader_event", name, text)

    def _record(self, name: str, text: str) -> None:
        """Add to a reading of the shot, which is a list because a shot may wait several times."""
        readings = self.shot.record.readings
        readings[name] = [*readings.get(name, ()), text]

    def _log(self, event: str, device: str, text: str) -> None:
        self.emit(event, {"shot": self.shot.index, "device": device, "text": text})
