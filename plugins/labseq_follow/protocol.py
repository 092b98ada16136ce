"""The protocol between labseq and an external control system, without I/O."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from labseq.plugin.leader import LeaderLog
from labseq.plugin.messages import clean, visible
from labseq_follow.answers import (
    VERSION,
    Asked,
    Form,
    Times,
    asked_for,
    facts_of,
    image_facts,
    line,
    one_line,
)
from labseq_follow.relay import ANSWERED, LONGEST
from labseq_follow.requests import Request, read_request

MARKED: Final = re.compile(rf"{ANSWERED.decode()}(\d+\.\d+){ANSWERED.decode()}", re.ASCII)
"""The mark before a `go` that was already answered, with the time at which the `go` came."""
NOT_ANSWERED: Final = "error"
"""Lines that begin with this are never answered, or two programs could exchange errors forever."""

EXPECTED: Final = "expected go, set, abort, state? or hello"
REPLIES: Final = ("done", "lit", "dark")
"""Replies of a control system to labseq's requests."""
UNANSWERED: Final = "unanswered"
"""Replaces a reply if the control system that owes it has left. No other can give it."""

About = Mapping[str, Any]


@dataclass(slots=True)
class _Go:
    """A `go` whose shot is not over."""

    request: Request
    came_s: float
    due_s: float
    """Deadline for the answer. Infinite while labseq waits for a step of the control system."""
    taken_s: float = math.nan
    """Time when a step took it, or nan."""
    is_aborted: bool = False
    """Whether the control system asked to end its shot."""
    answered: str = ""
    """"late" or "gone" if no answer will follow, or "" if one is still to come."""

    @property
    def taken(self) -> bool:
        """Whether a step has taken the signal."""
        return not math.isnan(self.taken_s)


