"""The box at its serial port, with checksummed lines, its commands, and the errors that it reports."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Final, NamedTuple, TypeVar

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError, Emergency, format_quantity, wait_for
from labseq.plugin.messages import clean
from labseq.plugin.serial import BROKEN, Port, SerialMessage, open_port, serial_emergency
from labseq_ttl.protocol import NAME, PER_LINE, STOP, VERSION, Edge, framed, unframed

T = TypeVar("T")

BAUD_RATE: Final = 500_000
WRITE_TIMEOUT_S: Final = 1.0
TRIES: Final = 3
"""How often a command is sent before the box counts as silent."""

MAX_BYTES: Final = 4096
SHOWN_BYTES: Final = 60
_TAGS: Final = "0123456789abcdef"
_REFUSED: Final = "? no damaged"
_GARBLED: Final = "?"

BOOT_S: Final = 3.0
"""How long a box may take to its first answer. An Arduino is reset when its port is opened."""

BOOT_TRY_S: Final = 0.5

CAUSES: Final = {1: "power-up", 2: "reset input", 4: "supply voltage too low", 8: "watchdog"}
"""Bits of the processor's register MCUSR."""


def open_box(name: str, device: str) -> Port:
    """Open the serial port ``name`` exclusively. ``device`` is for messages."""
    return open_port(name, device, BAUD_RATE, write_timeout=WRITE_TIMEOUT_S)


class Conversation:
    """Commands to the box and its answers, one after the other.

    Every line carries a tag, which the answer repeats, so that a late answer is not taken for another
    command's. A damaged line is sent again, on either side. The box also sends messages without being asked,
    such as the end of a program.
    """

    def __init__(self, port: Port, device: str, clock: Clock, max_wait_s: float) -> None:
        self.lock = threading.RLock()
        self._port = port
        self._device = device
        self._clock = clock
        self._max_wait_s = max_wait_s
        self._n_stops = 0
        self._n_asked = 0
        self._came = bytearray()
        self._noise = b""
        self._answers: deque[str] = deque(maxlen=len(_TAGS))
        self._news: deque[list[str]] = deque(maxlen=64)

    def ask(
        self, question: str, *, again: bool = True, max_wait_s: float | None = None, tries: int = TRIES
    ) -> list[str]:
        """Send a command and wait for the answer.

        Args:
            question: The command and its arguments.
            again: Whether it may be sent again if no answer comes.
            max_wait_s: How long an answer may take, in seconds, None for the usual time.
            tries: How often it is sent at most.

        Returns:
            The words after "ok".
        """
        max_wait_s = self._max_wait_s if max_wait_s is None else max_wait_s
        with self.lock:
            self._n_asked += 1
            tag = _TAGS[self._n_asked % len(_TAGS)]
            self._answers.clear()
            for _ in range(tries):
                self.send(framed(f"{tag} {question}"))
                answer = self._wait(lambda: self._answer(tag, again), max_wait_s)
                if answer is None and not again:
                    break
                if answer in (None, _REFUSED, _GARBLED):
                    continue
                word, *rest = answer.split()[1:]
                if word == "ok":
                    return rest
                raise DeviceError(
                    self._device, f"the box refuses '{question}': {' '.join(rest)}; see its PROTOCOL.md"
                )
        raise DeviceTimeoutError(self._device, self._silence_text(question, max_wait_s), max_wait_s)

    def new_events(self, timeout_s: float = 0.0) -> list[str] | None:
        """Wait for a message of the box that is not an answer. Returns its words, or None if none came."""
        return self._wait(lambda: self._news.popleft() if self._news else None, timeout_s)

    def drop_messages(self) -> None:
        """Drop the messages that came until now."""
        with self.lock:
            self._pump(wait=False)
            self._news.clear()

    def stop(self) -> None:
        """Turn all lines off, whatever the box is doing, and end the waits of other threads."""
        self._n_stops += 1
        self.send(STOP)
        with self.lock:
            # until the box has confirmed it, it drops everything
            self._wait(lambda: ["off"] in [event[:1] for event in self._news] or None, self._max_wait_s)
            self.ask("off", tries=1)

    def emergency(self) -> Emergency | None:
        """The byte by which another process turns all lines off, None without a real port."""
        return serial_emergency(self._port, [SerialMessage(STOP.decode(), "!", BOOT_S)])

    def close(self) -> None:
        """Close the port. Legal in any state."""
        with suppress(*BROKEN):
            self._port.close()

    def send(self, data: bytes) -> None:
        """Send bytes as they are."""
        with self._unbroken():
            self._port.write(data)

    def _wait(self, look: Callable[[], T | None], timeout_s: float) -> T | None:
        n_stops = self._n_stops

        def unless_stopped() -> T | None:
            if self._n_stops != n_stops:  # the message of the stop is not for this wait either
                raise DeviceError(self._device, "aborted by the safe state")
            return look()

        def poll(slice_s: float) -> T | None:
            with self.lock:
                found = unless_stopped()
                if found is None:
                    self._pump(wait=slice_s > 0)
                    found = unless_stopped()
                return found

        return wait_for(poll, timeout_s, self._clock)

    def _answer(self, tag: str, again: bool) -> str | None:
        while self._answers:
            answer = self._answers.popleft()
            if answer == _REFUSED or (again and answer == _GARBLED):
                return answer
            if answer[:2] == f"{tag} " and len(answer.split()) > 1:
                return answer
        return None

    def _pump(self, *, wait: bool) -> None:
        """Read and sort the lines that came. With ``wait``, wait a little if nothing came."""
        with self._unbroken():
            n_bytes = self._port.in_waiting
            came = self._port.read(min(max(1, n_bytes), MAX_BYTES)) if n_bytes or wait else b""
        *lines, rest = (bytes(self._came) + came).split(b"\n")
        self._came = bytearray(rest[-MAX_BYTES:])
        for line in lines:
            said = unframed(line.removesuffix(b"\r"))
            if said is None:
                self._noise = line
                self._answers.append(_GARBLED)
            elif said.startswith("!"):
                self._news.append(said[1:].split())
                if said.startswith("!boot"):  # it has lost the command
                    self._answers.append(_GARBLED)
            else:
                self._answers.append(said)

    def _silence_text(self, question: str, max_wait_s: float) -> str:
        waited = format_quantity(max_wait_s, "time")
        noise = self._noise or bytes(self._came)
        if not noise:
            what = f"no answer to '{question}' within {waited}"
            return f"{what}; is this the box's port, and does the box have labseq's firmware?"
        shown = clean(noise[:SHOWN_BYTES].decode("ascii", "backslashreplace"))
        what = f"no answer to '{question}' within {waited} but '{shown}'"
        return f"{what}, which is not a line with a checksum; is this the box's port?"

    @contextmanager
    def _unbroken(self) -> Generator[None]:
        """Turn errors of the port into errors of the device."""
        try:
            yield
        except BROKEN as error:
            if isinstance(error, DeviceError):  # a timeout of ours is an OSError too
                raise
            reason = " ".join(str(error).split())
            raise DeviceError(self._device, f"the line to the box broke ({reason}); unplugged?") from error


