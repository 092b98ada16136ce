"""Ports of this computer, opened by pyserial."""

from __future__ import annotations

import errno
import importlib
import re
from typing import Any, Final, Protocol

from labseq.errors import DeviceError
from labseq_serial.settings import SerialSettings, UsbSettings

SLICE_S: Final = 0.02
"""Longest single wait for something to come, in seconds."""


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

    def reset_input_buffer(self) -> None:
        """Drop what has come."""
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


def open_port(settings: SerialSettings, device: str) -> Port:
    """Open the port of a profile, alone.

    Args:
        settings: The port and how to speak on it.
        device: Name of the instrument, for messages.

    Raises:
        DeviceError: There is no such port, or somebody else has it open.
    """
    serial: Any = importlib.import_module("serial")
    port = settings.port if settings.usb is None else _find(settings.usb, device)
    assert port is not None
    options: dict[str, Any] = {
        "baudrate": settings.baud_rate,
        "bytesize": settings.data_bits,
        "parity": settings.parity[0].upper(),
        "stopbits": settings.stop_bits,
        "rtscts": settings.flow_control == "rts_cts",
        "dsrdtr": settings.flow_control == "dsr_dtr",
        "xonxoff": settings.flow_control == "xon_xoff",
        "timeout": SLICE_S,
    }
    if "://" not in port:
        options |= {"exclusive": True, "write_timeout": settings.timeout}
    try:
        return serial.serial_for_url(port, **options)
    except (*BROKEN, ValueError, NotImplementedError) as error:
        raise DeviceError(device, f"cannot open {port}: {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    """Why a port cannot be opened, and what to do."""
    text = " ".join(str(error).split())
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY) or "PermissionError(13" in text:
        return "another program has it open, or another device of this profile; close that"
    if number == errno.EACCES:
        return "you may not; ask for membership of the group that it belongs to (often 'dialout')"
    if number == errno.ENOENT or "FileNotFoundError" in text:
        return f"there is no such port; expected {_known()}; is it plugged in, and switched on?"
    return re.sub(r"^(\[Errno \d+\] )?[Cc]ould not [^:]*: ", "", text)


def _find(usb: UsbSettings, device: str) -> str:
    """The port of an adapter."""
    wanted = {"vid": usb.vid, "pid": usb.pid, "serial_number": usb.serial}
    given = {key: value for key, value in wanted.items() if value is not None}
    fits = [
        port for port in _ports() if all(getattr(port, key, None) == value for key, value in given.items())
    ]
    if len(fits) == 1:
        return fits[0].device
    described = ", ".join(
        f"{key} {value:#06x}" if isinstance(value, int) else f"{key} {value}" for key, value in given.items()
    )
    if fits:
        names = ", ".join(f"{port.device} ({port.serial_number})" for port in fits)
        text = f"{len(fits)} adapters have {described}: {names}; add 'serial' to tell them apart"
        raise DeviceError(device, text)
    text = f"no USB adapter has {described}; expected {_known()}; is it plugged in?"
    raise DeviceError(device, text)


def _known() -> str:
    """The ports there are, in words."""
    found = [
        port.device
        if port.vid is None
        else f"{port.device} (usb {port.vid:#06x} {port.pid:#06x} {port.serial_number})"
        for port in _ports()
    ]
    return f"one of {', '.join(found)}" if found else "a port, but this computer has none"


def _ports() -> list[Any]:
    tools: Any = importlib.import_module("serial.tools.list_ports")
    return sorted(tools.comports())


def is_write_timeout(error: BaseException) -> bool:
    """Whether a write only took too long: the line is not broken."""
    serial: Any = importlib.import_module("serial")
    return isinstance(error, serial.SerialTimeoutException)
