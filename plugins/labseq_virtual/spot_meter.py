"""A meter of the power of each static tweezer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, Device, DeviceError
from labseq_virtual.settings import SpotMeterSettings
from labseq_virtual.tweezers import VirtualDriver

VALUE = "spot_powers"


class VirtualSpotMeter(VirtualDriver, Device):
    """Measures the power of each static tweezer, with noise.

    Its only value is ``spot_powers``, float64 (n_rows, n_cols), relative to the nominal power.
    """

    def __init__(self, settings: SpotMeterSettings, context: Context) -> None:
        super().__init__(context, "spot_meter")
        self._settings = settings

    def safe_state(self) -> None:
        """Do nothing, because the meter only measures."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Refuse every command, because the meter has none.

        Raises:
            DeviceError: Always.
        """
        del arguments
        raise DeviceError(self._name, f"unknown command '{name}'; the meter only measures, so read '{VALUE}'")

    command = check_command

    def read(self, name: str) -> NDArray[np.float64]:
        """Measure once.

        Raises:
            DeviceError: Not open, or an unknown value.
        """
        self._check_open()
        if name != VALUE:
            raise DeviceError(self._name, f"unknown value '{name}'; expected '{VALUE}'")
        self._clock.sleep(20e-3)  # duration of a measurement (ours)
        powers: NDArray[np.float64] = self._simulation.spot_powers()  # pyright: ignore[reportAttributeAccessIssue]
        return powers * (1 + self._settings.noise * self._random.shot.standard_normal(powers.shape))

    def describe(self) -> Mapping[str, Any]:
        """Model and settings."""
        return {"model": "virtual spot meter", **self._settings.model_dump(mode="json")}
