"""The line to an instrument, its texts, replies and errors."""

from __future__ import annotations

import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from labseq.plugin import (
    Clock,
    DeviceError,
    DeviceTimeoutError,
    Emergency,
    TransientError,
    format_quantity,
    wait_for,
)
from labseq.plugin.messages import clean
from labseq.plugin.serial import (
    BROKEN,
    Port,
    SerialMessage,
    is_write_timeout,
    open_port,
    ports_text,
    serial_emergency,
)
from labseq_serial.settings import SIMULATED, SerialSettings, UsbSettings
from labseq_serial.simulated import SimulatedLine
from labseq_serial.values import Scalar

MAX_REPLY: Final = 4096
"""Longest reply in bytes. More is noise."""


class Line:
    """An open port, for one exchange at a time.

    Replies are without their end and surrounding spaces.

    Attributes:
        broken: Whether the port was lost and must be opened again.
        aborted: Set by another thread to end a wait for a reply.
    """

    def __init__(self, port: Port, settings: SerialSettings, device: str, clock: Clock) -> None:
        self.broken = False
        self.aborted = threading.Event()
        self._port = port
        self._settings = settings
        self._device = device
        self._clock = clock
        self._free_s = clock.now() + settings.wait_after_open

    def identify(self) -> str:
        """Ask the instrument for its identity."""
        identify = self._settings.identify
        return "" if identify is None else self._exchange(identify.ask, self._settings.timeout)

    def ask(self, name: str) -> str:
        """Ask for a value."""
        value = self._settings.values[name]
        return self._exchange(value.ask, value.timeout or self._settings.timeout)

    def send(self, name: str, arguments: Mapping[str, Scalar]) -> str:
        """Send a command with arguments in SI. The reply is "" if none comes."""
        command = self._settings.commands[name]
        timeout_s = command.timeout or self._settings.timeout
        return self._exchange(command.text(arguments), timeout_s, answered=command.reply is not None)

    def emergency(self, messages: Sequence[SerialMessage]) -> Emergency | None:
        """How another process sends messages."""
        return serial_emergency(self._port, messages, self._settings.encoding, echo=self._settings.echo)

    def close(self) -> None:
        """Close the port. Legal in any state."""
        with suppress(*BROKEN):
            self._port.close()

    def _exchange(self, text: str, timeout_s: float, *, answered: bool = True) -> str:
        """Send a text and wait for the reply. Bytes from before are dropped.

        Raises:
            DeviceTimeoutError: No reply, or one without an end.
            DeviceError: A reply that cannot be read.
            TransientError: The line is broken.
            StopRequested: The operator asked the run to stop.
        """
        settings = self._settings
        if (wait_s := self._free_s - self._clock.now()) > 0:
            self._clock.sleep(wait_s)
        sent = (text + settings.write_ends_with).encode(settings.encoding)
        end = settings.read_ends_with.encode(settings.encoding) if answered else b""
        try:
            with self._unbroken(text, timeout_s):
                self._port.reset_input_buffer()  # a late reply must not count as the reply to this text
                self._port.write(sent)
            came = self._receive(text, sent if settings.echo else b"", end, timeout_s)
        finally:  # it may be busy although its reply was lost
            self._free_s = self._clock.now() + settings.pause
        try:
            return came.decode(settings.encoding).strip()
        except UnicodeDecodeError:
            what = f"the reply to '{clean(text)}', '{_visible(came)}', is not {settings.encoding}"
            raise DeviceError(self._device, f"{what}; check 'baud_rate', 'parity' and 'encoding'") from None

    def _receive(self, text: str, echo: bytes, end: bytes, timeout_s: float) -> bytes:
        """Read the bytes between the echo and the end. Nothing is read if both are empty."""
        came = bytearray()

        def look(_: float) -> int | None:
            if self.aborted.is_set():
                raise DeviceError(self._device, f"'{clean(text)}' was aborted by the safe state")
            came.extend(self._port.read(min(max(1, self._port.in_waiting), MAX_REPLY)))
            at = came.find(end, len(echo))
            return at if at >= 0 or len(came) > len(echo) + MAX_REPLY else None

        if not echo and not end:
            return b""
        with self._unbroken(text, timeout_s):
            at = wait_for(look, timeout_s, self._clock)
        if at is None:
            raise DeviceTimeoutError(self._device, self._incomplete(text, bytes(came), timeout_s), timeout_s)
        if not came.startswith(echo):
            what = f"'{clean(text)}' was echoed as '{_visible(bytes(came))}'"
            raise DeviceError(self._device, f"{what}; check 'echo', 'write_ends_with' and 'baud_rate'")
        if at < 0:
            what = f"the reply to '{clean(text)}' does not end: '{_visible(bytes(came))}'"
            raise DeviceError(self._device, f"{what}; check 'read_ends_with' and 'baud_rate'")
        return bytes(came[len(echo) : at])

    def _incomplete(self, text: str, came: bytes, timeout_s: float) -> str:
        waited = format_quantity(timeout_s, "time")
        if not came:
            what = f"no reply to '{clean(text)}' within {waited}"
            return f"{what}; switch it on, check 'baud_rate' and 'write_ends_with', or raise 'timeout'"
        end = clean(self._settings.read_ends_with)
        what = f"the reply to '{clean(text)}', '{_visible(came)}', did not end with '{end}' within {waited}"
        return f"{what}; check 'read_ends_with', 'echo' and 'baud_rate', or raise 'timeout'"

    @contextmanager
    def _unbroken(self, text: str, timeout_s: float) -> Generator[None]:
        """Turn errors of the port into errors of the device."""
        try:
            yield
        except BROKEN as error:
            if isinstance(error, DeviceTimeoutError):  # an OSError too
                raise
            # a complete write times out too if the instrument stops the flow at that moment
            if is_write_timeout(error):
                waited = format_quantity(timeout_s, "time")
                what = f"'{clean(text)}' could not be sent within {waited}; see 'flow_control'"
                raise DeviceTimeoutError(self._device, what, timeout_s) from error
            self.broken = True
            what = f"the line broke at '{clean(text)}' ({' '.join(str(error).split())}); unplugged?"
            raise TransientError(what, self._device) from error


