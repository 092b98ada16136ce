"""The connection to an external control system over TCP, and the token that it must know."""

from __future__ import annotations

import hmac
import os
import re
import secrets
import selectors
import socket
import stat
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from labseq.plugin import DeviceError, format_quantity
from labseq.plugin.messages import clean
from labseq.plugin.system import state_root
from labseq_follow.answers import SHORT_LINE, Asked, asked_for
from labseq_follow.links import SLICE_S, Event, Link
from labseq_follow.protocol import encoded
from labseq_follow.relay import Relay, can_relay
from labseq_follow.settings import TcpLeaderSettings

TAKEN: Final = encoded("error another leader is connected; one at a time")
NO_TOKEN: Final = encoded("error the first line must be 'hello' and the token")
FIRST_LINE_S: Final = 2.0
"""Longest time from a connection to the end of its first line, in seconds."""
BACKLOG: Final = 128
"""Connections that the system keeps until they are accepted."""
MAX_NEWCOMERS: Final = 16
"""Maximum number of connections that wait for their first line. Beyond it, the oldest is closed."""
TOKEN: Final = re.compile(rb"[A-Za-z0-9_-]{16,100}")
KEEPALIVE: Final = (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3))
"""A control system whose computer lost power is noticed after 11 s, so that another can connect."""


class TcpLink(Link):
    """Listens on a port. The first control system that sends `hello` and the token leads until it leaves."""

    def __init__(self, settings: TcpLeaderSettings, device: str) -> None:
        self._host, self._port = settings.host, settings.port
        self.token_file = _token_file()
        self._token = b""
        self._device = device
        self.address = f"{settings.host}:{settings.port}"
        self._server: socket.socket | None = None
        self._leader: socket.socket | None = None
        self._relay: Relay | None = None
        self._newcomers: dict[socket.socket, _Newcomer] = {}
        self._n_refused = 0
        self._selector: selectors.BaseSelector | None = None
        self._sending = threading.Lock()

    def open(self) -> None:
        """Listen. Fails if the port is taken, or the host is not an address of this computer."""
        host, port = self._host, self._port
        self._token = _read_token(self.token_file, self._device)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._server = socket.create_server((host, port), family=family, backlog=BACKLOG)
        except OSError as error:
            text = f"cannot listen on {host} port {port}: {error.strerror or error}"
            hint = "close another labseq or other program that uses it, or set another 'port'"
            raise DeviceError(self._device, f"{text}; {hint}") from error
        self._server.setblocking(False)
        self.address = f"{host}:{self._server.getsockname()[1]}"
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._relay = Relay() if can_relay() else None

    def poll(self) -> list[Event]:
        """Accept connections, receive from them, and notice if the control system left."""
        assert self._selector is not None
        events: list[Event] = []
        for key, _ in self._selector.select(SLICE_S):
            peer: Any = key.fileobj
            if peer is self._server:
                for _ in range(BACKLOG):
                    events += self._accept()
            elif peer is self._received_from():
                events += self._receive()
            elif peer in self._newcomers:
                events += self._receive_first_line(peer)
        return events + self._refuse_late_newcomers()

    def expect(self, answer: bytes) -> None:
        """Let the separate process, if there is one, answer the next `go`."""
        with self._sending:
            if self._relay is not None and self._leader is not None:
                self._relay.expect(answer)

    def send(self, line: bytes) -> None:
        """Send a line. A control system that does not take it is disconnected at once."""
        with self._sending:
            if self._leader is None:
                raise ConnectionError("no leader is connected")
            try:
                n_sent = self._leader.send(line)
            except BlockingIOError:
                n_sent = 0
            if n_sent < len(line):
                with suppress(OSError):
                    self._leader.shutdown(socket.SHUT_RDWR)  # nothing may follow half a line
                raise ConnectionError("it does not read, so its connection was closed")

    def finish(self) -> bytes:
        """Stop receiving. The separate process may have answered a `go` that was not read yet."""
        return b"" if self._relay is None or self._leader is None else self._relay.finish()

    def close(self) -> None:
        """Disconnect, and stop listening."""
        self._drop()
        if self._relay is not None:
            self._relay.close()
            self._relay = None
        for peer in [*self._newcomers]:
            self._forget(peer)
        if self._selector is not None:
            self._selector.close()
        if self._server is not None:
            self._server.close()
        self._server = self._selector = None

    def _accept(self) -> list[Event]:
        assert self._server is not None
        assert self._selector is not None
        try:
            peer, who = self._server.accept()
        except OSError:  # it left before it was accepted
            return []
        peer.setblocking(False)
        self._selector.register(peer, selectors.EVENT_READ)
        self._newcomers[peer] = _Newcomer(f"{who[0]}:{who[1]}", time.monotonic())
        if len(self._newcomers) > MAX_NEWCOMERS:
            return self._refuse(next(iter(self._newcomers)), "too many connections are waiting")
        return []

    def _refuse_late_newcomers(self) -> list[Event]:
        late_s, events = time.monotonic() - FIRST_LINE_S, list[Event]()
        for peer in [peer for peer, newcomer in self._newcomers.items() if newcomer.since_s < late_s]:
            events += self._refuse(peer, f"it sent no line within {format_quantity(FIRST_LINE_S, 'time')}")
        return events

    def _receive_first_line(self, peer: socket.socket) -> list[Event]:
        newcomer = self._newcomers[peer]
        try:
            data = peer.recv(SHORT_LINE + 1)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        newcomer.came += data
        line, ended, rest = newcomer.came.partition(b"\n")
        if data and not ended and len(line) <= SHORT_LINE:
            return []
        begin = b"hello " + self._token
        words = line.strip()[len(begin) :]
        if not hmac.compare_digest(line.strip()[: len(begin)], begin) or words.strip() == words != b"":
            return self._refuse(peer, f"its first line is {clean(repr(line)[1:])}", NO_TOKEN)
        try:
            asked = asked_for(words.decode("ascii", "backslashreplace"))
        except ValueError as error:
            return self._refuse(peer, str(error), encoded(f"error {error}"))
        if self._leader is not None:
            return self._refuse(peer, "another control system leads", TAKEN)
        return self._welcome(peer, asked, rest)

    def _welcome(self, peer: socket.socket, asked: Asked, rest: bytes) -> list[Event]:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE:
            if (number := getattr(socket, option, None)) is not None:
                peer.setsockopt(socket.IPPROTO_TCP, number, value)
        who = self._newcomers.pop(peer).who
        with self._sending:  # its process must receive the socket first, not an expected answer
            if self._relay is not None and self._selector is not None:
                self._selector.unregister(peer)
                self._relay.serve(peer)
                self._selector.register(self._relay.received, selectors.EVENT_READ)
            self._leader = peer
        return [("connected", who, asked), *([("came", rest)] if rest else [])]

    def _refuse(self, peer: socket.socket, why: str, answer: bytes = b"") -> list[Event]:
        """Close the connection of a newcomer, but do not let a flood of them fill the log."""
        who = self._newcomers[peer].who
        with suppress(OSError):
            peer.send(answer)
            peer.shutdown(socket.SHUT_WR)
            peer.recv(4096)  # because of unread data its side could drop our line
        self._forget(peer)
        self._n_refused += 1
        if self._n_refused & (self._n_refused - 1):
            return []
        so_far = f" ({self._n_refused} connections refused so far)" if self._n_refused > 1 else ""
        return [("note", f"{who} was refused: {why}{so_far}")]

    def _forget(self, peer: socket.socket) -> None:
        del self._newcomers[peer]
        if self._selector is not None:
            self._selector.unregister(peer)
        peer.close()

    def _received_from(self) -> socket.socket | None:
        """The socket with the bytes of the control system. None while none is connected."""
        return self._relay.received if self._relay is not None and self._leader is not None else self._leader

    def _receive(self) -> list[Event]:
        received = self._received_from()
        assert received is not None
        try:
            data, reason = received.recv(4096), "it closed the connection"
        except BlockingIOError:
            return []
        except OSError as error:
            data, reason = b"", str(error.strerror or error)
        if data:
            return [("came", data)]
        self._drop()
        return [("lost", reason)]

    def _drop(self) -> None:
        with self._sending:
            received = self._received_from()
            if self._leader is None or received is None:
                return
            if self._selector is not None:
                self._selector.unregister(received)
            self._leader.close()
            self._leader = None
            if self._relay is not None:
                self._relay.close()
                self._relay = Relay()  # for the next control system


