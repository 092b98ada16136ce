"""A timing box through which another control system leads: `go` is an edge at its start input."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    format_quantity,
)
from labseq_ttl.box import Box
from labseq_ttl.connection import SIMULATED_MAX_WAIT_S
from labseq_ttl.leader import HIGH, MORE, LeaderPins
from labseq_ttl.lines import TtlLines
from labseq_ttl.settings import GoSettings, TtlSettings

GO: Final = "go"
LOOK_S: Final = 0.2
"""Time after which the box is asked, in case what it said of an edge came damaged."""


def ttl_lines(settings: TtlSettings, context: Context) -> TtlLines:
    """The driver: one that a leader can lead through if the profile says so.

    Raises:
        ConfigError: A line is on an output of the leader.
    """
    if settings.go is None:
        return TtlLines(settings, context)
    outputs = settings.go.outputs
    for spec in context.lines:
        if name := next((name for name, pin in outputs.items() if pin == spec.channel), ""):
            text = f"'{spec.name}' is on channel {spec.channel}, which is '{name}' of the leader"
            raise ConfigError(f"{text}; expected an output for each")
    return LeadingLines(settings, settings.go, context)


class LeadingLines(TtlLines):
    """The same box; implements ``labseq.LeaderLink`` too.

    The box itself takes the edge, raises `busy`, and keeps the deadline, also if labseq hangs or dies.

    Args:
        settings: Of the box.
        go: What is wired to the leader.
        context: See :class:`~labseq_ttl.lines.TtlLines`.
    """

    def __init__(self, settings: TtlSettings, go: GoSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._go = go
        self._pins: LeaderPins | None = None
        self._is_owed = False
        self._news: deque[str] = deque(maxlen=100)

    @property
    def deadline_s(self) -> float:
        """Longest time from `go` to its answer, in seconds."""
        return self._go.deadline

    def close(self) -> None:
        """Answer a leader that waits for an answer, turn all lines off and disconnect; legal in any state."""
        try:
            self.safe_state()
            if self._pins is not None and self._connection is not None:
                self._pins.end()
        finally:
            self._pins, self._is_owed = None, False
            self._disconnect()

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait for `go`; see ``labseq.LeaderLink``.

        Raises:
            DeviceError: Not open, another signal, or the box was reset.
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        pins, box = self._opened_pins(), self._opened().box
        if signal != GO:
            raise DeviceError(self._name, f"unknown signal '{signal}'; expected '{GO}'")
        if self._opened().counterpart is not None:
            timeout_s = self._go_by_itself(timeout_s)
        until_s = self._clock.now() + timeout_s
        while not self._take(pins):
            left_s = until_s - self._clock.now()
            if left_s <= 0:
                raise self._no_go(timeout_s, is_high=pins.look().is_high)
            if (new_events := box.line.new_events(min(left_s, LOOK_S))) is not None:
                self._hear(new_events)
        return ""

    def report(self, state: str, about: Mapping[str, bool | int | float | str]) -> str:
        """Raise `ready` or `failed`; see ``labseq.LeaderLink``.

        Raises:
            DeviceError: Not open, or the box does not answer: it raises `failed` by itself at the deadline.
        """
        del about  # a line says no more than that
        if not self._is_owed:
            return ""
        pins = self._opened_pins()
        self._clock.check()  # rather now than between `ready` and the box's word for it
        is_late, more_came = pins.answer(is_ready=state == "ready")
        self._is_owed = False
        if more_came:
            self._news.append(MORE)
        if is_late:
            self._news.append("the shot is not over at the deadline; the leader was told that it failed")
        return "late" if is_late else state

    def new_events(self) -> Sequence[str]:
        """What happened since the last call."""
        new_events = [*self._news]
        self._news.clear()
        return new_events

    def describe(self) -> Mapping[str, Any]:
        """Those of the box, and the outputs of the leader."""
        told = super().describe()
        return {**told, "leader": {"input": 8, **self._go.outputs, "deadline_s": self.deadline_s}}

    def _connect(self) -> Box:
        box = super()._connect()
        try:
            deadline_s = 0.0 if self._settings.is_simulated else self._go.deadline
            self._pins = LeaderPins(box, self._go, deadline_s)
            if self._pins.poll_input():
                self._news.append(HIGH)
        except BaseException:
            self._disconnect()
            raise
        return box

    def _take(self, pins: LeaderPins) -> bool:
        """Take a `go` that the box has heard, if it is not too late for it."""
        leader = pins.look()
        if not leader.has_gone or self._is_owed:
            return False
        if leader.is_late:
            self._news.append("no step waited for `go` before its deadline; the leader was told of a failure")
            pins.answer(is_ready=False)
            return False
        self._is_owed = True
        return True

    def _go_by_itself(self, timeout_s: float) -> float:
        """What a simulated leader does: it loads atoms, and raises `go`. How long it may take to be heard."""
        after_s, counterpart = self._go.simulated_go_delay, self._opened().counterpart
        assert counterpart is not None
        if after_s > timeout_s:
            self._clock.sleep(timeout_s)
            what = f"the simulated leader says '{GO}' after {format_quantity(after_s, 'time')}"
            raise DeviceTimeoutError(self._name, f"{what}; see 'simulated_go_delay'", timeout_s)
        start_s, world = self._clock.now(), self._world
        self._clock.sleep(after_s)
        if world is not None and ((truth := world.truth()) is None or not truth.any()):
            world.load(start_s, after_s)
        counterpart.start()
        if self._opened().box.line.new_events(SIMULATED_MAX_WAIT_S) is None:
            raise DeviceError(self._name, "the simulated box does not hear the simulated leader")
        return LOOK_S

    def _opened_pins(self) -> LeaderPins:
        self._opened()
        assert self._pins is not None
        return self._pins

    def _no_go(self, timeout_s: float, *, is_high: bool) -> DeviceTimeoutError:
        what = f"no rising edge at the box's start input within {format_quantity(timeout_s, 'time')}"
        why = "it is high: not wired, or raised before labseq listened" if is_high else "it is low"
        return DeviceTimeoutError(self._name, f"{what}; {why}; see 'timeout' of the wait", timeout_s)
