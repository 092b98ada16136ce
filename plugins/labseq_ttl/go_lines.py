"""The timing box with an external control system, whose start signal `go` is an edge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from labseq.plugin import ConfigError, Context, DeviceTimeoutError, format_quantity
from labseq.plugin.leader import LeaderLog, check_signal
from labseq_ttl.box import Box
from labseq_ttl.lines import TtlLines
from labseq_ttl.protocol import LATE, OWED
from labseq_ttl.settings import GoSettings, TtlSettings

LOOK_S: Final = 0.2
"""Time after which the box is asked, in case its message of an edge came damaged."""
HIGH: Final = "the start input is high (not wired, or raised too early); its next rising edge counts"


def ttl_lines(settings: TtlSettings, context: Context) -> TtlLines:
    """The timing box, with the start signal of an external control system if the profile has it."""
    if settings.go is None:
        return TtlLines(settings, context)
    outputs = settings.go.outputs
    for spec in context.lines:
        if name := next((name for name, pin in outputs.items() if pin == spec.channel), ""):
            text = f"'{spec.name}' is on channel {spec.channel}, which is '{name}' of the leader"
            raise ConfigError(f"{text}; expected an output for each")
    return GoLines(settings, settings.go, context)


class GoLines(TtlLines):
    """A timing box with an external control system, as a ``labseq.plugin.LeaderLink``.

    The box itself detects the edge, raises `busy`, and keeps the deadline, also if labseq hangs or dies.

    Args:
        go: Outputs that are wired to the external control system.
    """

    def __init__(self, settings: TtlSettings, go: GoSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._go = go
        self._is_owed = False
        self._log = LeaderLog()

    @property
    def deadline_s(self) -> float:
        """Longest time from `go` to its answer, in seconds."""
        return self._go.deadline

    def close(self) -> None:
        """Answer a waiting `go`, turn all lines off and disconnect. Legal in any state."""
        try:
            self.safe_state()
            if self._box is not None:
                self._box.ask("deaf")  # a `go` without an answer has failed
        finally:
            self._is_owed = False
            self._disconnect()

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait for `go` (see ``labseq.plugin.LeaderLink``).

        Raises:
            DeviceError: Not open, another signal, or the box was reset.
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        box = self._opened()
        check_signal(signal, self._name)
        timeout_s = self.access.raise_go(timeout_s)
        until_s = self._clock.now() + timeout_s
        while not self._take(box):
            left_s = until_s - self._clock.now()
            if left_s <= 0:
                raise self._no_go(timeout_s, is_high=bool(box.leader().level))
            if (event := box.new_events(min(left_s, LOOK_S))) is not None:
                self._handle(event)
        return ""

    def report(self, state: str, about: Mapping[str, Any]) -> str:
        """Raise `ready` or `failed` (see ``labseq.plugin.LeaderLink``).

        Raises:
            DeviceError: Not open, or the box does not answer. It raises `failed` itself at the deadline.
        """
        del about  # an edge carries no more than that
        if not self._is_owed:
            return ""
        box = self._opened()
        self._clock.check()  # a stop now is better than between `ready` and its confirmation
        was, more_came = box.answer_leader(is_ready=state == "ready")
        self._is_owed = False
        if more_came:
            self._log.note_refused()
        if is_late := was == LATE:
            self._log.note_late()
        return "late" if is_late else state

    def new_events(self) -> Sequence[str]:
        """Messages since the last call."""
        return self._log.new_events()

    def describe(self) -> Mapping[str, Any]:
        """As for the box, with the outputs for the leader."""
        return {
            **super().describe(),
            "leader": {"input": 8, **self._go.outputs, "deadline_s": self.deadline_s},
        }

    def _connect(self) -> None:
        super()._connect()
        pins = (self._go.busy, self._go.ready, self._go.failed)
        masks = [0 if pin is None else 1 << pin for pin in pins]
        try:
            if self._opened().lead(masks, self._go.deadline if self.access.real_time else 0.0):
                self._log.note(HIGH)
        except BaseException:
            self._disconnect()
            raise

    def _take(self, box: Box) -> bool:
        """Take a `go` that the box has accepted, unless its deadline has passed."""
        state = box.leader().state
        if state not in (OWED, LATE) or self._is_owed:
            return False
        if state == LATE:
            self._log.note_unawaited()
            box.answer_leader(is_ready=False)
            return False
        self._is_owed = True
        return True

    def _no_go(self, timeout_s: float, *, is_high: bool) -> DeviceTimeoutError:
        what = f"no rising edge at the box's start input within {format_quantity(timeout_s, 'time')}"
        why = "it is high, so it is not wired or was raised too early" if is_high else "it is low"
        return DeviceTimeoutError(self._name, f"{what} ({why}); see 'timeout' of the wait", timeout_s)
