"""Serial ports, and devices that are switched off over a serial port."""

from __future__ import annotations

import errno
import importlib
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Protocol
from urllib.parse import urlsplit

from labseq.drivers.waiting import SLICE_S
from labseq.errors import DeviceError
from labseq.roles import Emergency

__all__ = [
    "BROKEN",
    "Port",
    "SerialMessage",
    "is_network_port",
    "is_write_timeout",
    "open_port",
    "port_identities",
    "ports_here",
    "ports_text",
    "serial_emergency",
]


def port_identities(port: str) -> tuple[str, ...]:
    """The names of a serial port for its lock: its own name, and the target if it is a link.

    Example:
        >>> port_identities("socket://Box:4001")
        ('socket://box:4001',)
    """
    if "://" in port:
        return (port.lower(),)
    if os.name == "nt":
        return (port.upper(),)
    return tuple(dict.fromkeys((port, os.path.realpath(port))))


class Port(Protocol):
    """The part of pyserial's ``Serial`` that drivers use."""

    @property
    def in_waiting(self) -> int:
        """Number of received bytes that have not been read."""
        ...

    def read(self, size: int = 1, /) -> bytes:
        """The received bytes, at most ``size``. Waits a little for the first."""
        ...

    def write(self, data: bytes, /) -> int | None:
        """Send."""
        ...

    def reset_input_buffer(self) -> None:
        """Drop the received bytes."""
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
"""Errors of a port whose line is gone. Pyserial's own errors are OSErrors."""


def open_port(port: str, device: str, baud_rate: int, **options: Any) -> Port:
    """Open a port for exclusive use.

    Reads wait for the first byte for at most 20 ms, so that a driver sees a stop request.

    Args:
        port: "/dev/ttyUSB0", "COM3", or a URL that pyserial knows. A URL cannot be locked.
        device: Name of the instrument, for messages.
        baud_rate: Bits per second.
        **options: Further options of pyserial.

    Raises:
        DeviceError: There is no such port, or another program has it open.
    """
    serial: Any = importlib.import_module("serial")
    if port.startswith(("socket://", "rfc2217://")) and not is_network_port(port):
        expected = "socket://host:port or rfc2217://host:port, with a port from 1 to 65535"
        raise DeviceError(device, f"cannot open {port}: it is not a network port; expected {expected}")
    if "://" in port:
        options.pop("write_timeout", None)
    else:
        # two programs on a port would receive each other's replies
        options["exclusive"] = True
    try:
        return serial.serial_for_url(port, baudrate=baud_rate, timeout=SLICE_S, **options)
    except (*BROKEN, ValueError, NotImplementedError) as error:
        raise DeviceError(device, f"cannot open {port}: {_reason(error)}") from error


@dataclass(frozen=True, slots=True)
class SerialMessage:
    """A message that makes a device safe, or a question.

    Attributes:
        send: The text to send, with its end.
        until: The end of the reply. "" if none comes.
        within_s: Longest time for the reply, or the pause after a message without reply, in seconds.
        expect: Pattern of the reply, without its end and surrounding spaces.
        error: Pattern of a reply that reports an error. None if there is none.
        value: For a question, the required group ``value`` of the reply.
        choices: All possible values. Empty for any value.
        repeatable: Whether it may be sent again after a failure.
        unless: Questions. If all have the required answers, the message is not sent, so that a toggle does
            not turn an output on again. After it was sent, all must have them.
    """

    send: str
    until: str = ""
    within_s: float = 0.0
    expect: str = ".*"
    error: str | None = None
    value: str | int | None = None
    choices: tuple[str, ...] = ()
    repeatable: bool = True
    unless: tuple[SerialMessage, ...] = ()


def serial_emergency(
    port: Port, messages: Sequence[SerialMessage], encoding: str = "latin-1", *, echo: bool = False
) -> Emergency | None:
    """The emergency of a device on a serial line, for which another process opens the port.

    Args:
        port: The open port.
        messages: The messages to send.
        encoding: Encoding of the characters.
        echo: Whether the device repeats the messages.

    Returns:
        None if there is nothing to send, or no real port, as in a simulation.
    """
    name = getattr(port, "port", None)
    if not messages or not isinstance(name, str):
        return None
    serial: Any = port
    keys = ("baudrate", "bytesize", "parity", "stopbits", "rtscts", "dsrdtr", "xonxoff")
    options = {key: getattr(serial, key, None) for key in keys}
    set_options = {key: value for key, value in options.items() if value is not None}
    if "://" not in name:
        set_options["write_timeout"] = 1.0  # a device that takes no bytes must not block the process
    values = [asdict(message) for message in messages]
    arguments = {"port": name, "options": set_options, "messages": values, "encoding": encoding, "echo": echo}
    return Emergency(Path(__file__).with_name("serial_emergency.py"), arguments)


def is_network_port(url: str) -> bool:
    """Whether a URL names a host and a port, because pyserial's own message for others is misleading."""
    try:
        parts = urlsplit(url)
        return bool(parts.hostname) and bool(parts.port)
    except ValueError:
        return False


def is_write_timeout(error: BaseException) -> bool:
    """Whether a write only took too long, so that the line is not broken."""
    serial: Any = importlib.import_module("serial")
    return isinstance(error, serial.SerialTimeoutException)


def ports_here() -> list[Any]:
    """The ports of this computer, with pyserial's attributes device, vid, pid and serial_number."""
    tools: Any = importlib.import_module("serial.tools.list_ports")
    return sorted(tools.comports())


def ports_text() -> str:
    """The ports of this computer, for a message."""
    ports = [
        port.device
        if port.vid is None
        else f"{port.device} (usb {port.vid:#06x} {port.pid:#06x} {port.serial_number})"
        for port in ports_here()
    ]
    return f"one of {', '.join(ports)}" if ports else "a port, but this computer has none"


def _reason(error: BaseException) -> str:
    """Why a port cannot be opened, and what to do."""
    message = " ".join(str(error).split())
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY) or "PermissionError(13" in message:
        return "another program has it open, or another device of this profile; close that"
    if number == errno.EACCES:
        return "permission denied; ask to be added to the group that owns it (often 'dialout')"
    if number == errno.ENOENT or "FileNotFoundError" in message:
        return f"there is no such port (expected {ports_text()}); check that it is plugged in and on"
    cause = error.__context__  # termios' own, which has its number among its arguments
    if number == errno.EISDIR or (cause is not None and errno.ENOTTY in cause.args):
        return f"it is not a serial port; expected {ports_text()}"
    return re.sub(r"^(\[Errno \d+\] )?[Cc]ould not [^:]*: ", "", message)
