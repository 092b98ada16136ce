"""The commands of the box."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError, Port, clean
from labseq_ttl.conversation import TRIES, Conversation
from labseq_ttl.protocol import NAME, PER_LINE, VERSION, Edge

BOOT_S: Final = 3.0
"""How long a box may take to its first answer: an Arduino is reset when its port is opened."""

BOOT_TRY_S: Final = 0.5

CAUSES: Final = {1: "power-up", 2: "reset input", 4: "supply voltage too low", 8: "watchdog"}
"""Bits of the processor's register MCUSR."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What the box says of itself.

    Attributes:
        serial_number: As it was given to it.
        boots: How often it has started in its life, modulo 65536.
        cause: Why it started last, in words.
    """

    serial_number: int
    boots: int
    cause: str


@dataclass(frozen=True, slots=True)
class BoxState:
    """What the box is doing.

    Attributes:
        boots: How often it has started.
        runs: Programs played to their end since then, modulo 65536.
        on: What is on: bit n is channel n.
        polarity: Outputs that are low when they are on.
    """

    boots: int
    runs: int
    on: int
    polarity: int


class Box:
    """A timing box on an open port.

    Args:
        port: The port.
        device: Name of the box, for messages.
        clock: The session's clock.
        max_wait_s: How long an answer may take, in seconds.

    Attributes:
        line: The conversation with it.
    """

    def __init__(self, port: Port, device: str, clock: Clock, max_wait_s: float) -> None:
        self.line = Conversation(port, device, clock, max_wait_s)
        self._device = device
        self._patience_s = max_wait_s

    def identify(self) -> Identity:
        """Wait until the box answers, and see that it is one.

        Raises:
            DeviceTimeoutError: Nothing answers.
            DeviceError: It is something else, or its firmware speaks another language.
        """
        words = self._first_answer()
        if len(words) < 2 or words[0] != NAME:
            text = f"'{clean(' '.join(words))}' answers; expected '{NAME}'; is this the right port?"
            raise DeviceError(self._device, text)
        (version,) = self._numbers(words[1:2], 1)
        if version != VERSION:
            text = f"the box's firmware speaks version {version} of the protocol; expected {VERSION}"
            raise DeviceError(self._device, f"{text}; flash it again, see docs/how-to/timing-box.md")
        serial_number, boots, cause = self._numbers(words[2:], 3)
        return Identity(serial_number, boots, cause_text(cause))

    def state(self, tries: int = TRIES) -> BoxState:
        """What it is doing; no answer while a program runs."""
        return BoxState(*self._numbers(self.line.ask("state", tries=tries)[1:], 4))

    def set_polarity(self, mask: int) -> None:
        """Keep for good which outputs are low when they are on."""
        self.line.ask(f"polarity {mask:x}")

    def set_serial_number(self, number: int) -> None:
        """Keep a serial number for good."""
        self.line.ask(f"serial {number:x}")

    def set_watchdog_timeout(self, timeout_s: float) -> None:
        """Turn all lines off if nothing is heard for so long; 0: never."""
        self.line.ask(f"timeout {round(timeout_s * 1e3):x}")

    def set_lines(self, mask: int) -> None:
        """Turn lines on and off at once."""
        self.line.ask(f"set {mask:x}")

    def put(self, slot: int, edges: Sequence[Edge]) -> None:
        """Write a program."""
        for first in range(0, len(edges), PER_LINE):
            words = [f"{ticks:x} {mask:x}" for ticks, mask in edges[first : first + PER_LINE]]
            self.line.ask(f"put {slot:x} {first:x} {' '.join(words)}")

    def get(self, slot: int, i: int) -> Edge:
        """Read an edge of a program back."""
        ticks, mask = self._numbers(self.line.ask(f"get {slot:x} {i:x}"), 2)
        return ticks, mask

    def arm(self, slot: int, n_edges: int) -> int:
        """Get a program ready.

        Returns:
            How often the box has started.
        """
        (boots,) = self._numbers(self.line.ask(f"arm {slot:x} {n_edges:x}"), 1)
        return boots

    def fire(self, *, external: bool = False) -> None:
        """Play it now, or at the next edge of the start input; never sent twice."""
        self.line.ask("await" if external else "fire", again=False)

    def ask_numbers(self, question: str, n: int) -> list[int]:
        """Ask for so many numbers."""
        return self._numbers(self.line.ask(question), n)

    def _first_answer(self) -> list[str]:
        deadline_s = time.monotonic() + max(BOOT_S, self._patience_s)
        try_s = max(BOOT_TRY_S, self._patience_s / 2)
        while True:
            self.line.send(b"\n")  # ends what others may have left unfinished
            try:
                return self.line.ask("id", max_wait_s=try_s, tries=1)
            except DeviceTimeoutError:
                if time.monotonic() > deadline_s:
                    raise

    def _numbers(self, words: Sequence[str], n: int) -> list[int]:
        try:
            numbers = [int(word, 16) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != n:
            text = f"the box answers '{clean(' '.join(words))}'; expected {n} hexadecimal numbers"
            raise DeviceError(self._device, f"{text}; does it have labseq's firmware?")
        return numbers


def cause_text(bits: int) -> str:
    """Why the box started.

    Example:
        >>> cause_text(8), cause_text(0)
        ('watchdog', 'unknown')
    """
    return ", ".join(text for bit, text in CAUSES.items() if bits & bit) or "unknown"