def _visible(came: bytes) -> str:
    return clean(came.decode("ascii", "backslashreplace"))


def open_line(settings: SerialSettings, device: str, clock: Clock) -> Line | SimulatedLine:
    """Open the port of a profile exclusively, or the line to a simulated instrument."""
    if settings.port == SIMULATED:
        return SimulatedLine(settings, clock)
    port = settings.port if settings.usb is None else _find(settings.usb, device)
    assert port is not None
    options: dict[str, Any] = {
        "bytesize": settings.data_bits,
        "parity": settings.parity[0].upper(),
        "stopbits": settings.stop_bits,
        "rtscts": settings.flow_control == "rts_cts",
        "dsrdtr": settings.flow_control == "dsr_dtr",
        "xonxoff": settings.flow_control == "xon_xoff",
        "write_timeout": settings.timeout,
    }
    return Line(open_port(port, device, settings.baud_rate, **options), settings, device, clock)


def _find(usb: UsbSettings, device: str) -> str:
    """The port of an adapter."""
    fits = usb.ports()
    if len(fits) == 1:
        return fits[0].device
    described = ", ".join(
        f"{key} {value:#06x}" if isinstance(value, int) else f"{key} {value}"
        for key, value in usb.given.items()
    )
    if fits:
        names = ", ".join(f"{port.device} ({port.serial_number})" for port in fits)
        text = f"{len(fits)} adapters have {described}: {names}; add 'serial' to tell them apart"
        raise DeviceError(device, text)
    text = f"no USB adapter has {described}; plug it in, or use {ports_text()}"
    raise DeviceError(device, text)
