"""Access of the driver to its box, at a serial port or simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from labseq.plugin import Context, LineProgram
from labseq.plugin.serial import Port
from labseq_ttl.box import open_box
from labseq_ttl.settings import TtlSettings

if TYPE_CHECKING:
    from labseq_ttl_sim import SimulatedAccess

MAX_WAIT_S: Final = 1.0
"""How long an answer of a real box may take, in seconds."""


class RealBox:
    """A box at a serial port. A ``SimulatedAccess`` has the same methods.

    Attributes:
        max_wait_s: How long an answer may take, in seconds.
        real_time: Whether the box takes as long as a program lasts, and keeps time limits itself.
    """

    max_wait_s = MAX_WAIT_S
    real_time = True

    def __init__(self, port: str, device: str) -> None:
        self._port = port
        self._device = device

    def connect(self) -> Port:
        """Open the serial port of the box."""
        return open_box(self._port, self._device)

    def disconnect(self) -> None:
        """The port was closed. No effect if it is not connected."""

    def lines_set(self, program: LineProgram) -> None:
        """The lines were set to the state of this program, at once."""

    def fired(self, program: LineProgram | None) -> None:
        """A program was fired, None for a program that changes no line."""

    def is_over(self, end_s: float) -> bool:  # noqa: ARG002 - the box itself has reported it
        """Whether a program that the box plays, and that ends at this time, is over."""
        return True

    def wait_until(self, end_s: float, timeout_s: float) -> float:  # noqa: ARG002 - the box reports the end
        """Wait for the end of a program, and return how long to wait for the box's message."""
        return timeout_s

    def raise_go(self, timeout_s: float) -> float:
        """Wait for a leader's `go`, and return how long to wait for the box's message."""
        return timeout_s


def choose_box(settings: TtlSettings, context: Context) -> RealBox | SimulatedAccess:
    """The box that the setting ``port`` names."""
    if not settings.is_simulated:
        return RealBox(settings.port, context.name or "lines")
    from labseq_ttl_sim import SimulatedAccess

    return SimulatedAccess(settings, context)