@dataclass(slots=True)
class _Newcomer:
    """A connection that has not sent its first line yet."""

    who: str
    since_s: float
    came: bytes = b""


def _token_file() -> Path | None:
    state = state_root()
    return None if state is None else state / "leader.token"


def _make_token(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)  # private from the start
    with os.fdopen(descriptor, "wb") as file:
        file.write(secrets.token_hex(16).encode() + b"\n")


def _read_token(path: Path | None, device: str) -> bytes:
    """Read the token in a file, which is made if it does not exist.

    Raises:
        DeviceError: The file cannot be read, others can read it, or it contains no token.
    """
    if path is None:
        raise DeviceError(device, "this user has no folder for the token; set LABSEQ_STATE to one")
    try:
        if not path.exists():
            _make_token(path)
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # reading a pipe could block for ever
            raise OSError("it is not an ordinary file")
        with path.open("rb") as file:
            token = file.read(SHORT_LINE).strip()
    except OSError as error:
        text = f"the token in {path} cannot be read: {error.strerror or error}"
        raise DeviceError(device, f"{text}; write 16 to 100 letters or digits to it") from error
    if os.name == "posix" and mode & 0o077:
        raise DeviceError(device, f"other users can read the token in {path}; run 'chmod 600 {path}'")
    if not TOKEN.fullmatch(token):
        raise DeviceError(device, f"{path} has no token; expected 16 to 100 letters or digits on one line")
    return token
