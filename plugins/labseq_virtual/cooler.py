"""The cooler of the virtual camera."""

from __future__ import annotations

import math
from typing import Final

from labseq.plugin import Clock

ROOM_K: Final = 293.15
"""Temperature of a sensor whose cooler is off (ours)."""

COLDEST_K: Final = 183.15
"""Coldest that the cooler makes a sensor: -90 degC (ours)."""

TIME_CONSTANT_S: Final = 60.0
"""Time constant of the way there, in seconds (ours)."""

SWING: Final = 0.6
"""Radians that it swings in a time constant (ours): it overshoots by exp(-pi / 0.6), which is 0.5 %."""


class Cooler:
    """Brings a sensor to a temperature and keeps it there: a damped swing, without noise.

    Args:
        setpoint_k: Temperature, in kelvins; one below :data:`COLDEST_K` is not reached.
        clock: The session's clock.
    """

    def __init__(self, setpoint_k: float, clock: Clock) -> None:
        self._end_k = max(setpoint_k, COLDEST_K)
        self._clock = clock
        self._start_s: float | None = None

    def switch_on(self) -> None:
        """Begin to cool; no effect if it is on."""
        if self._start_s is None:
            self._start_s = self._clock.now()

    @property
    def temperature_k(self) -> float:
        """Of the sensor now, in kelvins."""
        if self._start_s is None:
            return ROOM_K
        t = (self._clock.now() - self._start_s) / TIME_CONSTANT_S
        left = math.exp(-t) * (math.cos(SWING * t) + math.sin(SWING * t) / SWING)
        return self._end_k + (ROOM_K - self._end_k) * left