class Dialogue:
    """Makes sure that each `go` gets exactly one answer. It does no I/O and is not safe for threads.

    Its methods return the lines to send. All times are on one clock.

    Args:
        deadline_s: Longest time from `go` to its answer.
        shape: Rows and columns of the grid.

    Attributes:
        is_waiting: Whether a step waits for `go`.
        is_connected: Whether a control system is connected.
        asked: What the control system asked for when it connected.
        unchecked: The values of a `set` that still have to be checked, or None.
        awaited: The reply that labseq waits for, "" for none, or UNANSWERED if it will not come.
        reply: Text of the last reply.
        log: Messages about the connection.
    """

    def __init__(self, deadline_s: float, shape: tuple[int, int] = (0, 0)) -> None:
        self.is_waiting = False
        self.is_connected = False
        self.log = LeaderLog()
        self._deadline_s = deadline_s
        self._shape = shape
        self.asked = Asked()
        self.unchecked: Mapping[str, str] | None = None
        self.awaited = self.reply = ""
        self._set: Mapping[str, str] = {}
        self._go: _Go | None = None
        self._left_s = 0.0

    @property
    def state(self) -> str:
        """State "busy" from `go` to the end of its shot, "waiting" while a step waits, else "idle"."""
        if self._go is not None:
            return "busy"
        return "waiting" if self.is_waiting else "idle"

    @property
    def can_be_asked(self) -> bool:
        """Whether the control system that began the shot is connected, or any for a shot without `go`."""
        return self.is_connected and (self._go is None or self._go.answered != "gone")

    @property
    def is_aborted(self) -> bool:
        """Whether the control system asked to end the shot in progress."""
        return self._go is not None and self._go.is_aborted

    def connected(self, who: str, asked: Asked = Asked()) -> list[str]:  # noqa: B008 - frozen
        """Handle a control system that has connected."""
        self.is_connected, self.asked = True, asked
        self.log.note(f"{who} leads")
        return [self._hello()]

    def lost(self, reason: str) -> None:
        """Handle a lost connection. A `go` that no step has taken is dropped, but a shot continues."""
        self.is_connected, self.unchecked, self._set = False, None, {}
        if self.awaited:
            self.awaited = UNANSWERED  # until the shot ends, even if another leader connects before
        self.log.note(f"the leader is gone: {reason}")
        if self._go is not None and not self._go.taken:
            self._go = None
        elif self._go is not None and not self._go.answered:
            self._go.answered = "gone"
            self.log.note("its shot continues, but its result will not be sent")

    def receive_line(self, received: str, now_s: float) -> list[str]:
        """Handle a received line. A `go` after the mark of :mod:`labseq_follow.relay` is already answered."""
        answered = MARKED.match(received)
        sent = received[answered.end() if answered else 0 :].strip()
        request = read_request(sent, with_values=self.asked.form is not Form.SHORT)
        match request.word:
            case "go":
                came_s = min(now_s, float(answered[1])) if answered else now_s
                return self._receive_go(request, came_s, is_answered=answered is not None)
            case "set":
                return self._receive_set(request)
            case "hello":
                return self._receive_hello(request.text)
            case "abort" if not request.text:
                return self._abort()
            case "state?" if not request.text:
                return [self._line("state", self.state)]
            case word if word in REPLIES:
                return self._receive_reply(request)
            case word:
                return self._receive_other(sent, word)

    @property
    def next_answer(self) -> str:
        """The line that answers the next `go`, or "" if `go` is to be refused."""
        return self._line("busy") if self._go is None else ""

    def error(self, reason: str) -> str:
        """The line that refuses a line of the control system."""
        return self._line("error", reason)

    def take(self, now_s: float) -> str | None:
        """Take a pending `go` for a waiting step. Returns its text, or None if there is none."""
        if self._go is None or self._go.taken or now_s >= self._go.due_s:
            return None
        self._go.taken_s = now_s
        return visible(self._go.request.text)

    def take_values(self) -> Mapping[str, str]:
        """The values for the shot that begins, from `set` and then from the `go` that was taken."""
        sent = {**self._set, **(self.unchecked or {})}
        self._set, self.unchecked = {}, None
        if self.awaited == UNANSWERED:  # since the last shot
            self.awaited = ""
        return sent if self._go is None else {**sent, **self._go.request.values}

    def check_set(self, reason: str) -> list[str]:
        """Answer a `set` whose values have been checked. ``reason`` is why they are refused, or ""."""
        values, self.unchecked = self.unchecked, None
        if reason:
            return [self.error(reason)]
        self._set = values or {}
        return [self._line("set")]

    def request(self, word: str, facts: About, reply: str, now_s: float) -> list[str]:
        """Send the control system a request. Its own time does not count towards the deadline."""
        self.awaited, self.reply = reply, ""
        if self._go is not None and reply == "done":
            self._left_s, self._go.due_s = self._go.due_s - now_s, math.inf
        return [line(self.asked.form, word, facts)]

    def end_request(self, now_s: float) -> None:
        """End a request, because the reply has come or is no longer awaited."""
        self.awaited = ""
        if self._go is not None and self._go.due_s == math.inf:
            self._go.due_s = now_s + self._left_s

    def image(self, about: About) -> list[str]:
        """Send an image as soon as it is known, if the control system has asked for that."""
        go, start_s = self._go, about["start_s"]
        if not self.asked.each_image or (go.answered if go else not self.asked.listens):
            return []
        since_s = 0.0 if go is None else start_s - go.came_s
        facts = image_facts(about["image"], about["target"], since_s)
        return [line(self.asked.form, "image", {"shot": about["shot"], **facts})]

    def report(self, state: str, about: About, now_s: float) -> tuple[str, list[str]]:
        """End a `go`. Returns the answer as in ``labseq.plugin.LeaderLink.report``, and lines to send."""
        if state == "failed":
            self.awaited = ""  # otherwise the next shot would wait for this reply before its own `go`
        if self._go is None or not self._go.taken:
            return "", self._tell(state, about, now_s)
        late = self.overdue(now_s)
        go, self._go = self._go, None
        if go.answered:
            return go.answered, late
        facts = facts_of(about, Times(go.came_s, go.taken_s, now_s))
        return state, [line(self.asked.form, state, facts)]

    def _tell(self, state: str, about: About, now_s: float) -> list[str]:
        """Report the end of a shot that no `go` began, if the control system has asked for that."""
        if not (self.asked.listens and self.is_connected and "start_s" in about):
            return []
        start_s = about["start_s"]
        return [line(self.asked.form, state, facts_of(about, Times(start_s, start_s, now_s)))]

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

    def _receive_go(self, request: Request, came_s: float, *, is_answered: bool) -> list[str]:
        if self._go is not None:
            self.log.note_refused()
            return [self._failed("busy")]
        busy = [] if is_answered else [self._line("busy")]
        if request.problem:
            return [*busy, line(self.asked.form, "failed", {"refused": True, "reason": request.problem})]
        self._go = _Go(request, came_s, came_s + self._deadline_s)
        return busy

    def _receive_set(self, request: Request) -> list[str]:
        if request.problem or not request.values or request.text:
            return [self.error(request.problem or "'set' needs values such as shot.hold.duration=\"5 ms\"")]
        if self.unchecked is not None:
            return [self.error("the last 'set' has not been answered yet")]
        self.unchecked = {**self._set, **request.values}
        return []

    def _receive_reply(self, request: Request) -> list[str]:
        if request.word != self.awaited:
            return [self.error(f"labseq has not asked for '{request.word}'")]
        self.awaited, self.reply = "", visible(request.text)
        return []

    def _receive_other(self, sent: str, word: str) -> list[str]:
        if word:
            self.log.note(f"the leader sent '{clean(sent)}'")
        if not word or word == NOT_ANSWERED:
            return []
        return [self.error(f"what is '{one_line(sent)[:40]}'? {EXPECTED}")]

    def _abort(self) -> list[str]:
        """End the shot, at once if no step has taken its `go`, otherwise before it next moves atoms."""
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
            self.asked = asked_for(words if "=" in first else others)  # the token has already been checked
        except ValueError as error:
            return [self.error(str(error))]
        return [self._hello()]

    def _failed(self, reason: str) -> str:
        return line(self.asked.form, "failed", {"reason": reason})

    def _line(self, word: str, text: str = "") -> str:
        """A line without facts, such as "state busy". In JSON its text has a key."""
        if self.asked.form is Form.JSON:
            key = "state" if word == "state" else "reason"
            return line(self.asked.form, word, {key: text} if text else {})
        return f"{word} {text}".strip()

    def _hello(self) -> str:
        n_rows, n_cols = self._shape
        if self.asked.form is Form.JSON:
            facts = {"protocol": VERSION, "deadline_s": self._deadline_s, "shape": [n_rows, n_cols]}
            return line(self.asked.form, "hello", facts)
        shape = f" rows={n_rows} cols={n_cols}" if self.asked.form is Form.TEXT else ""
        return f"hello labseq {VERSION} deadline={self._deadline_s:g}{shape}"


class Splitter:
    """Splits the received bytes into lines."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, came: bytes) -> list[str | None]:
        """The complete lines, with None for each line that was too long."""
        *lines, begun = (self._begun + came).split(b"\n")
        self._begun = begun[: LONGEST + 1]  # enough to see that it is too long
        return [_decoded(part) if len(part) <= LONGEST else None for part in lines]

    def rest(self) -> str:
        """The beginning of an unfinished line, which is then dropped."""
        rest, self._begun = self._begun, b""
        return _decoded(rest)


def _decoded(data: bytes) -> str:
    return data.decode("utf-8", "backslashreplace")


def encoded(text: str) -> bytes:
    """Encode a line for sending, as ASCII."""
    return text.encode("ascii", "backslashreplace") + b"\n"
