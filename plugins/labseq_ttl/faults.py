"""What goes wrong with an open box, in words."""

from __future__ import annotations

from labseq.plugin import DeviceError, DeviceTimeoutError, format_quantity
from labseq_ttl.box import cause_text


def reset_error(device: str, cause: int) -> DeviceError:
    """The box started anew in the middle of its work."""
    text = f"the box was reset (reason: {cause_text(cause)}) and turned all lines off"
    return DeviceError(device, f"{text}; look after its supply and cable")


def turned_off_error(device: str) -> DeviceError:
    """Somebody else told the box to turn its lines off."""
    return DeviceError(device, "the box was told to turn all lines off; expected nobody to do so")


def watchdog_error(device: str, lights_out_s: float) -> DeviceError:
    """The box heard nothing from this computer for too long."""
    text = f"the box heard nothing for {format_quantity(lights_out_s, 'time')} and turned all lines off"
    return DeviceError(device, f"{text}; is this computer too busy? raise 'watchdog_timeout'")


def is_too_late(device: str, timeout_s: float, *, is_external: bool) -> DeviceTimeoutError:
    """A program has not ended in time."""
    text = f"the lines' program is not over after {format_quantity(timeout_s, 'time')}"
    if is_external:
        text += "; did the edge at the start input come?"
    return DeviceTimeoutError(device, text, timeout_s)
