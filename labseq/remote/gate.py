"""The ports of a device server, which limit the connections and pass bytes on to the sockets of ZeroMQ.

ZeroMQ accepts any number of connections and cannot close a single one. A socket that stops listening drops
all its clients. So the sockets of ZeroMQ are only reached through these ports.
"""

from __future__ import annotations

import selectors
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Final

from labseq.errors import ConfigError, Problem
from labseq.wire import HANDSHAKE_S, parse_address
from labseq.wire.messages import MAX_MESSAGE

_SIZE: Final = 1 << 18
"""Bytes that are passed on at a time."""
MAX_UNANSWERED: Final = MAX_MESSAGE + (1 << 20)
"""Bytes that a client may send before it gets an answer. All clients together may send four times as many.

ZeroMQ holds a message of any number of parts until the last part has come.
"""
UNREAD_S: Final = 10.0
"""Longest time that bytes for a client may wait until it reads, in seconds."""
_BEFORE_KEY: Final = 64 + 170 + 12
"""Bytes that ZeroMQ sends to a client whose key it does not know: greeting, WELCOME, ERROR (ZMTP 3.1, CURVE).
READY, for a known client, is longer than ERROR."""
_BEFORE_READY: Final = 64
"""The same without keys, which is the greeting."""


@dataclass(eq=False, slots=True)
class _Side:
    """One of the two sockets of a connection, and the bytes still to be written to it.

    Attributes:
        socket: The socket.
        waiting: The bytes.
        took_s: Time when the socket last took bytes.
    """

    socket: socket.socket
    waiting: memoryview = field(default_factory=lambda: memoryview(b""))
    took_s: float = 0.0


@dataclass(eq=False, slots=True)
class _Connection:
    """A client, and the socket of ZeroMQ to which it is connected.

    Attributes:
        client: The client's side.
        server: ZeroMQ's side.
        address: The client's address.
        until_s: Deadline for showing its key, or without keys for speaking ZeroMQ. 0 once it has.
        n_sent: Number of bytes that ZeroMQ has sent to the client.
        n_unanswered: Number of bytes received from the client since ZeroMQ last sent some.
    """

    client: _Side
    server: _Side
    address: str
    until_s: float
    n_sent: int = 0
    n_unanswered: int = 0


