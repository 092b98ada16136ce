"""Filling and defect-free fraction of a run, as series and courses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from labseq.drawing import Series
from labseq.drawing.charts import TrendChart, CurvesChart
from labseq.model import TargetPattern
from labseq.model.estimate import Estimate, mean
from labseq.recording import Run, Shot
from labseq.recording.rates import Rate
from labseq.recording.statistics import CycleStatistics, Statistics

MeasureName = Literal["filling", "success"]

MIN_WINDOW: Final = 10
"""Least number of shots of a running mean."""
N_WINDOWS: Final = 10
"""So many of its windows a longer run holds."""
MAX_POINTS: Final = 200
"""Most points of its line."""


@dataclass(frozen=True, slots=True)
class Measure:
    """What is said of each shot, and its mean over shots.

    Attributes:
        name: "filling" or "success".
        title: What it is called in titles.
        label: What it is called beside an axis.
    """

    name: MeasureName
    title: str
    label: str

    @property
    def is_rate(self) -> bool:
        """Whether it is true or false of each shot."""
        return self.name == "success"

    def of_shot(self, shot: Shot, target: TargetPattern) -> float:
        """Of the image that the shot is judged on, else of the last one after a cycle; NaN without."""
        if not math.isnan(shot.filling_fraction):
            return float(shot.success) if self.is_rate else shot.filling_fraction
        images = shot.summary.images
        if not len(images) or not images.cycle[-1] or not target.n_atoms:
            return math.nan
        n_defects, n_surplus = images.n_defects[-1], images.n_surplus[-1]
        return float(not n_defects and not n_surplus) if self.is_rate else 1.0 - n_defects / target.n_atoms

    def of_many(self, statistics: Statistics | CycleStatistics) -> Estimate | Rate:
        """The mean over some shots."""
        return statistics.defect_free if self.is_rate else statistics.filling

    def over(self, values: Sequence[float]) -> Estimate | Rate:
        """The mean of some shots' values."""
        return Rate(round(math.fsum(values)), len(values)) if self.is_rate else mean(values)


FILLING: Final = Measure("filling", "filling", "filling (%)")
SUCCESS: Final = Measure("success", "defect-free", "defect-free (%)")


def course(run: Run, measure: Measure, values: Sequence[float]) -> TrendChart:
    """A measure against the shot.

    Args:
        run: The run.
        measure: What is shown.
        values: It for each shot of the run; at least one is known.
    """
    numbers = np.array([shot.index + 1.0 for shot in run.shots])
    known = np.isfinite(values)
    x, y = numbers[known], np.array(values)[known]
    window = min(len(y), max(MIN_WINDOW, len(y) // N_WINDOWS))
    starts = np.unique(np.linspace(0, len(y) - window, MAX_POINTS).astype(np.int64))
    means = [measure.over(y[start : start + window].tolist()) for start in starts]
    at = [float(x[start] + x[start + window - 1]) / 2 for start in starts]
    shots = "1 shot" if window == 1 else f"{window} shots"
    title = f"{measure.title} by shot; line: mean of {shots}"
    running = series_of("", at, means)
    return TrendChart(title, measure.label, x, y, running, is_rate=measure.is_rate)


def by_cycle(measure: Measure, statistics: Statistics) -> CurvesChart | None:
    """A measure against the cycle, each on the image that ended it; None without cycles."""
    cycles = statistics.cycles
    if not cycles:
        return None
    series = series_of("", [one.cycle for one in cycles], [measure.of_many(one) for one in cycles])
    ended = cycles[-1].n_shots < cycles[0].n_shots
    title = f"{measure.title} by cycle" + (", of the shots that made it" if ended else "")
    return CurvesChart(title, "cycle", measure.label, (series,), whole=True, from_zero=measure.is_rate)


def series_of(label: str, x: Iterable[float], values: Iterable[Estimate | Rate]) -> Series:
    """Means with their errors; those of nothing are left out.

    Args:
        label: What the key calls them.
        x: Where they stand.
        values: The means.
    """
    rows = [(at, *ends_of(value)) for at, value in zip(x, values, strict=True) if not math.isnan(value.value)]
    columns = np.array(rows, np.float64).reshape(-1, 4).T
    return Series(label, *(np.ascontiguousarray(column) for column in columns))


def ends_of(value: Estimate | Rate) -> tuple[float, float, float]:
    """A mean and the ends of its error of 1 sigma: standard error, or Jeffreys interval of a rate."""
    if isinstance(value, Rate):
        return value.value, *value.interval
    return value.value, value.value - value.error, value.value + value.error
