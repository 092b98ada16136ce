"""Addresses and packets of simulated cameras on loopback.

Aravis' simulated camera uses port 3956 of a network interface's first address, so that a machine could have
one camera at a time. On Linux the whole of 127.0.0.0/8 is loopback, so the camera's sockets are replaced by
sockets at another address as soon as it runs, and 127.0.0.1 is free again for the next camera.

The library sends a whole frame at once. A :class:`Cable` forwards the packets as fast as it can, so that a
receiver whose socket has only the default buffer (``net.core.rmem_default``, 208 KiB) loses packets, as with
other cameras. Packets wait in the cable while there are more than a well configured socket holds, as with the
pause frames of Ethernet. That is four frames, or the kernel's limit (``net.core.rmem_max``).
"""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from labseq_aravis.sockets import buffer_size, granted, udp_sockets

FIRST_ADDRESS: Final = "127.0.0.1"
PORT: Final = 3956
"""Port of the control channel (GVCP), fixed by GigE Vision."""


def has_port() -> bool:
    """Whether the camera that was just started in this process got its control channel."""
    return any(port == PORT and host == FIRST_ADDRESS for _, _, (host, port) in udp_sockets())


def move(address: str) -> Cable | None:
    """Move the camera that was just started in this process to another address.

    Returns:
        The cable that transmits its frames from now on. None if the camera stays because the system has no
        other addresses on loopback, or another camera has this address.
    """
    if sys.platform != "linux":
        return None
    made = [(fd, port) for _, fd, (host, port) in udp_sockets() if host == FIRST_ADDRESS]
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


OVERHEAD: Final = 768
"""Bytes that Linux counts for a packet in addition to its own."""

BREAK_S: Final = 2e-4
"""How long to wait before the next check, in seconds."""

MAX_BREAKS: Final = 1000
"""After this many checks packets are sent anyway, because a packet socket receives them elsewhere."""

SOCKETS: Final = Path("/proc/net/udp")
"""Linux's table of UDP sockets."""

LARGEST_PACKET: Final = 65536

AIM: Final = b"\xff\xffto "
"""Prefix of a message with the destination of the following packets and the room there. No packet has this
status."""


class Cable(threading.Thread):
    """Forwards the packets of frames, on Linux only.

    Args:
        out: A UDP socket at the camera's address, which this object owns.

    Attributes:
        end: The socket that the camera sends to instead of the destination.
        address: The camera's address.
    """

    def __init__(self, out: socket.socket) -> None:
        super().__init__(name="cable", daemon=True)
        self.end, self._own = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.end.setblocking(False)  # as GLib expects, which waits by itself
        out.setblocking(True)
        self._out = out
        self.address: str = out.getsockname()[0]
        self._aimed_at = self._destination = "", 0
        self._room = 0
        self._is_read = True

    def aim(self, host: str, port: int, payload: int) -> None:
        """Set the destination of later frames, of ``payload`` bytes. Packets in the cable keep theirs."""
        if (host, port) != self._aimed_at:
            self._aimed_at = host, port
            room = granted(buffer_size(payload))
            select.select([], [self.end], [])
            self.end.send(AIM + f"{host}:{port}:{room}".encode())

    def run(self) -> None:
        """Forward packets until this process ends."""
        left = 0
        while packet := self._own.recv(LARGEST_PACKET):
            if packet.startswith(AIM):
                host, port, room = packet.removeprefix(AIM).decode().split(":")
                self._destination, self._is_read, self._room = (host, int(port)), True, int(room)
                left = self._room
                continue
            if left <= 0 and self._is_read:
                left = self._wait_for_room()
            self._out.sendto(packet, self._destination)
            left -= len(packet) + OVERHEAD

    def _wait_for_room(self) -> int:
        """Wait until half of the receiver's room is free, and return the bytes that can be sent."""
        for _ in range(MAX_BREAKS):
            waiting = n_waiting(self._destination[1])
            if waiting <= self._room // 2:
                return self._room - waiting
            time.sleep(BREAK_S)
        self._is_read = False
        return 0


def n_waiting(port: int) -> int:
    """Bytes that wait to be read at a UDP port of this machine, 0 if no process uses it."""
    for line in SOCKETS.read_text().splitlines()[1:]:
        _, local, _, _, queues, *_ = line.split()
        if local.endswith(f":{port:04X}"):
            return int(queues.partition(":")[2], 16)
    return 0
