"""The protocol between labseq and an external control system, without I/O."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from labseq.plugin.leader import GO, LeaderLog
from labseq.plugin.messages import clean, visible

VERSION: Final = 2
MAX_LINE: Final = 200
"""Longest line in bytes; more is noise."""
NOT_ANSWERED: Final = "error"
"""Lines that begin so are never answered, or two programs could exchange errors forever."""

About = Mapping[str, bool | int | float | str]


@dataclass(slots=True)
class _Go:
    """A `go` whose shot is not over."""

    text: str
    due_s: float
    """When it must be answered."""
    taken: bool = False
    """Whether a step has waited for it."""
    answered: str = ""
    """"late" or "gone" if no answer follows any more; "" if one is still to come."""


class Dialogue:
    """Makes sure that each `go` gets exactly one answer. It does no I/O and is not safe for threads.

    The lines that its methods return are to be sent; all times are on one clock.

    Args:
        deadline_s: Longest time from `go` to its answer.

    Attributes:
        is_waiting: Whether a step waits for `go`.
        is_connected: Whether a control system is connected.
        log: What happened.
    """

    def __init__(self, deadline_s: float) -> None:
        self.is_waiting = False
        self.is_connected = False
        self.log = LeaderLog()
        self._deadline_s = deadline_s
        self._go: _Go | None = None

    @property
    def state(self) -> str:
        """From `go` to the end of its shot "busy", while a step waits "waiting", else "idle"."""
        if self._go is not None:
            return "busy"
        return "waiting" if self.is_waiting else "idle"

    def connected(self, who: str) -> list[str]:
        """A control system has connected."""
        self.is_connected = True
        self.log.note(f"{who} leads")
        return [self._hello()]

    def lost(self, reason: str) -> None:
        """The control system is gone: a `go` for which no step waited is dropped; a shot goes on."""
        self.is_connected = False
        self.log.note(f"the leader is gone: {reason}")
        if self._go is not None and not self._go.taken:
            self._go = None
        elif self._go is not None and not self._go.answered:
            self._go.answered = "gone"
            self.log.note("its shot continues; its result will not be sent")

    def receive_line(self, line: str, now_s: float) -> list[str]:
        """Handle a line that came."""
        word, _, text = line.strip().partition(" ")
        if word == GO:
            return self._receive_go(text.strip(), now_s)
        if word == "state?" and not text:
            return [f"state {self.state}"]
        if word == "hello":
            return [self._hello()]
        if word:
            self.log.note(f"the leader sent '{clean(line.strip())}'")
        if not word or word == NOT_ANSWERED:
            return []
        return [f"error what is '{_one_line(line)[:40]}'? expected go, state? or hello"]

    def take(self, now_s: float) -> tuple[str, list[str]] | None:
        """Take a pending `go` for a step that waits: its text and lines to send; None if there is none."""
        if self._go is None or self._go.taken or now_s >= self._go.due_s:
            return None
        self._go.taken = True
        return self._go.text, ["busy"]

    def report(self, state: str, about: About, now_s: float) -> tuple[str, list[str]]:
        """The shot of a `go` is over: the answer (``labseq.plugin.LeaderLink.report``) and lines to send."""
        if self._go is None or not self._go.taken:
            return "", []
        late = self.overdue(now_s)
        go, self._go = self._go, None
        if go.answered:
            return go.answered, late
        return state, [_answer(state, about)]

    def overdue(self, now_s: float) -> list[str]:
        """Answer a `go` whose deadline has passed."""
        go = self._go
        if go is None or go.answered or now_s < go.due_s:
            return []
        if go.taken:
            go.answered = "late"
            self.log.note_late()
        else:
            self._go = None
            self.log.note_unawaited()
        return [_answer("failed", {"reason": "deadline"})]

    def end(self) -> list[str]:
        """Answer a pending `go`, because labseq ends."""
        go, self._go = self._go, None
        return [] if go is None or go.answered else [_answer("failed", {"reason": "labseq ends"})]

    def _receive_go(self, text: str, now_s: float) -> list[str]:
        if self._go is not None:
            self.log.note_refused()
            return [_answer("failed", {"reason": "busy"})]
        self._go = _Go(visible(text), now_s + self._deadline_s)
        return []

    def _hello(self) -> str:
        return f"hello labseq {VERSION} deadline={self._deadline_s:g}"


class Splitter:
    """Splits the received bytes into lines."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, came: bytes) -> list[str | None]:
        """The lines that are complete; None for each that was too long."""
        *lines, begun = (self._begun + came).split(b"\n")
        self._begun = begun[: MAX_LINE + 1]  # enough to see that it is too long
        return [_decoded(line) if len(line) <= MAX_LINE else None for line in lines]

    def rest(self) -> str:
        """The part of a line that has not ended; it is dropped."""
        rest, self._begun = self._begun, b""
        return _decoded(rest)


def _decoded(line: bytes) -> str:
    return line.decode("utf-8", "backslashreplace")


def encoded(line: str) -> bytes:
    """Encode a line for sending, as ASCII."""
    return line.encode("ascii", "backslashreplace")[:MAX_LINE] + b"\n"


def _answer(state: str, about: About) -> str:
    """Format an answer: "ready shot=12 success=1 filling=0.987"; a reason comes last."""
    parts = [state]
    for key, value in sorted(about.items(), key=lambda item: item[0] == "reason"):
        if isinstance(value, bool | int):
            parts.append(f"{key}={int(value)}")
        else:
            parts.append(f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={_one_line(value)}")
    return " ".join(parts)


def _one_line(text: str) -> str:
    return " ".join(visible(text).split())
