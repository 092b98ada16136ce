"""The space of an adaptive scan and its points, and streams of random numbers."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class ScanRange:
    """The allowed values of an address in an adaptive scan, SI.

    Attributes:
        address: For example "planner.degree_of_parallelism".
        low: The least value.
        high: The greatest value.
        is_whole: Whether only whole numbers are allowed.
        n_steps: Number of equal steps from ``low`` to ``high``. 0 if any value is allowed.
        start: The value in the files. nan if they have none.
    """

    address: str
    low: float
    high: float
    is_whole: bool = False
    n_steps: int = 0
    start: float = math.nan

    def at(self, fraction: float) -> float:
        """The allowed value that is nearest to a fraction of the way from ``low`` to ``high``.

        Example:
            >>> ScanRange("planner.degree_of_parallelism", 2, 15, is_whole=True).at(0.5)
            8
            >>> ScanRange("profile.mobile_tweezers.pick_up", 0.0, 4e-4, n_steps=4).at(0.3)
            0.0001
        """
        fraction = min(max(fraction, 0.0), 1.0)
        if self.n_steps:
            fraction = round(fraction * self.n_steps) / self.n_steps
        value = self.low + fraction * (self.high - self.low) if fraction < 1.0 else self.high
        return round(value) if self.is_whole else value

    def allowed(self, value: object) -> float | None:
        """A number without rounding error if it is one of the range's values, otherwise None.

        Example:
            >>> dop = ScanRange("planner.degree_of_parallelism", 2, 15, is_whole=True)
            >>> dop.allowed(7.0), dop.allowed(7.5), dop.allowed(16), dop.allowed(math.nan)
            (7, None, None, None)
        """
        if isinstance(value, bool) or not isinstance(value, Real):
            return None
        try:
            number = float(value)
        except OverflowError:
            return None
        if not self.low - self.high <= number - self.low <= 2 * (self.high - self.low):  # also excludes nan
            return None
        near = self.at(self.fraction(number))
        tolerance = 1e-9 * (self.high - self.low) / (self.n_steps or 1)
        return near if abs(near - number) <= tolerance else None

    def fraction(self, value: float) -> float:
        """The inverse of :meth:`at`, with 0 at ``low`` and 1 at ``high``."""
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True, slots=True)
class ScanSpace:
    """The space of points of a scanner.

    Attributes:
        ranges: A range for each address.
        n_points: Maximum number of points. A point that is visited twice counts twice.
        repeats: Number of shots at each point.
        seed: The run's seed.
    """

    ranges: tuple[ScanRange, ...]
    n_points: int
    repeats: int = 1
    seed: int = 0

    def random(self, n_visited: int) -> np.random.Generator:
        """Random numbers for the choice of a point, which depend only on the number of points so far.

        Args:
            n_visited: Number of points that have been visited so far.
        """
        # The first number separates them from the random numbers of shots.
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0x0ADA, n_visited)))


@dataclass(frozen=True, slots=True)
class VisitedPoint:
    """A point of an adaptive scan and its result.

    Attributes:
        values: Address -> value, SI.
        score: The mean of the quantity over the point's shots, or its negative if the scan minimises it. A
            higher score is better. nan if no shot has the quantity.
        shots: Quantities of each shot in the run's index: name -> number.
    """

    values: Mapping[str, float]
    score: float
    shots: tuple[Mapping[str, Any], ...] = ()


class RandomStream:
    """The random numbers of one consumer (the simulation, a device).

    Attempt a at shot k draws from ``SeedSequence(seed, spawn_key=(k, a))``, whatever happened before. The
    machine's own disorder depends only on the seed. Consumers other than the simulation have their own
    streams, distinguished by name, so that adding a consumer does not change the others' numbers.

    Args:
        seed: The run's seed.
        name: Name of the consumer. "" is the simulation.
    """

    def __init__(self, seed: int, name: str = "") -> None:
        self.seed = seed
        self.name = name
        self._key = (zlib.crc32(name.encode()),) if name else ()
        self._shot = self.machine()

    def machine(self) -> np.random.Generator:
        """A new generator for everything that stays the same from shot to shot."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=self._key))

    def begin_shot(self, shot_index: int, attempt: int) -> None:
        """Start the random numbers of a shot. The sequencer calls this."""
        key = (shot_index, attempt, *self._key)
        self._shot = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    @property
    def shot(self) -> np.random.Generator:
        """The generator of the current shot."""
        return self._shot
