"""Boxes that are none: a model of it, and its firmware on a simulated processor."""

from __future__ import annotations

from typing import Protocol

from labseq.plugin import Clock, Port
from labseq_ttl.protocol import Edge


class Counterpart(Protocol):
    """A simulated box."""

    @property
    def port(self) -> Port:
        """Its serial port, open."""
        ...

    def played(self, polarity: int) -> list[Edge]:
        """What the outputs did since the start of the program that was just fired.

        Args:
            polarity: Outputs that are low when they are on.

        Returns:
            Ticks since the first edge, and what was on from then on; after a reset nothing is.
        """
        ...

    def start(self) -> None:
        """A rising edge at the start input."""
        ...

    def close(self) -> None:
        """End it; legal in any state."""
        ...


def warm_simulator(simulated_by: str, device: str) -> None:
    """Compile what a simulated box needs, before it is turned on.

    Raises:
        DeviceError: It cannot be compiled.
    """
    if simulated_by == "simavr":
        from labseq_ttl.counterpart.build import runner

        runner(device)


def start_simulator(simulated_by: str, device: str, clock: Clock) -> Counterpart:
    """Make a simulated box and turn it on.

    Args:
        simulated_by: "python" or "simavr".
        device: Name of the box, for messages.
        clock: The session's clock, asked for a stop request.

    Raises:
        DeviceError: It cannot be had.
    """
    if simulated_by == "simavr":
        from labseq_ttl.counterpart.simavr import SimavrBox

        return SimavrBox(device, clock)
    from labseq_ttl.counterpart.emulator import EmulatedBox

    return EmulatedBox()
