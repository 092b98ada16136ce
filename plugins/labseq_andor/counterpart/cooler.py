"""The simulated camera's cooler."""

from __future__ import annotations

import math
from typing import Any, Final

from labseq.plugin import Clock
from labseq_andor.codes import Code
from labseq_andor.counterpart.calls import answers
from labseq_andor.counterpart.faults import Faults

ROOM_C: Final = 20.0
RANGE_C: Final = (-120, 20)
"""What can be asked for (ours)."""

TIME_CONSTANT_S: Final = 60.0
"""Of the way from one temperature to another (ours)."""

NEAR_K: Final = 1.0
"""How near the sensor must come to count as there (ours)."""

STABLE_AFTER_S: Final = 30.0
"""How long it must have been near until the camera calls it stabilized (ours)."""


class Cooler:
    """Brings the sensor to its temperature exponentially, on the session's clock.

    Args:
        clock: The session's clock.
        faults: Failures to rehearse.

    Attributes:
        is_on: Whether the cooler is on.
    """

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock = clock
        self._faults = faults
        self.is_on = False
        self._setpoint_c = RANGE_C[1]
        self._keeps_on = False
        self._from_c, self._since_s = ROOM_C, clock.now()

    @property
    def temperature_c(self) -> float:
        """Of the sensor now, in degrees Celsius."""
        passed_s = self._clock.now() - self._since_s
        left_k = (self._from_c - self._end_c) * math.exp(-passed_s / TIME_CONSTANT_S)
        return self._end_c + left_k + self._faults.drift_k

    def shut_down(self) -> None:
        """What happens when the SDK is shut down."""
        if not self._keeps_on:
            self._change(is_on=False)

    @answers("GetTemperatureRange")
    def get_range(self, least: Any, most: Any) -> int:
        """Temperatures that can be asked for."""
        least[0], most[0] = RANGE_C
        return Code.SUCCESS

    @answers("SetTemperature", only_idle=True)
    def set_temperature(self, celsius: int) -> int:
        """What the cooler aims at."""
        if not RANGE_C[0] <= celsius <= RANGE_C[1]:
            return Code.P1INVALID
        if celsius != self._setpoint_c:
            self._change(setpoint_c=celsius)
        return Code.SUCCESS

    @answers("GetTemperatureF", only_idle=True)
    def get_temperature(self, celsius: Any) -> int:
        """Temperature, and how the cooling gets on."""
        celsius[0] = self.temperature_c
        return self._status

    @answers("CoolerON", only_idle=True)
    def switch_on(self) -> int:
        """Begin to cool."""
        if not self.is_on:
            self._change(is_on=True)
        return Code.SUCCESS

    @answers("CoolerOFF", only_idle=True)
    def switch_off(self) -> int:
        """Let the sensor warm up."""
        if self.is_on:
            self._change(is_on=False)
        return Code.SUCCESS

    @answers("IsCoolerOn")
    def get_is_on(self, is_on: Any) -> int:
        """Whether it is on."""
        is_on[0] = int(self.is_on)
        return Code.SUCCESS

    @answers("SetCoolerMode", only_idle=True)
    def set_mode(self, keeps_on: int) -> int:
        """1: it stays on when the SDK is shut down."""
        self._keeps_on = bool(keeps_on)
        return Code.SUCCESS

    @answers("SetFanMode", only_idle=True)
    def set_fan(self, mode: int) -> int:
        """0: full, 1: low, 2: off."""
        return Code.SUCCESS if 0 <= mode <= 2 else Code.P1INVALID

    @property
    def _end_c(self) -> float:
        return max(self._setpoint_c, self._faults.coldest_c) if self.is_on else ROOM_C

    @property
    def _status(self) -> int:
        if not self.is_on:
            return Code.TEMP_OFF
        way_k = max(abs(self._from_c - self._setpoint_c), NEAR_K)
        near_s = self._since_s + TIME_CONSTANT_S * math.log(way_k / NEAR_K)
        was_stable = self._clock.now() >= near_s + STABLE_AFTER_S and self._end_c == self._setpoint_c
        if abs(self.temperature_c - self._setpoint_c) > NEAR_K + 1e-6:
            return Code.TEMP_DRIFT if was_stable else Code.TEMP_NOT_REACHED
        return Code.TEMP_STABILIZED if was_stable else Code.TEMP_NOT_STABILIZED

    def _change(self, *, is_on: bool | None = None, setpoint_c: int | None = None) -> None:
        self._from_c, self._since_s = self.temperature_c - self._faults.drift_k, self._clock.now()
        self.is_on = self.is_on if is_on is None else is_on
        self._setpoint_c = self._setpoint_c if setpoint_c is None else setpoint_c
