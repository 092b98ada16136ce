"""What the box knows of a leader, in the words of its protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from labseq_ttl.box import Box
from labseq_ttl.protocol import LATE, OWED
from labseq_ttl.settings import GoSettings

HIGH: Final = "the start input is high: not wired, or raised too early; its next rising edge counts"
MORE: Final = "`go` rose again while labseq was busy, and was refused"


@dataclass(frozen=True, slots=True)
class Leader:
    """The state of its dialogue with the box.

    Attributes:
        state: DEAF, IDLE, OWED or LATE of the protocol.
        n_go_signals: Edges that the box took since its start.
        more_came: Whether one came that it could not take.
        is_high: Level of the start input.
    """

    state: int
    n_go_signals: int
    more_came: bool
    is_high: bool

    @property
    def has_gone(self) -> bool:
        """Whether a `go` was taken that labseq has not answered."""
        return self.state in (OWED, LATE)

    @property
    def is_late(self) -> bool:
        """Whether its deadline has passed."""
        return self.state == LATE


class LeaderPins:
    """The start input and the outputs of a leader.

    Args:
        box: The box.
        settings: Which outputs they are.
        deadline_s: Of an answer; 0 for none.
    """

    def __init__(self, box: Box, settings: GoSettings, deadline_s: float) -> None:
        self._box = box
        self._settings = settings
        self._deadline_s = deadline_s

    def poll_input(self) -> bool:
        """Take rising edges from now on; whether the input is high."""
        pins = (self._settings.busy, self._settings.ready, self._settings.failed)
        masks = " ".join(f"{0 if pin is None else 1 << pin:x}" for pin in pins)
        (level,) = self._box.ask_numbers(f"lead {masks} {int(self._deadline_s * 1e3):x}", 1)
        return bool(level)

    def look(self) -> Leader:
        """What has happened; a cheap question."""
        state, n_go_signals, more, level = self._box.ask_numbers("leader", 4)
        return Leader(state, n_go_signals, bool(more), bool(level))

    def answer(self, *, is_ready: bool) -> tuple[bool, bool]:
        """Raise `ready` or `failed`, and lower `busy`.

        Returns:
            Whether the deadline had passed, and whether further edges came meanwhile.
        """
        was, more = self._box.ask_numbers(f"answer {is_ready:d}", 2)
        return was == LATE, bool(more)

    def end(self) -> None:
        """Listen no more; a `go` without an answer has failed."""
        self._box.line.ask("deaf")
