"""The points of a scan: the scanned values, and the statistics at each point."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from labseq.analysis.statistics import CycleStatistics, Statistics, statistics_of
from labseq.messages import clean
from labseq.model.estimate import Estimated
from labseq.recording import Run
from labseq.recording.points import scan_points

GEOMETRIC_RATIO: Final = 20.0
"""Minimum ratio of largest to smallest value for a logarithmic axis."""
EQUAL: Final = 0.25
"""Maximum relative difference of ratios that count as equal, as those of "1, 2, 5, 10" do."""

_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\Z")
_MICRO: Final = re.compile(r"\bu(?=[msVWK]\b)")


@dataclass(frozen=True, slots=True)
class Axis:
    """A scanned address and its values.

    Attributes:
        address: The address, and those that change together with it.
        words: Its different values as written, in the order of the scan.
    """

    address: str
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a scan.

    Attributes:
        axes: Independent addresses, the slowest first.
        places: Index of each point's value on each axis.
        statistics: Statistics of each point.
    """

    axes: tuple[Axis, ...]
    places: tuple[tuple[int, ...], ...]
    statistics: tuple[Statistics, ...]

    def means(self, mean_of: Callable[[Statistics | CycleStatistics], Estimated]) -> list[Estimated]:
        """A mean at each point; if no shot is judged, over the images at the end of the last cycles."""
        judged = any(one.defect_free.n_trials for one in self.statistics)
        of = [one if judged or not one.cycles else one.cycles[-1] for one in self.statistics]
        return [mean_of(one) for one in of]


def scanned(run: Run) -> Scanned | None:
    """The points of a run's scan that have shots; None without a scan.

    Raises:
        RecordingError: The scan in run.json is damaged.
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
    """Whether the values of an address change together with those of another, and not by chance.

    No two points of an optimiser share a value; numbers must then rise or fall together.
    """
    if len({*zip(values, others, strict=True)}) > len({*others}):
        return False
    numbers, along = numbers_of(values), numbers_of(others)
    if len({*others}) < len(others) or numbers is None or along is None:
        return True
    steps = np.diff(np.array(numbers[0])[np.argsort(along[0], kind="stable")])
    return bool((steps >= 0).all() or (steps <= 0).all())


def numbers_of(words: Sequence[str]) -> tuple[list[float], str] | None:
    """Values as numbers and their common unit; None if they are not numbers of one unit."""
    found = [match for word in words if (match := _NUMBER.match(word.strip()))]
    units = {match[2] for match in found}
    if len(found) < len(words) or len(units) != 1:
        return None
    return [float(match[1]) for match in found], _MICRO.sub("µ", units.pop())


def is_geometric(values: Sequence[float]) -> bool:
    """Whether rising values have nearly equal ratios, over a wide range."""
    if len(values) < 3 or values[0] <= 0 or values[-1] < GEOMETRIC_RATIO * values[0]:
        return False
    steps = np.diff(np.log(values))
    return float(np.ptp(steps)) <= 2 * EQUAL * float(steps.mean())
