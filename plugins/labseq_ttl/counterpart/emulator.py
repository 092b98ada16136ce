"""A model of the box: the same answers to the same lines, without its firmware.

It plays a program in no time at all, and its own answers come at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Final

from labseq.drivers.serial_port import Port
from labseq_ttl.protocol import (
    EDGES,
    LINE,
    LONGEST,
    NAME,
    OUTPUTS,
    SHORTEST,
    SLOTS,
    STOP,
    VERSION,
    Edge,
    framed,
    unframed,
)

IDLE_S: Final = 1e-3
"""How long a read waits in vain, in seconds."""

POWER_UP: Final = 1
RESET_INPUT: Final = 2


class RefusedError(Exception):
    """The box refuses a command."""


class EmulatedBox:
    """A box in this process; it is its own port too.

    Attributes:
        on: What is on: bit n is channel n.
    """

    def __init__(self) -> None:
        self.on = 0
        self._commands: Mapping[str, Callable[[list[str]], str]] = {
            "id": self._identify,
            "state": self._state,
            "polarity": self._set_polarity,
            "serial": self._set_serial,
            "set": self._set_lines,
            "timeout": self._set_limit,
            "put": self._put,
            "get": self._get,
            "arm": self._arm,
            "fire": self._fire,
            "await": self._fire,
            "off": self._off,
        }
        self._out = bytearray()
        self._polarity = self._serial = 0
        self._boots = -1  # as an erased memory counts
        self._unplugged = False
        self._reset_after: int | None = None
        self._edges: list[Edge] = []
        self._boot(POWER_UP)

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
        """What the box said."""
        self._check_plugged()
        if not self._out:
            threading.Event().wait(IDLE_S)
        came, self._out = self._out[:size], self._out[size:]
        return bytes(came)

    def write(self, data: bytes, /) -> int:
        """What is said to the box."""
        self._check_plugged()
        for byte in data:
            self._take(byte)
        return len(data)

    def reset_input_buffer(self) -> None:
        """Forget what the box said."""
        self._out.clear()

    def close(self) -> None:
        """Nothing is open."""

    def played(self, polarity: int) -> list[Edge]:
        """What the outputs did; see :class:`~labseq_ttl.counterpart.Counterpart`."""
        del polarity  # it is known here
        return self._edges

    def reset(self, after_ticks: int | None = None) -> None:
        """Press the reset button, now or so long after the first edge of the next program."""
        self._reset_after = after_ticks
        if after_ticks is None:
            self._boot(RESET_INPUT)

    def unplug(self) -> None:
        """Pull the cable."""
        self._unplugged = True

    def say(self, data: bytes) -> None:
        """Say something that nobody asked for."""
        self._out += data

    def _check_plugged(self) -> None:
        if self._unplugged:
            raise OSError(5, "Input/output error")

    def _boot(self, cause: int) -> None:
        self._cause, self._boots = cause, (self._boots + 1) & 0xFFFF
        self._line = bytearray()
        self._slots: list[list[Edge]] = [[] for _ in range(SLOTS)]
        self._armed: int | None = None
        self._runs = self.on = 0
        self._tell(f"!boot {self._boots:04x} {cause:02x}")

    def _take(self, byte: int) -> None:
        if byte == STOP[0]:
            self._off([])
            self._line.clear()
            self._tell(f"!off {self._boots:04x}")
        elif byte == ord("\n"):
            if self._line:
                self._answer()
            self._line.clear()
        elif byte != ord("\r") and len(self._line) <= LINE:
            self._line.append(byte)

    def _answer(self) -> None:
        said = unframed(bytes(self._line)) if len(self._line) <= LINE else None
        if said is None or said[1:2] != " ":
            self._tell("? no damaged")
            return
        name, *words = said[2:].split(" ")
        news = self._runs
        try:
            if name not in self._commands:
                raise RefusedError("unknown")
            answer = f"{said[0]} ok {self._commands[name](words)}".rstrip()
        except RefusedError as refusal:
            answer = f"{said[0]} no {refusal}"
        self._tell(answer)
        if self._runs != news:
            self._tell(f"!done {self._boots:04x} {self._runs:04x}")
        elif name in ("fire", "await") and " ok" in answer:  # reset in the middle
            self._boot(RESET_INPUT)

    def _tell(self, text: str) -> None:
        self._out += framed(text)

    def _identify(self, words: list[str]) -> str:
        del words
        return f"{NAME} {VERSION:02x} {self._serial:04x} {self._boots:04x} {self._cause:02x}"

    def _state(self, words: list[str]) -> str:
        del words
        doing = "idle" if self._armed is None else "armed"
        return f"{doing} {self._boots:04x} {self._runs:04x} {self.on:04x} {self._polarity:04x}"

    def _set_polarity(self, words: list[str]) -> str:
        (self._polarity,) = _numbers(words, OUTPUTS)
        return ""

    def _set_serial(self, words: list[str]) -> str:
        (self._serial,) = _numbers(words, 0xFFFF)
        return ""

    def _set_lines(self, words: list[str]) -> str:
        (self.on,) = _numbers(words, OUTPUTS)
        return ""

    def _set_limit(self, words: list[str]) -> str:
        _numbers(words, 0xFFFF)  # no time passes here
        return ""

    def _put(self, words: list[str]) -> str:
        slot, first = _numbers(words[:2], SLOTS - 1, EDGES - 1)
        edges = self._slots[slot]
        if first > len(edges):
            raise RefusedError("gap")
        if self._armed == slot:
            self._armed = None
        del edges[first:]
        rest = words[2:]
        while True:
            ticks, mask = _numbers(rest[:2], LONGEST, OUTPUTS)
            if len(edges) == EDGES:
                raise RefusedError("full")
            if ticks < SHORTEST if edges else ticks != 0:
                raise RefusedError("short")
            edges.append((ticks, mask))
            rest = rest[2:]
            if not rest:
                return f"{len(edges):02x}"

    def _get(self, words: list[str]) -> str:
        slot, i = _numbers(words, SLOTS - 1, EDGES - 1)
        if i >= len(self._slots[slot]):
            raise RefusedError("gap")
        ticks, mask = self._slots[slot][i]
        return f"{ticks:08x} {mask:04x}"

    def _arm(self, words: list[str]) -> str:
        slot, n_edges = _numbers(words, SLOTS - 1, EDGES)
        if not n_edges or n_edges != len(self._slots[slot]):
            raise RefusedError("gap")
        self._armed = slot
        return f"{self._boots:04x}"

    def _fire(self, words: list[str]) -> str:
        if words:
            raise RefusedError("arguments")
        if self._armed is None:
            raise RefusedError("unarmed")
        edges, self._armed = self._slots[self._armed], None
        until, self._reset_after = self._reset_after, None
        self._edges, tick = [], 0
        for ticks, mask in edges:
            tick += ticks
            if until is not None and tick >= until:
                self._edges.append((until, 0))
                return ""
            self._edges.append((tick, mask))
            self.on = mask
        self._runs = (self._runs + 1) & 0xFFFF
        return ""

    def _off(self, words: list[str]) -> str:
        del words
        self._armed, self.on = None, 0
        return ""


def _numbers(words: list[str], *most: int) -> list[int]:
    """Hexadecimal numbers, each at most so large; of a mask every bit must be an output."""
    if len(words) != len(most):
        raise RefusedError("arguments")
    numbers: list[int] = []
    for word, limit in zip(words, most, strict=True):
        if not 1 <= len(word) <= 8 or not set(word) <= set("0123456789abcdefABCDEF"):
            raise RefusedError("arguments")
        number = int(word, 16)
        if number > limit or (limit == OUTPUTS and number & ~OUTPUTS):
            raise RefusedError("arguments")
        numbers.append(number)
    return numbers
