"""A leader that connects over TCP."""

from __future__ import annotations

import selectors
import socket
import threading
from contextlib import suppress
from typing import Final

from labseq.plugin import DeviceError
from labseq_follow.dialogue import encoded
from labseq_follow.links import SEND_S, SLICE_S, Listener
from labseq_follow.settings import TcpLeaderSettings

TAKEN: Final = encoded("error another leader is connected; one at a time")
KEEPALIVE: Final = (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3))
"""A leader whose computer lost power is noticed after 11 s, so that another can take its place."""


class TcpLink:
    """Listens on a port; the first who connects leads, until it leaves.

    Args:
        settings: Where to listen.
        device: Name of the device, for messages.
    """

    def __init__(self, settings: TcpLeaderSettings, device: str) -> None:
        self._settings = settings
        self._device = device
        self._address = f"{settings.host}:{settings.port}"
        self._server: socket.socket | None = None
        self._leader: socket.socket | None = None
        self._selector: selectors.BaseSelector | None = None
        self._sending = threading.Lock()

    @property
    def address(self) -> str:
        """Host and port."""
        return self._address

    def open(self) -> None:
        """Listen.

        Raises:
            DeviceError: The port is taken, or the host is none of this computer.
        """
        host, port = self._settings.host, self._settings.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._server = socket.create_server((host, port), family=family, backlog=4)
        except OSError as error:
            text = f"cannot listen on {host} port {port}: {error.strerror or error}"
            hint = "another labseq, or another program, may; close it or set another 'port'"
            raise DeviceError(self._device, f"{text}; {hint}") from error
        self._server.setblocking(False)
        self._address = f"{host}:{self._server.getsockname()[1]}"
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)

    def serve(self, listener: Listener) -> None:
        """Let a leader in, hear what it says, see it leave."""
        assert self._selector is not None
        for key, _ in self._selector.select(SLICE_S):
            if key.fileobj is self._server:
                self._accept(listener)
            else:
                self._receive(listener)

    def send(self, line: bytes) -> None:
        """Send a line; a leader that does not take it is let go."""
        with self._sending:
            if self._leader is None:
                raise ConnectionError("no leader is connected")
            try:
                self._leader.sendall(line)
            except OSError:
                with suppress(OSError):
                    self._leader.shutdown(socket.SHUT_RDWR)  # half a line may be out: it ends here
                raise

    def close(self) -> None:
        """Let the leader go and listen no more."""
        self._drop()
        if self._selector is not None:
            self._selector.close()
        if self._server is not None:
            self._server.close()
        self._server = self._selector = None

    def _accept(self, listener: Listener) -> None:
        assert self._server is not None
        assert self._selector is not None
        try:
            leader, who = self._server.accept()
        except OSError:  # it left before it was let in
            return
        leader.settimeout(SEND_S)
        if self._leader is not None:
            _turn_away(leader)
            listener.note(f"{who[0]}:{who[1]} wanted to lead beside another, and was turned away")
            return
        leader.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        leader.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE:
            if (number := getattr(socket, option, None)) is not None:
                leader.setsockopt(socket.IPPROTO_TCP, number, value)
        self._leader = leader
        self._selector.register(leader, selectors.EVENT_READ)
        listener.connected(f"{who[0]}:{who[1]}")

    def _receive(self, listener: Listener) -> None:
        assert self._leader is not None
        try:
            data, reason = self._leader.recv(4096), "it closed the connection"
        except TimeoutError:
            return
        except OSError as error:
            data, reason = b"", str(error.strerror or error)
        if data:
            listener.came(data)
        else:
            self._drop()
            listener.lost(reason)

    def _drop(self) -> None:
        with self._sending:
            if self._leader is not None:
                if self._selector is not None:
                    self._selector.unregister(self._leader)
                self._leader.close()
            self._leader = None


def _turn_away(leader: socket.socket) -> None:
    """Say why; what it has said is read, or its side may drop our line unread."""
    with leader, suppress(OSError):
        leader.sendall(TAKEN)
        leader.shutdown(socket.SHUT_WR)
        leader.settimeout(SLICE_S)
        leader.recv(4096)