class Gate:
    """Listens on the ports of a server.

    Attributes:
        addresses: Addresses where the sockets of ZeroMQ have to listen, one for each port.
        failure: The error that ended its thread, or None.

    Args:
        host: Address to listen on.
        port: The first port.
        n_ports: Number of ports, one after the other.
        has_keys: Whether clients need keys.
        report: Receives lines of text for the operator.

    Raises:
        ConfigError: A port cannot be used.
    """

    def __init__(
        self, host: str, port: int, n_ports: int, has_keys: bool, report: Callable[[str], object]
    ) -> None:
        import zmq

        self.failure: BaseException | None = None
        self._before_key = _BEFORE_KEY if has_keys else _BEFORE_READY
        self._report = report
        self._n_refused = 0
        self._limit = _connection_limit()
        self._open: list[_Connection] = []
        self._selector = selectors.DefaultSelector()
        self._ending, self._ended = threading.Event(), threading.Event()
        self._buffer = memoryview(bytearray(_SIZE))
        self._folder = tempfile.TemporaryDirectory(prefix="labseq-")  # for this user only
        has_ipc = zmq.has("ipc") and hasattr(socket, "AF_UNIX")
        self.addresses = [
            f"ipc://{self._folder.name}/{number}" if has_ipc else "tcp://127.0.0.1:*"
            for number in range(n_ports)
        ]
        self._targets: dict[socket.socket, str] = {}
        self._thread = threading.Thread(target=self._serve, name="labseq ports", daemon=True)
        self._listening: list[socket.socket] = []
        try:
            for number in range(n_ports):
                self._listening.append(_listen(host, port + number))
        except ConfigError:
            self.end()
            raise

    def start(self, addresses: Sequence[str]) -> None:
        """Start its thread.

        Args:
            addresses: Addresses where the sockets of ZeroMQ now listen.
        """
        self._targets = dict(zip(self._listening, addresses, strict=True))
        for listening in self._listening:
            self._selector.register(listening, selectors.EVENT_READ)
        self._thread.start()

    def accept_no_more(self) -> None:
        """Stop listening. Connections stay."""
        self._ending.set()

    def end(self) -> None:
        """End all connections, and its thread."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(1.0)
        for listening in self._listening:
            listening.close()
        self._selector.close()
        with suppress(OSError):  # a socket of ZeroMQ may still be there
            self._folder.cleanup()

    def _serve(self) -> None:
        try:
            while not self._ended.is_set():
                for key, ready in self._selector.select(0.03):
                    if key.data is None:
                        self._accept(key.fileobj)
                    else:
                        self._pass(key.data, key.fileobj, ready)
                self._close_late()
                if self._ending.is_set():
                    self._stop_listening()
        except BaseException as error:  # noqa: BLE001 - the main thread ends the server
            self.failure = error
        finally:
            for connection in [*self._open]:
                self._close(connection)

    def _stop_listening(self) -> None:
        while self._listening:
            listening = self._listening.pop()
            self._selector.unregister(listening)
            listening.close()

    def _accept(self, listening: Any) -> None:
        try:
            client, (address, *_) = listening.accept()
        except OSError:  # the client has left, or no more files can be opened
            return
        if len(self._open) >= self._limit:
            self._refuse(address, f"there are already {self._limit} connections")
            client.close()
            return
        try:
            server = _connect(self._targets[listening])
        except OSError:  # no more files can be opened, or the server ends
            client.close()
            return
        connection = _Connection(_Side(client), _Side(server), address, time.monotonic() + HANDSHAKE_S)
        for side in (client, server):
            side.setblocking(False)
            self._selector.register(side, selectors.EVENT_READ, connection)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._open.append(connection)
        self._limit_newcomers()

    def _limit_newcomers(self) -> None:
        """If there are too many newcomers, close the oldest one of the address that has the most."""
        newcomers = [connection for connection in self._open if connection.until_s]
        if len(newcomers) <= self._limit // 3:
            return
        ((address, _),) = Counter(connection.address for connection in newcomers).most_common(1)
        oldest = next(connection for connection in newcomers if connection.address == address)
        self._refuse(address, "too many connections from there have shown no key")
        self._close(oldest)

    def _close_late(self) -> None:
        now_s = time.monotonic()
        for connection in [c for c in self._open if 0.0 < c.until_s < now_s]:
            self._refuse(connection.address, f"it has shown no key within {HANDSHAKE_S:g} s")
            self._close(connection)
        for connection in [c for c in self._open if c.client.waiting and c.client.took_s < now_s - UNREAD_S]:
            self._refuse(connection.address, f"it has not read for {UNREAD_S:g} s")
            self._close(connection)

    def _refuse(self, address: str, why: str) -> None:
        """Report a connection that is closed, but do not let a flood of them fill the log."""
        self._n_refused += 1
        if self._n_refused & (self._n_refused - 1) == 0:
            so_far = f" ({self._n_refused} connections refused so far)" if self._n_refused > 1 else ""
            self._report(f"a connection from {address} was closed: {why}{so_far}")

    def _pass(self, connection: _Connection, ready_socket: Any, ready: int) -> None:
        """Pass bytes on from the ready socket to the other one, or write the bytes that wait for it."""
        if connection not in self._open:
            return  # it was closed a moment ago
        side, other = connection.client, connection.server
        if ready_socket is not side.socket:
            side, other = other, side
        try:
            if ready & selectors.EVENT_WRITE:
                side.waiting = side.waiting[side.socket.send(side.waiting) :]
                side.took_s = time.monotonic()
            elif not other.waiting:
                self._receive(connection, side, other)
            self._watch(connection)
        except BlockingIOError:
            pass
        except OSError:
            self._close(connection)

    def _receive(self, connection: _Connection, side: _Side, other: _Side) -> None:
        """Pass on the received bytes."""
        n = side.socket.recv_into(self._buffer)
        if n == 0:
            raise ConnectionResetError
        if side is connection.server:
            connection.n_sent, connection.n_unanswered = connection.n_sent + n, 0
            if connection.n_sent > self._before_key:
                connection.until_s = 0.0
        else:
            connection.n_unanswered += n
            self._limit_unanswered(connection)
        n_sent = 0
        with suppress(BlockingIOError):
            n_sent = other.socket.send(self._buffer[:n])
        other.waiting, other.took_s = memoryview(bytes(self._buffer[n_sent:n])), time.monotonic()

    def _limit_unanswered(self, connection: _Connection) -> None:
        """Close a connection that sends too much, or if all together do, the connection that sent most."""
        in_all = sum(peer.n_unanswered for peer in self._open)
        if connection.n_unanswered <= MAX_UNANSWERED and in_all <= 4 * MAX_UNANSWERED:
            return
        most = max(self._open, key=attrgetter("n_unanswered"))
        self._refuse(most.address, f"it sent {most.n_unanswered >> 20} MiB without waiting for an answer")
        if most is connection:
            raise ConnectionAbortedError
        self._close(most)

    def _watch(self, connection: _Connection) -> None:
        """Read from a socket only while the other one takes the bytes, so that nothing piles up."""
        for side, other in (
            (connection.client, connection.server),
            (connection.server, connection.client),
        ):
            events = selectors.EVENT_WRITE if side.waiting else 0
            events |= 0 if other.waiting else selectors.EVENT_READ
            key = self._selector.get_map().get(side.socket)
            if (key.events if key is not None else 0) == events:
                continue
            if key is not None:
                self._selector.unregister(side.socket)
            if events:
                self._selector.register(side.socket, events, connection)

    def _close(self, connection: _Connection) -> None:
        self._open.remove(connection)
        for side in (connection.client, connection.server):
            with suppress(KeyError):  # not registered while it waits for the other one
                self._selector.unregister(side.socket)
            side.socket.close()


def _connection_limit() -> int:
    """The maximum number of connections, so that drivers can still open files.

    A connection is three files on POSIX (two sockets here and one of ZeroMQ). They get half of all files.
    """
    if sys.platform == "win32":
        return 128
    import resource

    n_files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= n_files < 1024:  # 256 on a Mac. select(), which drivers use, cannot watch more than 1024
        n_files = 1024 if most == resource.RLIM_INFINITY else min(1024, most)
        resource.setrlimit(resource.RLIMIT_NOFILE, (n_files, most))
    return min(n_files, 1024) // 6 if n_files > 0 else 170


def _listen(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    host = {"localhost": "127.0.0.1", "*": "0.0.0.0"}.get(host, host)  # noqa: S104 - the user asks for it
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        both = host == "::" and socket.has_dualstack_ipv6()
        listening = socket.create_server((host, port), family=family, backlog=128, dualstack_ipv6=both)
    except (OSError, OverflowError) as error:
        hint = "choose another port with --bind, or check whether the server is already running"
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(Problem(f"{host}:{port} cannot be used: {reason}", hint=hint)) from error
    listening.setblocking(False)
    return listening


def _connect(address: str) -> socket.socket:
    """A connection to a socket of ZeroMQ."""
    if not address.startswith("ipc://"):
        return socket.create_connection(parse_address(address))
    target = socket.socket(socket.AF_UNIX)
    try:
        target.connect(address.removeprefix("ipc://"))
    except OSError:
        target.close()
        raise
    return target
