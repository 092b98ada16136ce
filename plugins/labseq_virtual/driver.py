"""What the virtual drivers share: open, close, and the simulated world."""

from __future__ import annotations

from abc import ABC, abstractmethod

from labseq import Context, DeviceError, Simulation


class VirtualDriver(ABC):
    """Base of the virtual drivers that act on the simulated world.

    Args:
        context: Name, clock, random numbers and the simulated world.
        role: Name to use where the context has none.
    """

    def __init__(self, context: Context, role: str) -> None:
        self._name = context.name or role
        self._clock = context.clock
        self._random = context.random
        self._simulation = context.simulation
        self._is_open = False

    def open(self) -> None:
        """Connect to the simulated world.

        Raises:
            DeviceError: There is none.
        """
        if self._simulation is None:
            raise DeviceError(
                self._name,
                "virtual hardware needs a simulated world; add `simulation: {use: virtual}` to the profile",
            )
        self._is_open = True

    def close(self) -> None:
        """Make the output harmless and disconnect; legal in any state."""
        self.safe_state()
        self._is_open = False

    @abstractmethod
    def safe_state(self) -> None:
        """Make the output harmless; legal in any state."""

    @property
    def _world(self) -> Simulation:
        assert self._simulation is not None  # open() has checked it
        return self._simulation

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
