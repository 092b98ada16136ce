"""A model of the box with the same answers to the same lines, without its firmware.

It plays a program in no time at all, from its command or the edge at the start input on, and answers at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from labseq_ttl.protocol import (
    DEAF,
    EDGES,
    IDLE,
    LATE,
    LINE,
    LONGEST,
    MAX_MS,
    NAME,
    OUTPUTS,
    OWED,
    SHORTEST,
    SLOTS,
    STOP,
    VERSION,
    Edge,
    framed,
    unframed,
)

from labseq.plugin.serial import Port

IDLE_S: Final = 1e-3
"""How long a read waits if nothing came, in seconds."""

POWER_UP: Final = 1
RESET_INPUT: Final = 2


class RefusedError(Exception):
    """The box refuses a command."""


def numbers(words: list[str], *most: int) -> list[int]:
    """Read hexadecimal numbers and check their upper limits. Each bit of a mask must be an output."""
    if len(words) != len(most):
        raise RefusedError("arguments")
    read: list[int] = []
    for word, limit in zip(words, most, strict=True):
        if not 1 <= len(word) <= 8 or not set(word) <= set("0123456789abcdefABCDEF"):
            raise RefusedError("arguments")
        number = int(word, 16)
        if number > limit or (limit == OUTPUTS and number & ~OUTPUTS):
            raise RefusedError("arguments")
        read.append(number)
    return read


class LeaderInput:
    """The start input at which a leader raises `go`, as in ``firmware/lead.c`` but without its clock.

    Attributes:
        state: One of ``DEAF``, ``IDLE``, ``OWED``, ``LATE``.
        signals: Outputs that are on for the leader.
        n_go_signals: Edges that were taken.
        more_came: Whether an edge came that could not be taken.
        level: Level of the input, which is pulled up.
    """

    def __init__(self) -> None:
        self.state = DEAF
        self.signals = self.n_go_signals = 0
        self.more_came = False
        self.level = 1
        self._busy = self._ready = self._failed = 0

    def begin(self, busy: int, ready: int, failed: int) -> None:
        """Accept edges from now on. Earlier edges do not count."""
        self._busy, self._ready, self._failed = busy, ready, failed
        self.state, self.signals, self.more_came = IDLE, 0, False

    def end(self) -> None:
        """Accept no more edges."""
        if self.state != DEAF:
            self.signals = self._failed if self.state == OWED else self.signals & ~self._busy
        self.state, self.more_came = DEAF, False

    def rise(self) -> bool:
        """Raise the input, and return whether that is a `go`."""
        self.level = 1
        self.more_came = self.state in (OWED, LATE)
        if self.state != IDLE:
            return False
        self.state, self.signals = OWED, self._busy
        self.n_go_signals = (self.n_go_signals + 1) & 0xFFFF
        return True

    def pass_deadline(self) -> None:
        """The answer is late."""
        if self.state == OWED:
            self.state, self.signals = LATE, self._busy | self._failed

    def answer(self, *, is_ready: bool) -> str:
        """Send the leader the result of its `go`, and return the box's answer."""
        said = f"{self.state:02x} {self.more_came:02x}"
        self.signals = self._ready if is_ready and self.state != LATE else self._failed
        self.state, self.more_came = IDLE, False
        return said


