"""Instruments on a serial line, described in the profile."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the device ``serial``, which a dry run simulates from its description."""
    device, settings = "labseq_serial.device:SerialDevice", "labseq_serial.settings:SerialSettings"
    registry.device("serial", device, settings, simulated={"port": "simulated"})
