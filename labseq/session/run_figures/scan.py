"""Filling and defect-free fraction against what was scanned."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from labseq.config.wording import clean
from labseq.drawing.charts import CurvesChart, MapChart
from labseq.model.estimate import Estimate
from labseq.recording import Run
from labseq.recording.points import scan_points
from labseq.recording.rates import Rate
from labseq.recording.statistics import Statistics, statistics_of
from labseq.session.run_figures.measures import Measure, ends_of, series_of

MAX_MAPS: Final = 6
"""Most maps in a row."""
MIN_FULL: Final = 0.5
"""Part of the cells of all maps that must have a point; below that, points are drawn in their order."""
LOGARITHMIC: Final = 20.0
"""From this ratio of the largest value to the least on, values at equal ratios get a logarithmic axis."""
EQUAL: Final = 0.25
"""Relative difference of ratios that count as equal: "1, 2, 5, 10" does."""

_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\Z")
_MICRO: Final = re.compile(r"\bu(?=[msVWK]\b)")


@dataclass(frozen=True, slots=True)
class Axis:
    """A scanned address and its values.

    Attributes:
        address: The address, with those that go together with it.
        words: Its values as written, in the scan's order, each once.
    """

    address: str
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a scan.

    Attributes:
        axes: What was scanned: independent addresses, the first slowest.
        places: For each point the index of its value on each axis.
        statistics: For each point what came of its shots.
    """

    axes: tuple[Axis, ...]
    places: tuple[tuple[int, ...], ...]
    statistics: tuple[Statistics, ...]

    def means(self, measure: Measure) -> list[Estimate | Rate]:
        """A measure at each point; where no shot is judged, on the images that ended the last cycles."""
        judged = any(one.defect_free.n_trials for one in self.statistics)
        of = [one if judged or not one.cycles else one.cycles[-1] for one in self.statistics]
        return [measure.of_many(one) for one in of]


def scanned(run: Run) -> Scanned | None:
    """The points of a run's scan that have shots; None without a scan.

    Raises:
        RecordingError: What run.json says of the scan is damaged.
    """
    points = scan_points(run)
    if not points:
        return None
    rows = [tuple(map(clean, row)) for row in run.scan["written"]]
    columns = list(zip(*rows, strict=True))
    addresses = list(map(clean, points[0].written))
    varied = [i for i, column in enumerate(columns) if len({*column}) > 1] or [0]
    together: dict[int, list[str]] = {}
    for i in varied:
        leader = next((k for k in together if _follows(columns[i], columns[k])), i)
        together.setdefault(leader, []).append(addresses[i])
    axes = tuple(
        Axis(" with ".join(names), tuple(dict.fromkeys(columns[i]))) for i, names in together.items()
    )
    written = [tuple(map(clean, point.written.values())) for point in points]
    places = tuple(
        tuple(axis.words.index(row[i]) for axis, i in zip(axes, together, strict=True)) for row in written
    )
    return Scanned(axes, places, tuple(statistics_of(point.shots, run.target) for point in points))


def _follows(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether each of the others goes with one value only, and that not by chance.

    Of an optimiser's points no two share a value; so where none do, numbers must rise or fall together.
    """
    if len({*zip(values, others, strict=True)}) > len({*others}):
        return False
    numbers, along = _numbers(values), _numbers(others)
    if len({*others}) < len(others) or numbers is None or along is None:
        return True
    steps = np.diff(np.array(numbers[0])[np.argsort(along[0], kind="stable")])
    return bool((steps >= 0).all() or (steps <= 0).all())


def _numbers(words: Sequence[str]) -> tuple[list[float], str] | None:
    """Words as numbers and their unit; None if they are none, or of several units."""
    found = [match for word in words if (match := _NUMBER.match(word.strip()))]
    units = {match[2] for match in found}
    if len(found) < len(words) or len(units) != 1:
        return None
    return [float(match[1]) for match in found], _MICRO.sub("µ", units.pop())


def scan_charts(found: Scanned, measure: Measure) -> tuple[CurvesChart | MapChart, ...]:
    """A measure against what was scanned: a curve for one axis, maps for more.

    Args:
        found: The points.
        measure: What is shown.

    Returns:
        None of them if nothing is known at any point.
    """
    means = found.means(measure)
    if all(math.isnan(one.value) for one in means):
        return ()
    if len(found.axes) == 1:
        return (_curve(found.axes[0], [place[0] for place in found.places], means, measure),)
    n_cells = math.prod(len(axis.words) for axis in found.axes)
    if len({*found.places}) < MIN_FULL * n_cells:
        return (_in_order(found, means, measure),)
    return _maps(found, means, measure)


def _curve(
    axis: Axis, places: Sequence[int], means: Sequence[Estimate | Rate], measure: Measure
) -> CurvesChart:
    title = f"{measure.title} by scanned value"
    numbers = _numbers(axis.words)
    if numbers is None:
        series = series_of("", places, means)
        return CurvesChart(
            title, axis.address, measure.label, (series,), axis.words, from_zero=measure.is_rate
        )
    values, unit = numbers
    rows = sorted(zip((values[place] for place in places), means, strict=True), key=lambda row: row[0])
    series = series_of("", [x for x, _ in rows], [y for _, y in rows])
    x_label = f"{axis.address} ({unit})" if unit else axis.address
    return CurvesChart(
        title,
        x_label,
        measure.label,
        (series,),
        logarithmic=_is_geometric(sorted({*values})),
        from_zero=measure.is_rate,
    )


def _is_geometric(values: Sequence[float]) -> bool:
    if len(values) < 3 or values[0] <= 0 or values[-1] < LOGARITHMIC * values[0]:
        return False
    steps = np.diff(np.log(values))
    return float(np.ptp(steps)) <= 2 * EQUAL * float(steps.mean())


def _in_order(found: Scanned, means: Sequence[Estimate | Rate], measure: Measure) -> CurvesChart:
    """Points of which hardly two share a value, as those of an optimiser."""
    series = series_of("", range(1, len(means) + 1), means)
    title = f"{measure.title} by point of {len(found.axes)} values"
    return CurvesChart(
        title, "point of the scan", measure.label, (series,), whole=True, from_zero=measure.is_rate
    )


def _maps(found: Scanned, means: Sequence[Estimate | Rate], measure: Measure) -> tuple[MapChart, ...]:
    """A map against the last two axes for each combination of the others."""
    *others, y, x = found.axes
    values = np.full([len(axis.words) for axis in found.axes], np.nan)
    for place, one in zip(found.places, means, strict=True):
        values[place] = ends_of(one)[0]
    limits = float(np.nanmin(values)), float(np.nanmax(values))
    combinations = list(product(*(range(len(axis.words)) for axis in others)))
    charts: list[MapChart] = []
    for number, chosen in enumerate(combinations[:MAX_MAPS], start=1):
        at = ", ".join(f"{axis.address} {axis.words[i]}" for axis, i in zip(others, chosen, strict=True))
        more = f" ({number} of {len(combinations)})" if len(combinations) > MAX_MAPS else ""
        title = (at or f"{measure.title} by scanned values") + more
        charts.append(
            MapChart(title, x.address, y.address, x.words, y.words, values[chosen], measure.label, limits)
        )
    return tuple(charts)
