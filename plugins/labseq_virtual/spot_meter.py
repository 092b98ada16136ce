"""A virtual camera behind the objective that sees the static tweezers' light itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError
from labseq_virtual.driver import VirtualDriver
from labseq_virtual.settings import SpotMeterSettings

VALUE = "spot_powers"


class VirtualSpotMeter(VirtualDriver):
    """Measures the power of each static tweezer, with noise.

    Its only value is ``spot_powers``, float64 (n_rows, n_cols), over the nominal power.

    Args:
        settings: Noise and time of a measurement.
        context: Clock, random numbers and the simulated world.
    """

    def __init__(self, settings: SpotMeterSettings, context: Context) -> None:
        super().__init__(context, "spot_meter")
        self._settings = settings

    def safe_state(self) -> None:
        """Nothing to do: it only looks."""

    def command(self, name: str, **arguments: Any) -> None:
        """Refuse: it knows no commands.

        Raises:
            DeviceError: Always.
        """
        del arguments
        raise DeviceError(self._name, f"unknown command '{name}'; it only measures: read '{VALUE}'")

    def read(self, name: str) -> NDArray[np.float64]:
        """Measure once.

        Raises:
            DeviceError: Not open, or a value that it does not know.
        """
        self._check_open()
        if name != VALUE:
            raise DeviceError(self._name, f"unknown value '{name}'; expected '{VALUE}'")
        self._clock.sleep(self._settings.duration)
        powers: NDArray[np.float64] = self._world.spot_powers()  # pyright: ignore[reportAttributeAccessIssue]
        return powers * (1 + self._settings.noise * self._random.shot.standard_normal(powers.shape))

    def describe(self) -> Mapping[str, Any]:
        """Model and settings."""
        return {"model": "virtual spot meter", **self._settings.model_dump(mode="json")}