class ModelBox:
    """A box in this process, which is its own serial port too.

    Attributes:
        on: Channels that are on, bit n for channel n.
    """

    def __init__(self) -> None:
        self.on = 0
        self._commands: dict[str, tuple[Callable[..., str | None], tuple[int, ...] | None]] = {
            "id": (self._identify, None),
            "state": (self._state, None),
            "put": (self._put, None),
            "get": (self._get, (SLOTS - 1, EDGES - 1)),
            "arm": (self._arm, (SLOTS - 1, EDGES)),
            "fire": (self._fire, ()),
            "await": (self._await, ()),
            "lead": (self._begin_leading, (OUTPUTS, OUTPUTS, OUTPUTS, MAX_MS)),
            "answer": (self._answer_leader, (1,)),
            "leader": (self._report_to_leader, None),
            "deaf": (self._end_leading, None),
            "set": (partial(setattr, self, "on"), (OUTPUTS,)),
            "off": (self._off, None),
            "timeout": (partial(setattr, self, "_timeout_ms"), (0xFFFF,)),
            "polarity": (partial(setattr, self, "_polarity"), (OUTPUTS,)),
            "serial": (partial(setattr, self, "_serial"), (0xFFFF,)),
        }  # with the upper limits of their arguments, None for unchecked ones. The model has no clock
        self._out = bytearray()
        self._polarity = self._serial = 0
        self._boots = -1  # as an erased memory counts
        self._unplugged = False
        self._reset_after: int | None = None
        self._edges: list[Edge] = []
        self._boot(POWER_UP)

    @property
    def signals(self) -> int:
        """Outputs that are on for a leader, in addition to the outputs of the lines."""
        return self._leader.signals

    @property
    def port(self) -> Port:
        """Itself."""
        return self

    @property
    def in_waiting(self) -> int:
        """Bytes that wait to be read."""
        self._check_plugged()
        return len(self._out)

    def read(self, size: int = 1, /) -> bytes:
        """Bytes that the box sent."""
        self._check_plugged()
        if not self._out:
            threading.Event().wait(IDLE_S)
        came, self._out = self._out[:size], self._out[size:]
        return bytes(came)

    def write(self, data: bytes, /) -> int:
        """Send bytes to the box."""
        self._check_plugged()
        for byte in data:
            self._take(byte)
        return len(data)

    def reset_input_buffer(self) -> None:
        """Drop the bytes that the box sent."""
        self._out.clear()

    def close(self) -> None:
        """Nothing is open."""

    def played(self) -> list[Edge]:
        """Edges of the last program, with ticks since the first, and the channels on from then on."""
        return self._edges

    def reset(self, after_ticks: int | None = None) -> None:
        """Press the reset button, now or some ticks after the first edge of the next program."""
        self._reset_after = after_ticks
        if after_ticks is None:
            self._boot(RESET_INPUT)

    def start(self) -> None:
        """A rising edge at the start input, which starts a waiting program, or is a leader's `go`."""
        if self._waits:
            self._leader.level = 1
            self._play()
        elif self._leader.rise():
            self._send(f"!go {self._boots:04x} {self._leader.n_go_signals:04x}")

    def lower(self) -> None:
        """The start input goes low."""
        self._leader.level = 0

    def pass_deadline(self) -> None:
        """Let the deadline of a leader pass. The model has no clock."""
        self._leader.pass_deadline()

    def unplug(self) -> None:
        """Pull the cable."""
        self._unplugged = True

    def say(self, data: bytes) -> None:
        """Send something without a command."""
        self._out += data

    def _check_plugged(self) -> None:
        if self._unplugged:
            raise OSError(5, "Input/output error")

    def _boot(self, cause: int) -> None:
        self._cause, self._boots = cause, (self._boots + 1) & 0xFFFF
        self._line = bytearray()
        self._slots: list[list[Edge]] = [[] for _ in range(SLOTS)]
        self._armed: int | None = None
        self._is_due = self._waits = False
        self._runs = self.on = 0
        self._leader = LeaderInput()
        self._send(f"!boot {self._boots:04x} {cause:02x}")

    def _take(self, byte: int) -> None:
        if byte == STOP[0]:
            self._off()
            self._line.clear()
            self._send(f"!off {self._boots:04x}")
        elif self._waits:
            pass
        elif byte == ord("\n"):
            if self._line:
                self._answer()
            self._line.clear()
        elif byte != ord("\r") and len(self._line) <= LINE:
            self._line.append(byte)

    def _answer(self) -> None:
        said = unframed(bytes(self._line)) if len(self._line) <= LINE else None
        if said is None or said[1:2] != " ":
            self._send("? no damaged")
            return
        name, *words = said[2:].split(" ")
        try:
            if name not in self._commands:
                raise RefusedError("unknown")
            method, limits = self._commands[name]
            arguments: list[Any] = [] if limits is None else [*numbers(words, *limits)]
            if name == "put":  # as many edges as there are
                arguments = [words]
            answer = f"{said[0]} ok {method(*arguments) or ''}".rstrip()
        except RefusedError as refusal:
            answer = f"{said[0]} no {refusal}"
        self._send(answer)
        if self._is_due:
            self._play()

    def _send(self, text: str) -> None:
        self._out += framed(text)

    def _identify(self) -> str:
        return f"{NAME} {VERSION:02x} {self._serial:04x} {self._boots:04x} {self._cause:02x}"

    def _state(self) -> str:
        doing = "idle" if self._armed is None else "armed"
        return f"{doing} {self._boots:04x} {self._runs:04x} {self.on:04x} {self._polarity:04x}"

    def _put(self, words: list[str]) -> str:
        slot, first = numbers(words[:2], SLOTS - 1, EDGES - 1)
        edges = self._slots[slot]
        if first > len(edges):
            raise RefusedError("gap")
        if self._armed == slot:
            self._armed = None
        del edges[first:]
        rest = words[2:]
        while True:
            ticks, mask = numbers(rest[:2], LONGEST, OUTPUTS)
            if len(edges) == EDGES:
                raise RefusedError("full")
            if ticks < SHORTEST if edges else ticks != 0:
                raise RefusedError("short")
            edges.append((ticks, mask))
            rest = rest[2:]
            if not rest:
                return f"{len(edges):02x}"

    def _get(self, slot: int, i: int) -> str:
        if i >= len(self._slots[slot]):
            raise RefusedError("gap")
        ticks, mask = self._slots[slot][i]
        return f"{ticks:08x} {mask:04x}"

    def _arm(self, slot: int, n_edges: int) -> str:
        if not n_edges or n_edges != len(self._slots[slot]):
            raise RefusedError("gap")
        self._armed = slot
        return f"{self._boots:04x}"

    def _fire(self) -> None:
        self._check_armed()
        self._is_due = True

    def _await(self) -> None:
        if self._leader.state != DEAF:
            raise RefusedError("led")
        self._check_armed()
        self._waits = True

    def _check_armed(self) -> None:
        if self._armed is None:
            raise RefusedError("unarmed")

    def _begin_leading(self, busy: int, ready: int, failed: int, _deadline_ms: int) -> str:
        self._leader.begin(busy, ready, failed)
        return f"{self._leader.level:02x}"

    def _answer_leader(self, is_ready: int) -> str:
        if self._leader.state == DEAF:
            raise RefusedError("deaf")
        return self._leader.answer(is_ready=bool(is_ready))

    def _report_to_leader(self) -> str:
        leader = self._leader
        return f"{leader.state:02x} {leader.n_go_signals:04x} {leader.more_came:02x} {leader.level:02x}"

    def _end_leading(self) -> None:
        self._leader.end()

    def _off(self) -> None:
        self._armed, self.on = None, 0
        self._waits = False

    def _play(self) -> None:
        """Play the armed program. A reset that is due in its middle ends it."""
        assert self._armed is not None
        edges, self._armed = self._slots[self._armed], None
        until, self._reset_after = self._reset_after, None
        self._is_due = self._waits = False
        self._edges, tick = [], 0
        for ticks, mask in edges:
            tick += ticks
            if until is not None and tick >= until:
                self._edges.append((until, 0))
                self._boot(RESET_INPUT)
                return
            self._edges.append((tick, mask))
            self.on = mask
        self._runs = (self._runs + 1) & 0xFFFF
        self._send(f"!done {self._boots:04x} {self._runs:04x}")
