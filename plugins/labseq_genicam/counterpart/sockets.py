"""An address of its own for each simulated camera.

Aravis' simulated camera binds port 3956 of a network interface's first address, so that one
machine could have one at a time. On Linux the whole of 127.0.0.0/8 is loopback, so its
sockets are exchanged for ones at another address as soon as it runs, and 127.0.0.1 is free
again for the next.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import sys
from collections.abc import Iterator
from typing import Final

from labseq_genicam.counterpart.cable import Cable

FIRST_ADDRESS: Final = "127.0.0.1"
PORT: Final = 3956
"""Port of the control channel (GVCP), fixed by GigE Vision."""

_HIGHEST_FD: Final = 64  # of a process that has just started


def has_port() -> bool:
    """Whether the camera that has just been made in this process got its control channel."""
    return any(port == PORT and host == FIRST_ADDRESS for _, (host, port) in _udp_sockets())


def move(address: str) -> Cable | None:
    """Move the camera that has just been made in this process to another address.

    Args:
        address: Where to; any on loopback.

    Returns:
        The cable that its frames take from now on. None if it stays: where the system knows no
        other addresses on loopback, or where another camera has this address.
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
    """Addresses on loopback that no other process with its own number would choose."""
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
