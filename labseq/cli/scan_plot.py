"""A running scan as a small plot of text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, cast

from rich.text import Text

from labseq.cli.glyphs import Glyphs
from labseq.model import ShotRecord
from labseq.recording.chosen_points import SCANNER, ChosenPoints

MIN_WIDTH: Final = 16
MIN_HEIGHT: Final = 4
"""Lines that a plot takes at least, its title and the line below it included."""
BAR: Final = 5
"""Most characters that the bar of a point is wide."""
LABEL: Final = 7
"""Characters of the numbers on the left."""
FILLING_RANGE: Final = 0.01
"""Least range of filling that is shown."""


@dataclass(slots=True)
class PointTally:
    """Shots of a point of a scan.

    Attributes:
        n_shots: How many are complete and have been judged.
        n_defect_free: How many of them met the target.
        filling: Sum of their filling fractions.
    """

    n_shots: int = 0
    n_defect_free: int = 0
    filling: float = 0.0

    def __iadd__(self, other: PointTally) -> PointTally:
        self.n_shots += other.n_shots
        self.n_defect_free += other.n_defect_free
        self.filling += other.filling
        return self


@dataclass(slots=True)
class ScanTally:
    """The points of a scan, while it goes on.

    Attributes:
        scan: What the run's record says of it.
    """

    scan: Mapping[str, Any]
    _points: dict[int, PointTally] = field(default_factory=dict[int, PointTally])
    _chosen: ChosenPoints | None = None

    def __post_init__(self) -> None:
        if SCANNER in self.scan:
            self._chosen = ChosenPoints(self.scan)

    def add(self, shot: ShotRecord) -> None:
        """Count a shot; one that was not judged, or of a point that is not known, does not count."""
        number = self._number(shot)
        if number is None or math.isnan(shot.filling_fraction):
            return
        point = self._points.setdefault(number, PointTally())
        point += PointTally(1, int(shot.success), shot.filling_fraction)

    def _number(self, shot: ShotRecord) -> int | None:
        if self._chosen is not None:
            try:
                return self._chosen.number(shot.parameters)
            except KeyError:  # `labseq watch` on a damaged index
                return None
        of_shot: Sequence[int] = self.scan.get("point_of_shot", ())
        return of_shot[shot.shot_index] if 0 <= shot.shot_index < len(of_shot) else None

    @property
    def name(self) -> str:
        """What is scanned."""
        addresses = cast("Sequence[str]", self.scan.get("addresses", ()))
        return ", ".join(addresses)

    def points(self) -> list[tuple[str, PointTally]]:
        """Each point as it is written, with its shots; by value where one number is scanned."""
        told = self._chosen
        written: Sequence[Sequence[str]] = self.scan.get("written", ()) if told is None else told.written
        values: Sequence[Sequence[Any]] = self.scan.get("points", ()) if told is None else told.points
        order = list(range(len(written)))
        if all(len(value) == 1 and isinstance(value[0], float | int) for value in values):
            order.sort(key=lambda i: values[i][0])
        return [(", ".join(written[i]), self._points.get(i, PointTally())) for i in order]


def draw_scan(tally: ScanTally, width: int, height: int, glyphs: Glyphs) -> list[Text]:
    """Draw the share of defect-free shots at each point; the filling, as long as there are none.

    Args:
        tally: The scan.
        width: Characters per line.
        height: Lines, title and words below included.
        glyphs: The characters to draw with.

    Returns:
        Nothing if there is no room, or no shot yet.
    """
    points = tally.points()
    shown = _merged([point for _, point in points], width - LABEL)
    taken = [point for point in shown if point.n_shots]
    if not taken or width < MIN_WIDTH or height < MIN_HEIGHT:
        return []
    is_rate = any(point.n_defect_free for point in taken)
    values = [_value(point, is_rate=is_rate) for point in shown]
    known = [value for value in values if value is not None]
    high = max(known)
    low = 0.0 if is_rate else min(*known, high - FILLING_RANGE)
    bar = max(1, min(BAR, (width - LABEL) // len(shown)))
    rows = _bars(values, low, high, height - 2, bar, glyphs)
    ends = [f"{100 * end:.3g} %".rjust(LABEL - 1) + " " for end in (high, low)]
    margins = [ends[0], *[" " * LABEL] * (len(rows) - 2), ends[1]]
    what = "defect-free" if is_rate else "filling"
    lines = [Text(f"{what} by {tally.name}", "bold")]
    lines += [
        Text.assemble((margin, "dim"), (row, "cyan")) for margin, row in zip(margins, rows, strict=True)
    ]
    return [*lines, Text(" " * LABEL + _words([word for word, _ in points], bar * len(shown)), "dim")]


def _merged(points: Sequence[PointTally], room: int) -> list[PointTally]:
    """As many points as there is room for: neighbours are taken together if there are more."""
    n = min(len(points), max(1, room))
    cuts = [round(i * len(points) / n) for i in range(n + 1)] if n else []
    merged: list[PointTally] = []
    for first, end in pairwise(cuts):
        total = PointTally()
        for point in points[first:end]:
            total += point
        merged.append(total)
    return merged


def _value(point: PointTally, *, is_rate: bool) -> float | None:
    if not point.n_shots:
        return None
    return (point.n_defect_free if is_rate else point.filling) / point.n_shots


def _bars(
    values: Sequence[float | None], low: float, high: float, height: int, bar: int, glyphs: Glyphs
) -> list[str]:
    """Columns, a line of text per row, the highest first; the least value is still a thin line."""
    steps = len(glyphs.levels)
    full = height * steps
    filled = [0 if v is None else max(1, round((v - low) / (high - low) * full)) for v in values]
    gap = " " if bar > 1 else ""
    rows: list[str] = []
    for row in reversed(range(height)):
        cells = (min(steps, max(0, n - row * steps)) for n in filled)
        rows.append("".join((" " if not n else glyphs.levels[n - 1]) * (bar - len(gap)) + gap for n in cells))
    return rows


def _words(words: Sequence[str], width: int) -> str:
    """The first and the last value below the ends of the plot, as far as there is room."""
    first, last = words[0], words[-1]
    if len(words) == 1 or len(first) + len(last) + 1 > width:
        return first if len(words) == 1 else f"{first} to {last}"
    return first + last.rjust(width - len(first))
