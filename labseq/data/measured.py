"""A quantity of a run in progress, added up as the shots come: over all shots and at each point of a scan."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from labseq.data.quantities import Quantity, make_quantity
from labseq.data.shot import Shot
from labseq.model import TargetPattern
from labseq.model.estimate import Estimate, Estimated, Rate
from labseq.recording.results import PREFIX, Results, results_file


@dataclass(slots=True)
class Sums:
    """What the mean of a quantity needs.

    Attributes:
        n_shots: Number of shots with a value.
        n: Sum of the values, or of the events.
        n_trials: Number of shots, or of trials.
        squares: Sum of the squares of the values.
    """

    n_shots: int = 0
    n: float = 0.0
    n_trials: float = 0.0
    squares: float = 0.0

    def __iadd__(self, other: Sums) -> Sums:
        self.n_shots += other.n_shots
        self.n += other.n
        self.n_trials += other.n_trials
        self.squares += other.squares
        return self

    def mean(self, *, is_rate: bool) -> Estimated:
        """The mean, with its error."""
        if is_rate:
            return Rate(round(self.n), round(self.n_trials))
        if not self.n_shots:
            return Estimate(math.nan, math.nan)
        value = self.n / self.n_shots
        if self.n_shots == 1:
            return Estimate(value, math.nan)
        variance = max(0.0, self.squares - self.n * value) / (self.n_shots - 1)
        return Estimate(value, math.sqrt(variance / self.n_shots))


class Measured:
    """The values of a quantity so far.

    Args:
        name: Name of the quantity, which has been checked.
        target: The target of the run.
        run_dir: The run's folder.

    Attributes:
        quantity: The quantity.
        total: Its values in all shots.
        at_points: Its values at each point of a scan: number -> sums.
    """

    def __init__(self, name: str, target: TargetPattern, run_dir: Path) -> None:
        self.quantity: Quantity = make_quantity(name, target)
        self.total = Sums()
        self.at_points = defaultdict[int | None, Sums](Sums)
        # results of analyses come later than the shots
        analysis, _, self._key = name.removeprefix(PREFIX).partition(".")
        self._results = Results(results_file(run_dir, analysis)) if name.startswith(PREFIX) else None
        self._waiting: dict[int, int | None] = {}

    @property
    def mean(self) -> Estimated:
        """The mean over all shots."""
        return self.total.mean(is_rate=self.quantity.is_rate)

    def add(self, shot: Shot, point: int | None) -> None:
        """Add a shot that was taken at a point of the scan; None without one."""
        if self._results is not None:
            self._waiting[shot.index] = point
        else:
            self._add(*self.quantity.events(shot), point)

    def look(self) -> None:
        """Add the results of analyses that have come since the last call.

        Raises:
            RecordingError: They cannot be read.
        """
        if self._results is None or not self._waiting:
            return
        self._results.read()
        for index in [index for index in self._waiting if index in self._results.rows]:
            point, value = self._waiting.pop(index), self._results.rows[index].get(self._key)
            if isinstance(value, bool | int | float):
                self._add(float(value), 1.0, point)

    def _add(self, n: float, n_trials: float, point: int | None) -> None:
        if not n_trials or math.isnan(n):
            return
        # a rate adds up its trials, any other quantity has one value in each shot
        sums = Sums(1, n, n_trials, (n / n_trials) ** 2)
        self.total += sums
        self.at_points[point] += sums
