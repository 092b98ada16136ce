"""Shared code for cameras that are set through a vendor's library, for cooling and rounded times."""

from __future__ import annotations

from abc import abstractmethod
from typing import Final

from labseq.drivers.camera import CameraDriver, Cooling, settle
from labseq.drivers.settings import CameraSettings
from labseq.errors import DeviceError, LimitError, one_of
from labseq.roles import Context
from labseq.units import format_quantity

MAX_LENGTHENING: Final = 1.01
"""An exposure may be longer than requested by at most this factor."""


def without_rounding(value: float, wanted: float, rounding: float = 1e-6) -> float:
    """The library's value, or the requested value if they differ only by rounding.

    Args:
        value: Value that the library reports.
        wanted: The requested value.
        rounding: Largest relative difference that counts as rounding.

    Example:
        >>> without_rounding(0.1000000015, 0.1), without_rounding(0.11, 0.1)
        (0.1, 0.11)
    """
    return wanted if abs(value - wanted) <= rounding * abs(wanted) else value


class SdkCamera(CameraDriver):
    """Base of drivers that set their camera through a vendor's library.

    Args:
        settings: The sensor's settings.
        cooling: Temperature of the sensor. None leaves the cooler unchanged.
        context: Name of the camera, and clock.
    """

    def __init__(self, settings: CameraSettings, cooling: Cooling | None, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._cooling = cooling

    @abstractmethod
    def _read_temperature_k(self) -> float:
        """Temperature of the sensor, in kelvins."""

    @property
    def settling_timeout_s(self) -> float:
        """Maximum time for cooling, in seconds. 0 without cooling."""
        return 0.0 if self._cooling is None else self._cooling.timeout_s

    def settle(self) -> None:
        """Wait until the sensor is cold.

        Raises:
            DeviceTimeoutError: It takes too long.
        """
        if self._cooling is not None:
            self._check_open()
            settle(self._cooling, self._read_temperature_k, self._clock, self._name)

    def _check_line_trigger(self, triggers: tuple[str, ...]) -> None:
        """Refuse a `line_trigger` that the camera does not have."""
        wanted = self.facts.line_trigger
        if wanted not in triggers and wanted != "external":
            text = f"this camera has no {wanted} trigger with these settings, only {one_of(triggers)}"
            raise DeviceError(self._name, f"{text}; set another `line_trigger`")

    def _check_exposure(self, made_s: float, wanted_s: float, hint: str) -> None:
        """Refuse an exposure that the camera makes longer than requested."""
        if made_s > MAX_LENGTHENING * wanted_s:
            requested, shortest = (format_quantity(s, "time") for s in (wanted_s, made_s))
            raise LimitError(f"{self._name}: exposure", requested, f"at least {shortest}", hint)

    def _check_cycle(self, made_s: float) -> None:
        """Refuse a `cycle_time` that the camera lengthens to ``made_s``."""
        wanted_s = self.facts.cycle_s
        if without_rounding(made_s, wanted_s) > wanted_s:
            wanted, least = (format_quantity(s, "time") for s in (wanted_s, made_s))
            what = f"{self._name}: cycle_time"
            raise LimitError(what, wanted, f"at least {least} with this exposure and read-out")
