"""Connections to an external control system, including a serial line and a simulated connection."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal, TypeAlias

from labseq.plugin import Context, DeviceError
from labseq.plugin.leader import GO, LeaderSettings, load_until_go
from labseq.plugin.serial import BROKEN, Port, open_port
from labseq_follow.answers import Asked
from labseq_follow.protocol import encoded
from labseq_follow.settings import SerialLeaderSettings

SLICE_S: Final = 0.02
"""Longest wait for bytes, in seconds, after which a deadline and the end are noticed."""
SEND_S: Final = 5.0
"""Longest time to send a line on a serial port. 5,000 bytes take 0.45 s at 115,200 bits per second."""
REOPEN_S: Final = 0.5
"""Time between two attempts to open a port that was unplugged."""

Event: TypeAlias = (
    tuple[Literal["connected"], str, Asked]
    | tuple[Literal["came"], bytes]
    | tuple[Literal["lost"], str]
    | tuple[Literal["note"], str]
)
"""A peer and its options, received bytes, the reason of a lost connection, or a note for the log."""


class Link:
    """A connection on which one control system at a time may come and go.

    Attributes:
        address: Address where the control system finds labseq.
        listens: Whether ``poll`` must be called to notice events.
        token_file: The file with the token that a control system must know. None if it needs no token.
    """

    address = ""
    listens = True
    token_file: Path | None = None

    def open(self) -> None:
        """Prepare for a control system to connect."""

    def now(self) -> float:
        """The time for deadlines, in seconds."""
        return time.monotonic()

    def arrange_go(self, timeout_s: float) -> bytes:
        """Called when a step begins to wait for `go`. Returns bytes that come as a consequence.

        Raises:
            DeviceTimeoutError: `go` will not come in time.
        """
        del timeout_s
        return b""

    def arrange_reply(self, reply: str, timeout_s: float) -> bytes:
        """Called when labseq has asked for a reply. Returns bytes that come as a consequence."""
        del reply, timeout_s
        return b""

    def poll(self) -> list[Event]:
        """Wait for at most :data:`SLICE_S`, and return the events."""
        return []

    def expect(self, answer: bytes) -> None:
        """Set the line that answers the next `go`. "" means that it is not accepted."""

    def send(self, line: bytes) -> None:
        """Send a line, from any thread."""

    def finish(self) -> bytes:
        """Stop receiving, and return the bytes that ``poll`` has not returned yet."""
        return b""

    def close(self) -> None:
        """Close the connection. ``poll`` is no longer called."""


class SimulatedLink(Link):
    """A simulated control system, which loads atoms and sends `go` on the session's clock."""

    address = "simulated"
    listens = False

    def __init__(self, settings: LeaderSettings, context: Context) -> None:
        self._delay_s = settings.simulated_go_delay
        self._context = context
        self._n_sent = 0

    def now(self) -> float:
        """The session's time."""
        return self._context.clock.now()

    def arrange_go(self, timeout_s: float) -> bytes:
        """Load atoms, and send `go`."""
        load_until_go(self._context, self._delay_s, timeout_s)
        self._n_sent += 1
        return encoded(f"{GO} {self._n_sent}")

    def arrange_reply(self, reply: str, timeout_s: float) -> bytes:
        """Take the time of a step, then report that it is done. The light is on at once."""
        if reply == "done":
            self._context.clock.sleep(min(self._delay_s, timeout_s))
        return encoded(reply)


class SerialLink(Link):
    """A serial port that is opened exclusively, and reopened after it was unplugged."""

    def __init__(self, settings: SerialLeaderSettings, device: str) -> None:
        self.address = settings.port
        self._baud_rate = settings.baud_rate
        self._device = device
        self._port: Port | None = None
        self._is_reported = False
        self._reopen_s = 0.0
        self._sending = threading.Lock()

    def open(self) -> None:
        """Open the port. Fails if it does not exist or another program has opened it."""
        self._port = open_port(self.address, self._device, self._baud_rate, write_timeout=SEND_S)

    def poll(self) -> list[Event]:
        """Receive bytes, or reopen a port that was unplugged."""
        if self._port is None:
            self._reopen()
            return []
        events: list[Event] = []
        if not self._is_reported:
            self._is_reported = True
            events.append(("connected", f"the control system on {self.address}", Asked()))
        try:
            data = self._port.read(max(1, self._port.in_waiting))
        except (*BROKEN, TypeError) as error:  # pyserial reads None from a port that was closed
            self._drop()
            return [*events, ("lost", f"{' '.join(str(error).split())}; unplugged?")]
        return [*events, ("came", data)] if data else events

    def send(self, line: bytes) -> None:
        """Send a line."""
        with self._sending:
            if self._port is None:
                raise ConnectionError(f"{self.address} is not open")
            try:
                self._port.write(line)
            except BROKEN as error:
                raise ConnectionError(str(error)) from error

    def close(self) -> None:
        """Close the port."""
        self._drop()

    def _reopen(self) -> None:
        threading.Event().wait(SLICE_S)
        if time.monotonic() >= self._reopen_s:
            self._reopen_s = time.monotonic() + REOPEN_S
            with suppress(DeviceError):
                self.open()

    def _drop(self) -> None:
        with self._sending:
            port, self._port, self._is_reported = self._port, None, False
        if port is not None:
            with suppress(*BROKEN):
                port.close()
