"""The way of a frame's packets out of the simulated camera.

The library sends a whole frame at once. Linux gives a socket 212992 bytes by default
(``net.core.rmem_default``) and counts each packet with its overhead; the library asks for more
only when it reads the first packet of a stream. Half of the frames of 512 x 512 pixels were
lost. So packets wait here until the receiver has room, as the pause frames of Ethernet make
them wait.
"""

from __future__ import annotations

import select
import socket
import threading
import time
from pathlib import Path
from typing import Final

BURST: Final = 64 * 1024
"""Bytes that are sent before the receiver's room is looked at; twice as many always find room."""

OVERHEAD: Final = 768
"""Bytes that Linux counts for a packet beyond its own."""

BREAK_S: Final = 2e-4
"""How long to wait before it is looked at again, in seconds."""

MAX_BREAKS: Final = 1000
"""After so many, packets are sent all the same, and no longer wait: a packet socket takes them elsewhere."""

SOCKETS: Final = Path("/proc/net/udp")
"""Linux's table of UDP sockets."""

LARGEST_PACKET: Final = 65536

AIM: Final = b"\xff\xffto "
"""Begins what is no packet but the address that the next ones go to; no packet has this status."""


class Cable(threading.Thread):
    """Sends the packets on; on Linux only.

    Args:
        out: A UDP socket at the camera's address; this object owns it.

    Attributes:
        end: The socket that the camera sends into, wherever it believes to send.
        address: The camera's address.
    """

    def __init__(self, out: socket.socket) -> None:
        super().__init__(name="cable", daemon=True)
        self.end, self._own = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.end.setblocking(False)  # as GLib has them; it waits by itself
        out.setblocking(True)
        self._out = out
        self.address: str = out.getsockname()[0]
        self._aimed_at = self._destination = "", 0
        self._is_read = True

    def aim(self, host: str, port: int) -> None:
        """Send the packets of later frames there; those of earlier ones go where they were meant to."""
        if (host, port) != self._aimed_at:
            self._aimed_at = host, port
            select.select([], [self.end], [])
            self.end.send(AIM + f"{host}:{port}".encode())

    def run(self) -> None:
        """Send on what comes, until this process ends."""
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
    """Bytes that wait to be read at a UDP port of this machine; 0 if nobody has it."""
    for line in SOCKETS.read_text().splitlines()[1:]:
        _, local, _, _, queues, *_ = line.split()
        if local.endswith(f":{port:04X}"):
            return int(queues.partition(":")[2], 16)
    return 0
