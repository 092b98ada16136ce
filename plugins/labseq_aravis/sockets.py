"""Buffers of UDP sockets, in which the packets of a frame wait until they are read."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

FRAMES_IN_SOCKET: Final = 4
MIN_BUFFER: Final = 2**20
"""Size of a stream's buffer, in frames, and its minimum size, in bytes."""

_OPEN_FILES: Final = Path("/dev/fd")


def buffer_size(payload: int) -> int:
    """Bytes that a stream requests for frames of ``payload`` bytes.

    Linux counts each packet with its overhead, at up to twice its size for packets of 1500 bytes and more. In
    return it reserves twice the bytes that are requested.
    """
    return max(FRAMES_IN_SOCKET * payload, MIN_BUFFER)


def granted(n_bytes: int) -> int:
    """Bytes that a socket gets when it requests ``n_bytes``, under Linux at most ``net.core.rmem_max``.

    A socket is asked, since containers do not show that number. Limits of other systems are not known here.
    """
    if sys.platform != "linux":
        return n_bytes
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, n_bytes)
        return trial.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def set_buffer_size(port: int, n_bytes: int) -> None:
    """Request a buffer for the UDP sockets of this process that are bound to a port.

    Without effect under Windows, which does not list the sockets of a process.
    """
    for twin, _, (_, bound_to) in udp_sockets():
        if bound_to == port:
            with contextlib.suppress(OSError):  # macOS refuses more than its limit
                twin.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, n_bytes)


def udp_sockets() -> Iterator[tuple[socket.socket, int, tuple[str, int]]]:
    """The IPv4 UDP sockets of this process, each as duplicate, file descriptor, and address with port."""
    descriptors = [int(path.name) for path in _OPEN_FILES.iterdir()] if _OPEN_FILES.is_dir() else []
    for descriptor in descriptors:
        with contextlib.suppress(OSError):  # another thread has closed it
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                continue
            with socket.socket(fileno=os.dup(descriptor)) as twin:
                if twin.family == socket.AF_INET and twin.type == socket.SOCK_DGRAM:
                    yield twin, descriptor, twin.getsockname()
