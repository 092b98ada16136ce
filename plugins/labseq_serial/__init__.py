"""Instruments on a serial line, described in the profile."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the device ``serial``; in a dry run the instrument is simulated from its description."""
    from labseq_serial.device import SerialDevice
    from labseq_serial.settings import SIMULATED, SerialSettings

    registry.device("serial", SerialDevice, SerialSettings, simulated={"port": SIMULATED})
