"""The connections to an external control system: TCP, a serial line, and a simulated one."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from contextlib import suppress
from typing import Final, Literal, TypeAlias

from labseq.plugin import (
    BROKEN,
    Context,
    DeviceError,
    DeviceTimeoutError,
    Port,
    Simulation,
    format_quantity,
    open_port,
)
from labseq_follow.protocol import GO, encoded
from labseq_follow.settings import LeaderSettings, SerialLeaderSettings, TcpLeaderSettings

SLICE_S: Final = 0.02
"""Longest wait for something to come: how soon a deadline and the end are noticed."""
SEND_S: Final = 0.5
"""Longest time to send a line; a control system that reads nothing counts as gone."""
REOPEN_S: Final = 0.5
"""Time between two attempts to open a port that was unplugged."""
TAKEN: Final = encoded("error another leader is connected; one at a time")
KEEPALIVE: Final = (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3))
"""A control system whose computer lost power is noticed after 11 s, so that another can connect."""

Event: TypeAlias = (
    tuple[Literal["connected"], str]
    | tuple[Literal["came"], bytes]
    | tuple[Literal["lost"], str]
    | tuple[Literal["note"], str]
)
"""Who connected; bytes that came; why the connection was lost; a note for the log."""


class Link:
    """A connection on which one control system at a time may come and go.

    Attributes:
        address: Where it finds labseq.
        listens: Whether ``poll`` must be called to notice what happens.
    """

    address = ""
    listens = True

    def open(self) -> None:
        """Prepare for a control system to connect."""

    def now(self) -> float:
        """The time for deadlines, in seconds."""
        return time.monotonic()

    def arrange_go(self, timeout_s: float) -> bytes:
        """Called when a step begins to wait for `go`; returns bytes that come as a consequence.

        Raises:
            DeviceTimeoutError: `go` will not come in time.
        """
        del timeout_s
        return b""

    def poll(self) -> list[Event]:
        """Wait for at most :data:`SLICE_S`; returns what happened."""
        return []

    def send(self, line: bytes) -> None:
        """Send a line; from any thread."""

    def close(self) -> None:
        """Close the connection; ``poll`` is not called any more."""


class SimulatedLink(Link):
    """A simulated control system: it loads atoms and sends `go`, on the session's clock."""

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
        if self._delay_s > timeout_s:
            self._context.clock.sleep(timeout_s)
            text = f"the simulated leader says '{GO}' after {format_quantity(self._delay_s, 'time')}"
            raise DeviceTimeoutError(self._context.name, f"{text}; see 'simulated_go_delay'", timeout_s)
        load_atoms(self._context, self._delay_s)
        self._n_sent += 1
        return encoded(f"{GO} {self._n_sent}")


def load_atoms(context: Context, duration_s: float) -> None:
    """Load the simulated lab as the control system would have, unless this shot has atoms already."""
    start_s = context.clock.now()
    context.clock.sleep(duration_s)
    simulation: Simulation | None = context.simulation
    if simulation is not None and ((truth := simulation.truth()) is None or not truth.any()):
        simulation.load(start_s, duration_s)


class TcpLink(Link):
    """Listens on a port; the first control system that connects stays until it leaves."""

    def __init__(self, settings: TcpLeaderSettings, device: str) -> None:
        self._host, self._port = settings.host, settings.port
        self._device = device
        self.address = f"{settings.host}:{settings.port}"
        self._server: socket.socket | None = None
        self._leader: socket.socket | None = None
        self._selector: selectors.BaseSelector | None = None
        self._sending = threading.Lock()

    def open(self) -> None:
        """Listen; the port may be taken, or the host not an address of this computer."""
        host, port = self._host, self._port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._server = socket.create_server((host, port), family=family, backlog=4)
        except OSError as error:
            text = f"cannot listen on {host} port {port}: {error.strerror or error}"
            hint = "close another labseq or other program that uses it, or set another 'port'"
            raise DeviceError(self._device, f"{text}; {hint}") from error
        self._server.setblocking(False)
        self.address = f"{host}:{self._server.getsockname()[1]}"
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)

    def poll(self) -> list[Event]:
        """Accept a control system, receive from it, notice that it left."""
        assert self._selector is not None
        events: list[Event] = []
        for key, _ in self._selector.select(SLICE_S):
            events += self._accept() if key.fileobj is self._server else self._receive()
        return events

    def send(self, line: bytes) -> None:
        """Send a line; a control system that does not take it is disconnected."""
        with self._sending:
            if self._leader is None:
                raise ConnectionError("no leader is connected")
            try:
                self._leader.sendall(line)
            except OSError:
                with suppress(OSError):
                    self._leader.shutdown(socket.SHUT_RDWR)  # after half a line nothing more may follow
                raise

    def close(self) -> None:
        """Disconnect, and stop listening."""
        self._drop()
        if self._selector is not None:
            self._selector.close()
        if self._server is not None:
            self._server.close()
        self._server = self._selector = None

    def _accept(self) -> list[Event]:
        assert self._server is not None
        assert self._selector is not None
        try:
            leader, who = self._server.accept()
        except OSError:  # it left before it was accepted
            return []
        leader.settimeout(SEND_S)
        if self._leader is not None:
            _turn_away(leader)
            return [("note", f"{who[0]}:{who[1]} connected while another one is in control, and was refused")]
        leader.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        leader.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE:
            if (number := getattr(socket, option, None)) is not None:
                leader.setsockopt(socket.IPPROTO_TCP, number, value)
        self._leader = leader
        self._selector.register(leader, selectors.EVENT_READ)
        return [("connected", f"{who[0]}:{who[1]}")]

    def _receive(self) -> list[Event]:
        if self._leader is None:
            return []
        try:
            data, reason = self._leader.recv(4096), "it closed the connection"
        except TimeoutError:
            return []
        except OSError as error:
            data, reason = b"", str(error.strerror or error)
        if data:
            return [("came", data)]
        self._drop()
        return [("lost", reason)]

    def _drop(self) -> None:
        with self._sending:
            if self._leader is not None:
                if self._selector is not None:
                    self._selector.unregister(self._leader)
                self._leader.close()
            self._leader = None


def _turn_away(leader: socket.socket) -> None:
    """Send the reason; read what it sent, or its side may drop our line unread."""
    with leader, suppress(OSError):
        leader.sendall(TAKEN)
        leader.shutdown(socket.SHUT_WR)
        leader.settimeout(SLICE_S)
        leader.recv(4096)


class SerialLink(Link):
    """A serial port that is opened exclusively, and opened again if it was unplugged."""

    def __init__(self, settings: SerialLeaderSettings, device: str) -> None:
        self.address = settings.port
        self._baud_rate = settings.baud_rate
        self._device = device
        self._port: Port | None = None
        self._is_reported = False
        self._reopen_s = 0.0
        self._sending = threading.Lock()

    def open(self) -> None:
        """Open the port; there may be none, or another program may have it open."""
        self._port = open_port(self.address, self._device, self._baud_rate, write_timeout=SEND_S)

    def poll(self) -> list[Event]:
        """Receive; open a port that was unplugged."""
        if self._port is None:
            self._reopen()
            return []
        events: list[Event] = []
        if not self._is_reported:
            self._is_reported = True
            events.append(("connected", f"the control system on {self.address}"))
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