class Identity(NamedTuple):
    """The box's report about itself."""

    serial_number: int
    """The number that it was given."""
    boots: int
    """How often it has started in its life, modulo 65536."""
    cause: str
    """Why it started last."""


class BoxState(NamedTuple):
    """The box's present state."""

    boots: int
    """How often it has started."""
    runs: int
    """Programs played to their end since then, modulo 65536."""
    on: int
    """Channels that are on, bit n for channel n."""
    polarity: int
    """Outputs that are low when they are on."""


class LeaderState(NamedTuple):
    """The box's state towards a leader."""

    state: int
    """``DEAF``, ``IDLE``, ``OWED`` or ``LATE``."""
    n_go_signals: int
    """Edges that were taken since the start."""
    more_came: int
    """Whether an edge was refused since the last answer."""
    level: int
    """Level of the start input."""


class Box(Conversation):
    """The commands of a timing box on an open port."""

    def identify(self) -> Identity:
        """Wait until the box answers, and check that it is one."""
        words = self._first_answer()
        if len(words) < 2 or words[0] != NAME:
            text = f"'{clean(' '.join(words))}' answers, not '{NAME}'; is this the right port?"
            raise DeviceError(self._device, text)
        (version,) = self._numbers(words[1:2], 1)
        if version != VERSION:
            text = f"the box's firmware has version {version} of the protocol, not {VERSION}"
            raise DeviceError(self._device, f"{text}; flash it again, see docs/how-to/timing-box.md")
        serial_number, boots, cause = self._numbers(words[2:], 3)
        return Identity(serial_number, boots, cause_text(cause))

    def state(self, tries: int = TRIES) -> BoxState:
        """Read its present state. It does not answer while a program runs."""
        return BoxState(*self._numbers(self.ask("state", tries=tries)[1:], 4))

    def put(self, slot: int, edges: Sequence[Edge]) -> None:
        """Write a program."""
        for first in range(0, len(edges), PER_LINE):
            words = [f"{ticks:x} {mask:x}" for ticks, mask in edges[first : first + PER_LINE]]
            self.ask(f"put {slot:x} {first:x} {' '.join(words)}")

    def get(self, slot: int, i: int) -> Edge:
        """Read an edge of a program back."""
        ticks, mask = self._numbers(self.ask(f"get {slot:x} {i:x}"), 2)
        return ticks, mask

    def arm(self, slot: int, n_edges: int) -> int:
        """Prepare a program.

        Returns:
            How often the box has started.
        """
        (boots,) = self._numbers(self.ask(f"arm {slot:x} {n_edges:x}"), 1)
        return boots

    def fire(self, *, external: bool = False) -> None:
        """Play the program now, or at the next edge of the start input. The command is never repeated."""
        self.ask("await" if external else "fire", again=False)

    def lead(self, masks: Sequence[int], deadline_s: float) -> bool:
        """Accept a leader's edges from now on.

        Args:
            masks: The outputs for busy, ready and failed, 0 for none.
            deadline_s: Longest time from an edge to its answer, 0 for any.

        Returns:
            Whether the start input is high.
        """
        words = " ".join(f"{mask:x}" for mask in (*masks, int(deadline_s * 1e3)))
        (level,) = self._numbers(self.ask(f"lead {words}"), 1)
        return bool(level)

    def answer_leader(self, *, is_ready: bool) -> tuple[int, bool]:
        """Raise `ready` or `failed`. Returns the state before, and whether an edge was refused meanwhile."""
        state, more_came = self._numbers(self.ask(f"answer {is_ready:d}"), 2)
        return state, bool(more_came)

    def leader(self) -> LeaderState:
        """Read its state towards a leader."""
        return LeaderState(*self._numbers(self.ask("leader"), 4))

    def set_lines(self, mask: int) -> None:
        """Turn lines on and off at once."""
        self.ask(f"set {mask:x}")

    def set_watchdog_timeout(self, timeout_s: float) -> None:
        """Turn all lines off if nothing is received for this long, 0 for never."""
        self.ask(f"timeout {round(timeout_s * 1e3):x}")

    def set_polarity(self, mask: int) -> None:
        """Store permanently which outputs are low when they are on."""
        self.ask(f"polarity {mask:x}")

    def set_serial_number(self, number: int) -> None:
        """Store a serial number permanently."""
        self.ask(f"serial {number:x}")

    def _first_answer(self) -> list[str]:
        deadline_s = time.monotonic() + max(BOOT_S, self._max_wait_s)
        try_s = max(BOOT_TRY_S, self._max_wait_s / 2)
        while True:
            self.send(b"\n")  # ends an unfinished line of another program
            try:
                return self.ask("id", max_wait_s=try_s, tries=1)
            except DeviceTimeoutError:
                if time.monotonic() > deadline_s:
                    raise

    def _numbers(self, words: Sequence[str], n: int) -> list[int]:
        try:
            numbers = [int(word, 16) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != n:
            text = f"the box answers '{clean(' '.join(words))}', not {n} hexadecimal numbers"
            raise DeviceError(self._device, f"{text}; does it have labseq's firmware?")
        return numbers


def cause_text(bits: int) -> str:
    """Why the box started.

    Example:
        >>> cause_text(8), cause_text(0)
        ('watchdog', 'unknown')
    """
    return ", ".join(text for bit, text in CAUSES.items() if bits & bit) or "unknown"


def late_error(device: str, timeout_s: float, *, is_external: bool = False) -> DeviceTimeoutError:
    """A program has not ended in time."""
    text = f"the lines' program is not over after {format_quantity(timeout_s, 'time')}"
    if is_external:
        text += "; did the edge at the start input come?"
    return DeviceTimeoutError(device, text, timeout_s)
