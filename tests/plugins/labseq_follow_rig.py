"""The other side of a line to labseq: a leader for tests."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from labseq_follow.leader import LeaderDevice, tcp_leader
from labseq_follow.settings import TcpLeaderSettings

from labseq.plugin import Context
from labseq.roles import NeverStopped

MAX_WAIT_S = 60.0
"""A test fails after this time; on a busy computer nothing takes as long."""


def token_file() -> Path:
    return Path(os.environ["LABSEQ_STATE"]) / "leader.token"


class TcpPeer:
    """A leader that connects over TCP.

    Args:
        address: Of labseq, "127.0.0.1:5750".
        token: What it sends after `hello`; "" to send nothing.
    """

    def __init__(self, address: str, token: str | None = None) -> None:
        host, _, port = address.rpartition(":")
        self.socket = socket.create_connection((host, int(port)), timeout=MAX_WAIT_S)
        self._lines = self.socket.makefile("rb")
        if token != "":
            self.say(f"hello {token or token_file().read_text().strip()}")

    def say(self, *lines: str) -> None:
        self.send("".join(f"{line}\n" for line in lines).encode())

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def hear(self) -> str:
        """The next line; "" if the connection was closed."""
        return self._lines.readline().decode().strip()

    def leave(self) -> None:
        self._lines.close()
        self.socket.close()

    def ask(self, line: str) -> str:
        self.say(line)
        return self.hear()


class PtyPeer:
    """A leader on the other end of a pseudo-terminal."""

    def __init__(self) -> None:
        self.fd, slave = os.openpty()
        self.port = os.ttyname(slave)
        os.close(slave)
        self._came = b""

    def say(self, *lines: str) -> None:
        os.write(self.fd, "".join(f"{line}\n" for line in lines).encode())

    def hear(self) -> str:
        end_s = time.monotonic() + MAX_WAIT_S
        while b"\n" not in self._came:
            assert select.select([self.fd], [], [], end_s - time.monotonic())[0], "labseq said nothing"
            try:
                self._came += os.read(self.fd, 4096)
            except OSError:  # the port is not open yet
                assert time.monotonic() < end_s
        line, _, self._came = self._came.partition(b"\n")
        return line.decode().strip()

    def ask(self, line: str) -> str:
        self.say(line)
        return self.hear()

    def leave(self) -> None:
        os.close(self.fd)


@contextmanager
def listening(context: Context | None = None, **settings: Any) -> Generator[LeaderDevice]:
    """A device that listens on a free port, in real time."""
    context = context or Context("leader", clock=NeverStopped())
    device = tcp_leader(TcpLeaderSettings(port=0, **settings), replace(context, name="leader"))
    device.open()
    try:
        yield device
    finally:
        device.close()


@contextmanager
def led(context: Context | None = None, **settings: Any) -> Generator[tuple[LeaderDevice, TcpPeer]]:
    """The same, and a leader that is connected."""
    with listening(context, **settings) as device:
        peer = TcpPeer(device.describe()["address"])
        assert peer.hear().startswith("hello labseq 3 deadline=")
        try:
            yield device, peer
        finally:
            peer.leave()
