"""Serial ports, and devices that are switched off over one."""

from __future__ import annotations

from labseq.drivers.serial_port import (
    BROKEN,
    Port,
    SerialMessage,
    is_network_port,
    is_write_timeout,
    open_port,
    port_identities,
    ports_here,
    ports_text,
    serial_emergency,
)

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
