"""Steps from the best point so far along one address, and halves the step when none is left."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import inf, isnan
from statistics import mean
from typing import Annotated

from pydantic import Field

from labseq.plugin import ScanSpace, Settings, VisitedPoint

Part = Annotated[float, Field(ge=0.001, le=1)]


class ClimbSettings(Settings):
    """Lengths of the steps, as fractions of the range of each address."""

    step: Part = Field(default=0.25, description="first step, as a fraction of each range")
    min_step: Part = Field(default=0.05, description="shortest step, after which the scan ends")


class Climb:
    """Steps from the best point along one address, up or down, and halves the step if none is left."""

    def __init__(self, settings: ClimbSettings, space: ScanSpace) -> None:
        self._settings = settings
        self._ranges = space.ranges

    def next_point(self, visited: Sequence[VisitedPoint]) -> Mapping[str, float] | None:
        """The first unvisited neighbour of the best point. The scan starts at the point of the files."""
        if not visited:
            return {r.address: r.at(0.5 if isnan(r.start) else r.fraction(r.start)) for r in self._ranges}
        scores: dict[tuple[float, ...], list[float]] = defaultdict(list)
        for point in visited:
            scores[self._place(point.values)].append(-inf if isnan(point.score) else point.score)
        best = max(visited, key=lambda point: mean(scores[self._place(point.values)])).values
        step = self._settings.step
        while step >= self._settings.min_step:
            for r in self._ranges:
                for way in (step, -step):
                    point = {**best, r.address: r.at(r.fraction(best[r.address]) + way)}
                    if self._place(point) not in scores:
                        return point
            step /= 2
        return None

    def _place(self, values: Mapping[str, float]) -> tuple[float, ...]:
        """Position of a point in its ranges, 0 to 1, to four digits. No two points are nearer on purpose."""
        return tuple(round(r.fraction(values[r.address]), 4) for r in self._ranges)
