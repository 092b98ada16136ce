"""The serial port of the box."""

from __future__ import annotations

import errno
import importlib
from typing import Any, Final, Protocol

from labseq import DeviceError

BAUD_RATE: Final = 500_000
SLICE_S: Final = 0.02
"""Longest single wait for something to come, in seconds."""

WRITE_TIMEOUT_S: Final = 1.0


class Port(Protocol):
    """What the driver uses of a port: a part of pyserial's ``Serial``."""

    @property
    def in_waiting(self) -> int:
        """Bytes that have come and were not read."""
        ...

    def read(self, size: int = 1, /) -> bytes:
        """What has come, at most ``size`` bytes; waits a little for the first."""
        ...

    def write(self, data: bytes, /) -> int | None:
        """Send."""
        ...

    def close(self) -> None:
        """Close."""
        ...


def _broken() -> tuple[type[BaseException], ...]:
    try:
        termios: Any = importlib.import_module("termios")
    except ImportError:  # Windows
        return (OSError,)
    return (OSError, termios.error)


BROKEN: Final = _broken()
"""What a port raises when the line is gone; pyserial's own errors are OSErrors."""


def open_port(name: str, device: str) -> Port:
    """Open a port, alone.

    Args:
        name: As the profile has it.
        device: Name of the box, for messages.

    Raises:
        DeviceError: There is no such port, or somebody else has it open.
    """
    serial: Any = importlib.import_module("serial")
    try:
        return serial.Serial(name, BAUD_RATE, timeout=SLICE_S, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
    except (*BROKEN, ValueError) as error:
        raise DeviceError(device, f"cannot open {name}: {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    """Why a port cannot be opened, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY) or "PermissionError(13" in str(error):
        return "another program has it open; close that"
    if number == errno.EACCES:
        return "you may not; ask for membership of the group that it belongs to (often 'dialout')"
    if number == errno.ENOENT or "FileNotFoundError" in str(error):
        return "there is no such port; is the box plugged in? expected one such as /dev/ttyACM0 or COM3"
    return " ".join(str(error).split())
