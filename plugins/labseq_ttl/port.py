"""The serial port of the box."""

from __future__ import annotations

from typing import Final

from labseq.plugin import Port, open_port

BAUD_RATE: Final = 500_000
WRITE_TIMEOUT_S: Final = 1.0


def open_box(name: str, device: str) -> Port:
    """Open the port of a box, alone.

    Args:
        name: As the profile has it.
        device: Name of the box, for messages.

    Raises:
        DeviceError: There is no such port, or somebody else has it open.
    """
    return open_port(name, device, BAUD_RATE, write_timeout=WRITE_TIMEOUT_S)
