"""The protocol between labseq and an external control system, without I/O."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from labseq.plugin.leader import GO, LeaderLog
from labseq.plugin.messages import clean, visible
from labseq_follow.answers import SHORT_LINE, VERSION, Form, Times, facts_of, form_of, line, one_line
from labseq_follow.relay import ANSWERED

MAX_LINE: Final = SHORT_LINE
"""Longest line in bytes that a control system sends; more is noise."""
MARKED: Final = re.compile(rf"{ANSWERED.decode()}(\d+\.\d+){ANSWERED.decode()}", re.ASCII)
"""What precedes a `go` that was answered, and the time at which it came."""
NOT_ANSWERED: Final = "error"
"""Lines that begin so are never answered, or two programs could exchange errors forever."""

About = Mapping[str, Any]


@dataclass(slots=True)
class _Go:
    """A `go` whose shot is not over."""

    text: str
    came_s: float
    due_s: float
    """When it must be answered."""
    taken_s: float = math.nan
    """When a step took it; nan if none has."""
    is_aborted: bool = False
    """Whether the control system asked to end its shot."""
    answered: str = ""
    """"late" or "gone" if no answer follows any more; "" if one is still to come."""

    @property
    def taken(self) -> bool:
        """Whether a step has waited for it."""
        return not math.isnan(self.taken_s)


class Dialogue:
    """Makes sure that each `go` gets exactly one answer. It does no I/O and is not safe for threads.

    The lines that its methods return are to be sent; all times are on one clock.

    Args:
        deadline_s: Longest time from `go` to its answer.
        shape: Rows and columns of the grid.

    Attributes:
        is_waiting: Whether a step waits for `go`.
        is_connected: Whether a control system is connected.
        log: What happened.
    """

    def __init__(self, deadline_s: float, shape: tuple[int, int] = (0, 0)) -> None:
        self.is_waiting = False
        self.is_connected = False
        self.log = LeaderLog()
        self._deadline_s = deadline_s
        self._shape = shape
        self._form = Form.SHORT
        self._go: _Go | None = None

    @property
    def state(self) -> str:
        """From `go` to the end of its shot "busy", while a step waits "waiting", else "idle"."""
        if self._go is not None:
            return "busy"
        return "waiting" if self.is_waiting else "idle"

    @property
    def is_aborted(self) -> bool:
        """Whether the shot that goes on is to end."""
        return self._go is not None and self._go.is_aborted

    def connected(self, who: str, form: Form = Form.SHORT) -> list[str]:
        """A control system has connected, and asks for answers of this form."""
        self.is_connected, self._form = True, form
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

    def receive_line(self, received: str, now_s: float) -> list[str]:
        """Handle a line that came; a `go` after the mark of :mod:`labseq_follow.relay` was answered."""
        answered = MARKED.match(received)
        word, _, text = received[answered.end() if answered else 0 :].strip().partition(" ")
        if word == GO:
            came_s = min(now_s, float(answered[1])) if answered else now_s
            return self._receive_go(text.strip(), came_s, is_answered=answered is not None)
        if word == "abort" and not text:
            return self._abort()
        if word == "state?" and not text:
            return [self._line("state", self.state)]
        if word == "hello":
            return self._receive_hello(text)
        if word:
            self.log.note(f"the leader sent '{clean(received.strip())}'")
        if not word or word == NOT_ANSWERED:
            return []
        return [self.error(f"what is '{one_line(received)[:40]}'? expected go, abort, state? or hello")]

    @property
    def next_answer(self) -> str:
        """The line that answers the next `go`; "" if that is to be refused."""
        return self._line("busy") if self._go is None else ""

    def error(self, reason: str) -> str:
        """The line that refuses what a control system sent."""
        return self._line("error", reason)

    def take(self, now_s: float) -> str | None:
        """Take a pending `go` for a step that waits: its text; None if there is none."""
        if self._go is None or self._go.taken or now_s >= self._go.due_s:
            return None
        self._go.taken_s = now_s
        return self._go.text

    def report(self, state: str, about: About, now_s: float) -> tuple[str, list[str]]:
        """The shot of a `go` is over: the answer (``labseq.plugin.LeaderLink.report``) and lines to send."""
        if self._go is None or not self._go.taken:
            return "", []
        late = self.overdue(now_s)
        go, self._go = self._go, None
        if go.answered:
            return go.answered, late
        facts = facts_of(about, Times(go.came_s, go.taken_s, now_s))
        return state, [line(self._form, state, facts)]

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
        return [self._failed("deadline")]

    def end(self) -> list[str]:
        """Answer a pending `go`, because labseq ends."""
        go, self._go = self._go, None
        return [] if go is None or go.answered else [self._failed("labseq ends")]

    def _receive_go(self, text: str, came_s: float, *, is_answered: bool) -> list[str]:
        if self._go is not None:
            self.log.note_refused()
            return [self._failed("busy")]
        self._go = _Go(visible(text), came_s, came_s + self._deadline_s)
        return [] if is_answered else [self._line("busy")]

    def _abort(self) -> list[str]:
        """End the shot: at once if no step has taken its `go`, otherwise before it next moves atoms."""
        if self._go is None:
            return [self.error("no shot to abort")]
        self.log.note("the leader aborted its shot")
        if self._go.taken:
            self._go.is_aborted = True
            return []
        self._go = None
        return [self._failed("aborted")]

    def _receive_hello(self, words: str) -> list[str]:
        first, _, others = words.partition(" ")
        try:
            self._form = form_of(words if "=" in first else others)  # the token has done its work
        except ValueError as error:
            return [self.error(str(error))]
        return [self._hello()]

    def _failed(self, reason: str) -> str:
        return line(self._form, "failed", {"reason": reason})

    def _line(self, word: str, text: str = "") -> str:
        """A line without facts: "state busy"; in JSON its text has a key."""
        if self._form is Form.JSON:
            key = "state" if word == "state" else "reason"
            return line(self._form, word, {key: text} if text else {})
        return f"{word} {text}".strip()

    def _hello(self) -> str:
        n_rows, n_cols = self._shape
        if self._form is Form.JSON:
            facts = {"protocol": VERSION, "deadline_s": self._deadline_s, "shape": [n_rows, n_cols]}
            return line(self._form, "hello", facts)
        shape = f" rows={n_rows} cols={n_cols}" if self._form is Form.TEXT else ""
        return f"hello labseq {VERSION} deadline={self._deadline_s:g}{shape}"


class Splitter:
    """Splits the received bytes into lines."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, came: bytes) -> list[str | None]:
        """The lines that are complete; None for each that was too long."""
        *lines, begun = (self._begun + came).split(b"\n")
        self._begun = begun[: MAX_LINE + 1]  # enough to see that it is too long
        return [_decoded(part) if len(part) <= MAX_LINE else None for part in lines]

    def rest(self) -> str:
        """The part of a line that has not ended; it is dropped."""
        rest, self._begun = self._begun, b""
        return _decoded(rest)


def _decoded(data: bytes) -> str:
    return data.decode("utf-8", "backslashreplace")


def encoded(text: str) -> bytes:
    """Encode a line for sending, as ASCII."""
    return text.encode("ascii", "backslashreplace") + b"\n"
