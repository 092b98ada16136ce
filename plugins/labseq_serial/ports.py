"""The port of a profile, opened by pyserial."""

from __future__ import annotations

from typing import Any

from labseq.plugin import DeviceError, Port, open_port, ports_here, ports_text
from labseq_serial.settings import SerialSettings, UsbSettings


def open_line(settings: SerialSettings, device: str) -> Port:
    """Open the port of a profile, alone.

    Args:
        settings: The port and how to speak on it.
        device: Name of the instrument, for messages.

    Raises:
        DeviceError: There is no such port, or somebody else has it open.
    """
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
    return open_port(port, device, settings.baud_rate, **options)


def _find(usb: UsbSettings, device: str) -> str:
    """The port of an adapter."""
    wanted = {"vid": usb.vid, "pid": usb.pid, "serial_number": usb.serial}
    given = {key: value for key, value in wanted.items() if value is not None}
    fits = [
        port
        for port in ports_here()
        if all(getattr(port, key, None) == value for key, value in given.items())
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
    text = f"no USB adapter has {described}; expected {ports_text()}; is it plugged in?"
    raise DeviceError(device, text)
