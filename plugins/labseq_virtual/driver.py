"""What the virtual drivers share: open, close, and the simulated world."""

from __future__ import annotations

from abc import ABC, abstractmethod

from labseq.plugin import ConfigError, Context, DeviceError, Simulation


class VirtualDriver(ABC):
    """Base of the virtual drivers that act on the simulated world.

    Args:
        context: Name, clock, random numbers and the simulated world.
        role: Name to use where the context has none.

    Raises:
        ConfigError: There is no simulated world.
    """

    def __init__(self, context: Context, role: str) -> None:
        self._name = context.name or role
        self._clock = context.clock
        self._random = context.random
        self._world = simulated_world(context)
        self._is_open = False

    def open(self) -> None:
        """Connect to the simulated world."""
        self._is_open = True

    def close(self) -> None:
        """Make the output harmless and disconnect; legal in any state."""
        self.safe_state()
        self._is_open = False

    @abstractmethod
    def safe_state(self) -> None:
        """Make the output harmless; legal in any state."""

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")


def simulated_world(context: Context) -> Simulation:
    """The world that virtual hardware acts on.

    Raises:
        ConfigError: There is none.
    """
    if context.simulation is None:
        raise ConfigError(
            "virtual hardware needs a simulated world; add `simulation: {use: virtual}` to the profile"
        )
    return context.simulation
