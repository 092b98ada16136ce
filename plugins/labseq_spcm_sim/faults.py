"""Possible differences of real cards from the driver's assumptions, for the simulated card."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

MANUAL_SPEEDS: Final = (
    (16 << 10, 132e6),
    (64 << 10, 464e6),
    (512 << 10, 1352e6),
    (2 << 20, 1900e6),
    (4 << 20, 2284e6),
)
"""Notify size in bytes, bytes per second written from a user's buffer (manual of the M4i.44xx, p. 207)."""
CONTINUOUS_BYTES_PER_S: Final = 2549e6
"""The same from the driver's continuous buffer (same table)."""

COPY_BYTES_PER_S: Final = 8e9
"""Speed at which handed-over samples are copied, if they are (ours)."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Differences of the simulated card from the default.

    Attributes:
        copies_samples: Samples are copied when they are handed over, as with a card in another computer.
        position_lag_s: How long ago the reported position of a transfer was true, in seconds.
        fifo_short_bytes: By how much the on-board FIFO is smaller than its register says.
        pinning_s: Time to name a transfer buffer, in seconds.
        underrun_not_ready: After an underrun the card reports the overrun, but not that it is ready.
        write_speeds: Pairs of notify size in bytes and speed in bytes per second, none for the bus speed.
    """

    copies_samples: bool = False
    position_lag_s: float = 0.0
    fifo_short_bytes: int = 0
    pinning_s: float = 0.0
    underrun_not_ready: bool = False
    write_speeds: tuple[tuple[int, float], ...] = ()

    def write_speed(self, notify_bytes: int, bus_bytes_per_s: float, *, continuous: bool) -> float:
        """Speed of a transfer, in bytes per second, between the notify sizes of the table by a power law."""
        if not self.write_speeds:
            return bus_bytes_per_s
        if continuous:
            return CONTINUOUS_BYTES_PER_S
        sizes, speeds = np.log(np.array(self.write_speeds)).T
        return float(np.exp(np.interp(math.log(notify_bytes or self.write_speeds[-1][0]), sizes, speeds)))


class LateCounter:
    """A growing count of bytes that is reported late.

    Args:
        lag_s: How late, in seconds.
    """

    def __init__(self, lag_s: float) -> None:
        self._lag_s = lag_s
        self._points: deque[tuple[float, float]] = deque([(-math.inf, 0.0)])

    def add(self, time_s: float, n_bytes: float) -> None:
        """Add the count at a time. Between two times it grows linearly."""
        self._points.append((time_s, n_bytes))
        while len(self._points) > 1 and self._points[1][0] <= time_s - self._lag_s:
            self._points.popleft()

    def at(self, now_s: float) -> float:
        """The count that is reported at a time."""
        true_s = now_s - self._lag_s
        before_s, n_before = self._points[0]
        for time_s, n_bytes in self._points:
            if time_s > true_s:
                passed = (true_s - before_s) / (time_s - before_s) if math.isfinite(before_s) else 0.0
                return n_before + passed * (n_bytes - n_before)
            before_s, n_before = time_s, n_bytes
        return n_before
