"""The sensor's temperature."""

from __future__ import annotations

from labseq.plugin import (
    ZERO_CELSIUS_K,
    Clock,
    Cooling,
    DeviceError,
    DeviceTimeoutError,
    format_quantity,
    settle,
)
from labseq_andor.codes import Code
from labseq_andor.sdk import Sdk

LOOK_S = 1.0
"""How often the camera is asked, in seconds."""


def temperature_k(sdk: Sdk) -> float | None:
    """Temperature in kelvins; None while the camera acquires, and from a camera that measures none."""
    try:
        return round(read_temperature(sdk)[1] + ZERO_CELSIUS_K, 2)
    except DeviceError:
        return None


def read_temperature(sdk: Sdk) -> tuple[int, float]:
    """The SDK's status of the cooling, and the temperature in degrees Celsius.

    Raises:
        DeviceError: The camera acquires, or is gone.
    """
    with sdk.selected() as lib:
        status, celsius = lib.GetTemperatureF()
    return int(status), float(celsius)


def wait_until_cold(sdk: Sdk, cooling: Cooling, clock: Clock, name: str) -> None:
    """Wait until the sensor is as cold as it shall be, and the camera calls it stabilized.

    Raises:
        DeviceTimeoutError: It takes longer than it may.
    """
    start_s = clock.now()
    settle(cooling, lambda: read_temperature(sdk)[1] + ZERO_CELSIUS_K, clock, name)
    while (status := read_temperature(sdk)[0]) != Code.TEMP_STABILIZED:
        if clock.now() - start_s >= cooling.timeout_s:
            waited = format_quantity(cooling.timeout_s, "time")
            text = f"the camera does not call its temperature stabilized after {waited} (status {status})"
            raise DeviceTimeoutError(name, f"{text}; raise `timeout` of its cooling", cooling.timeout_s)
        clock.sleep(LOOK_S)
