"""Addresses and packets of simulated cameras on loopback.

Aravis' simulated camera uses port 3956 of a network interface's first address, so that a machine could have
one camera at a time. On Linux the whole of 127.0.0.0/8 is loopback, so the camera's sockets are replaced by
sockets at another address as soon as it runs, and 127.0.0.1 is free again for the next camera.

The library sends a whole frame at once. Linux gives a socket a buffer of 212992 bytes by default
(``net.core.rmem_default``) and counts each packet with its overhead; the library requests more only when it
reads the first packet of a stream. Half of the frames of 512 x 512 pixels were lost. So packets wait in a
:class:`Cable` until the receiver has room, as with the pause frames of Ethernet.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

FIRST_ADDRESS: Final = "127.0.0.1"
PORT: Final = 3956
"""Port of the control channel (GVCP), fixed by GigE Vision."""

_HIGHEST_FD: Final = 64  # of a process that has just started


def has_port() -> bool:
    """Whether the camera that was just started in this process got its control channel."""
    return any(port == PORT and host == FIRST_ADDRESS for _, (host, port) in _udp_sockets())


def move(address: str) -> Cable | None:
    """Move the camera that was just started in this process to another address.

    Returns:
        The cable that transmits its frames from now on. None if the camera stays: the system has no other
        addresses on loopback, or another camera has this address.
    """
    if sys.platform != "linux":
        return None
    made = [(fd, port) for fd, (host, port) in _udp_sockets() if host == FIRST_ADDRESS]
    try:
        control, out = _bound(address, PORT), _bound(address, 0)
    except OSError:
        return None
    cable = Cable(out)
    for fd, port in made:
        new = control if port == PORT else cable.end
        os.dup2(new.fileno(), fd, inheritable=False)
    control.close()
    cable.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as knock:  # its thread polls the old socket
        knock.sendto(b"", (FIRST_ADDRESS, PORT))
    return cable


def own_addresses() -> Iterator[str]:
    """Addresses on loopback that no other process would choose, since they contain its number."""
    for number in range(os.getpid(), 2**24 - 3, 2**22):
        yield ".".join(str(byte) for byte in ((127 << 24) + 2 + number).to_bytes(4, "big"))


def _bound(address: str, port: int) -> socket.socket:
    new = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    new.setblocking(False)  # as GLib has them
    try:
        new.bind((address, port))
    except OSError:
        new.close()
        raise
    return new


def _udp_sockets() -> Iterator[tuple[int, tuple[str, int]]]:
    """File descriptor, address and port of each UDP socket of this process."""
    for fd in range(3, _HIGHEST_FD):
        with contextlib.suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
            with socket.socket(fileno=os.dup(fd)) as twin:
                if twin.family == socket.AF_INET and twin.type == socket.SOCK_DGRAM:
                    host, port = twin.getsockname()
                    yield fd, (host, port)


BURST: Final = 64 * 1024
"""Bytes that are sent before the receiver's free space is checked; twice as many always fit."""

OVERHEAD: Final = 768
"""Bytes that Linux counts for a packet in addition to its own."""

BREAK_S: Final = 2e-4
"""How long to wait before the next check, in seconds."""

MAX_BREAKS: Final = 1000
"""After this many checks packets are sent anyway: a packet socket receives them elsewhere."""

SOCKETS: Final = Path("/proc/net/udp")
"""Linux's table of UDP sockets."""

LARGEST_PACKET: Final = 65536

AIM: Final = b"\xff\xffto "
"""Prefix of a message with the destination of the following packets; no packet has this status."""


class Cable(threading.Thread):
    """Forwards the packets of frames; on Linux only.

    Args:
        out: A UDP socket at the camera's address; this object owns it.

    Attributes:
        end: The socket that the camera sends to instead of the destination.
        address: The camera's address.
    """

    def __init__(self, out: socket.socket) -> None:
        super().__init__(name="cable", daemon=True)
        self.end, self._own = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.end.setblocking(False)  # as GLib expects; it waits by itself
        out.setblocking(True)
        self._out = out
        self.address: str = out.getsockname()[0]
        self._aimed_at = self._destination = "", 0
        self._is_read = True

    def aim(self, host: str, port: int) -> None:
        """Set the destination of later frames; packets already in the cable keep theirs."""
        if (host, port) != self._aimed_at:
            self._aimed_at = host, port
            select.select([], [self.end], [])
            self.end.send(AIM + f"{host}:{port}".encode())

    def run(self) -> None:
        """Forward packets until this process ends."""
        n_bytes = 0
        while packet := self._own.recv(LARGEST_PACKET):
            if packet.startswith(AIM):
                host, _, port = packet.removeprefix(AIM).decode().rpartition(":")
                self._destination, self._is_read = (host, int(port)), True
                continue
            self._out.sendto(packet, self._destination)
            n_bytes += len(packet) + OVERHEAD
            if n_bytes >= BURST and self._is_read:
                n_bytes = 0
                self._is_read = self._wait_for_room()

    def _wait_for_room(self) -> bool:
        for _ in range(MAX_BREAKS):
            if n_waiting(self._destination[1]) < BURST:
                return True
            time.sleep(BREAK_S)
        return False


def n_waiting(port: int) -> int:
    """Bytes that wait to be read at a UDP port of this machine; 0 if no process uses it."""
    for line in SOCKETS.read_text().splitlines()[1:]:
        _, local, _, _, queues, *_ = line.split()
        if local.endswith(f":{port:04X}"):
            return int(queues.partition(":")[2], 16)
    return 0
