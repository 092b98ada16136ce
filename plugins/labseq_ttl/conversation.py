"""Lines to the box and back: checksums, tags, repetitions, and what it says unasked."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Final, TypeVar

from labseq.plugin import (
    BROKEN,
    Clock,
    DeviceError,
    DeviceTimeoutError,
    Port,
    clean,
    format_quantity,
    wait_for,
)
from labseq_ttl.protocol import STOP, framed, unframed

T = TypeVar("T")

TRIES: Final = 3
"""How often a command is sent before the box counts as mute."""

MAX_BYTES: Final = 4096
SHOWN_BYTES: Final = 60
_TAGS: Final = "0123456789abcdef"
_REFUSED: Final = "? no damaged"
_GARBLED: Final = "?"


class Conversation:
    """One question after the other.

    Every line carries a tag, which the answer repeats, so that late answers are not
    taken for others. A line that came damaged is sent again, on either side.

    Args:
        port: The port, open.
        device: Name of the box, for messages.
        clock: The session's clock.
        max_wait_s: How long an answer may take, in seconds.
    """

    def __init__(self, port: Port, device: str, clock: Clock, max_wait_s: float) -> None:
        self.lock = threading.RLock()
        self._port = port
        self._device = device
        self._clock = clock
        self._patience_s = max_wait_s
        self._given_up = False
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
            max_wait_s: How long an answer may take, in seconds; None: as always.
            tries: How often it is sent.

        Returns:
            The words behind "ok".

        Raises:
            DeviceTimeoutError: No answer.
            DeviceError: The box refuses, or the line is broken.
            StopRequested: The operator asked the run to stop.
        """
        max_wait_s = self._patience_s if max_wait_s is None else max_wait_s
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
        raise DeviceTimeoutError(self._device, self._mute(question, max_wait_s), max_wait_s)

    def new_events(self, timeout_s: float = 0.0) -> list[str] | None:
        """Wait for what the box says unasked: its words; None if nothing came.

        Raises:
            DeviceError: The line is broken.
            StopRequested: The operator asked the run to stop.
        """
        return self._wait(lambda: self._news.popleft() if self._news else None, timeout_s)

    def drop_messages(self) -> None:
        """Drop what the box said unasked until now."""
        with self.lock:
            self._pump(wait=False)
            self._news.clear()

    def stop(self) -> None:
        """Turn all lines off, whatever the box is doing, and end every wait of other threads.

        Raises:
            DeviceError: The box does not confirm it.
        """
        self._given_up = True
        try:
            self.send(STOP)
            with self.lock:
                self._given_up = False
                self.ask("off", tries=1)
        finally:
            self._given_up = False

    def close(self) -> None:
        """Close the port; legal in any state."""
        with suppress(*BROKEN):
            self._port.close()

    def send(self, data: bytes) -> None:
        """Send bytes as they are.

        Raises:
            DeviceError: The line is broken.
        """
        with self._unbroken():
            self._port.write(data)

    def _wait(self, look: Callable[[], T | None], timeout_s: float) -> T | None:
        def poll(slice_s: float) -> T | None:
            with self.lock:
                found = look()
                if found is None:
                    self._pump(wait=slice_s > 0)
                    found = look()
            if found is None and self._given_up:
                raise DeviceError(self._device, "given up for the safe state")
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
        """Read what has come, and sort it; perhaps wait a little if nothing has."""
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
                if said.startswith("!boot"):  # it has forgotten what it was asked
                    self._answers.append(_GARBLED)
            else:
                self._answers.append(said)

    def _mute(self, question: str, max_wait_s: float) -> str:
        waited = format_quantity(max_wait_s, "time")
        noise = self._noise or bytes(self._came)
        if not noise:
            what = f"no answer to '{question}' within {waited}"
            return f"{what}; is this the box's port, and does the box have labseq's firmware?"
        shown = clean(noise[:SHOWN_BYTES].decode("ascii", "backslashreplace"))
        what = f"no answer to '{question}' within {waited} but '{shown}'"
        return f"{what}; expected a line that ends in its checksum; is this the box's port?"

    @contextmanager
    def _unbroken(self) -> Generator[None]:
        """Put what a port raises in words."""
        try:
            yield
        except BROKEN as error:
            if isinstance(error, DeviceError):  # a timeout of ours is an OSError too
                raise
            reason = " ".join(str(error).split())
            raise DeviceError(self._device, f"the line to the box broke ({reason}); unplugged?") from error
