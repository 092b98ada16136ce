"""A sensor that is cooled before it is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from labseq.errors import DeviceTimeoutError
from labseq.roles import Clock
from labseq.units import ZERO_CELSIUS_K, format_quantity

LOOK_S: Final = 1.0
"""How often the temperature is read, in seconds."""


@dataclass(frozen=True, slots=True)
class Cooling:
    """How cold a sensor shall be.

    Attributes:
        setpoint_k: Temperature, in kelvins.
        tolerance_k: How far from it the sensor may be, in kelvins.
        steady_s: How long it must have been within that, in seconds.
        timeout_s: How long it may take, in seconds.
    """

    setpoint_k: float
    tolerance_k: float = 1.0
    steady_s: float = 5.0
    timeout_s: float = 900.0


def settle(cooling: Cooling, read_k: Callable[[], float], clock: Clock, name: str) -> None:
    """Wait until a sensor is as cold as it shall be, and stays so.

    Args:
        cooling: How cold, how steady, how long.
        read_k: Reads the temperature, in kelvins.
        clock: The session's clock.
        name: Name of the device, for the error.

    Raises:
        DeviceTimeoutError: It does not get there in time.
        StopRequested: The operator asked the run to stop.
    """
    start_s = clock.now()
    within_since_s: float | None = None
    while True:
        now_s, temperature_k = clock.now(), read_k()
        if abs(temperature_k - cooling.setpoint_k) > cooling.tolerance_k:
            within_since_s = None
        elif within_since_s is None:
            within_since_s = now_s
        if within_since_s is not None and now_s - within_since_s >= cooling.steady_s:
            return
        if now_s - start_s >= cooling.timeout_s:
            raise DeviceTimeoutError(name, _too_late(cooling, temperature_k), cooling.timeout_s)
        clock.sleep(LOOK_S)


def _too_late(cooling: Cooling, temperature_k: float) -> str:
    waited = format_quantity(cooling.timeout_s, "time")
    came, wanted = (f"{kelvin - ZERO_CELSIUS_K:.1f} degC" for kelvin in (temperature_k, cooling.setpoint_k))
    text = f"the sensor is at {came} after {waited}; expected {wanted} within {cooling.tolerance_k:g} K"
    return f"{text}; look after its cooling water or fan, or choose a higher temperature"
