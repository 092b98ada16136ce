"""What came of the points of an adaptive scan, as the run's index tells it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from labseq.model import VisitedPoint
from labseq.recording import Shot
from labseq.recording.columns import figures_of
from labseq.recording.plain import dumps
from labseq.session.adaptive import CLIMBED, Search
from labseq.session.figure_names import missing_figure


@dataclass(slots=True)
class PointScore:
    """How a point stands.

    Attributes:
        first: Its first visit.
        values: Address -> value, SI.
        total: Sum of the scores of its visits.
        n_scores: How many of them have one.
    """

    first: int
    values: Mapping[str, Any]
    total: float = 0.0
    n_scores: int = 0

    @property
    def mean(self) -> float:
        """Its mean score."""
        return self.total / self.n_scores


@dataclass(slots=True, eq=False)
class Results:
    """What came of the points of an adaptive scan.

    Attributes:
        search: What chooses the points.
        shots: The shots that count: index -> shot.
    """

    search: Search
    shots: dict[int, Shot]
    _visited: list[VisitedPoint] = field(default_factory=list[VisitedPoint])
    _given_up: dict[int, dict[str, float]] = field(default_factory=dict[int, dict[str, float]])
    _point_scores: dict[str, PointScore] = field(default_factory=dict[str, PointScore])
    _n_counted: int = 0
    _warned: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether no shot has been tried."""
        return not (self.shots or self._given_up)

    def add(self, shot: Shot) -> None:
        """Take in one more."""
        self.shots[shot.index] = shot

    def give_up(self, shot: int, parameters: Mapping[str, Any]) -> None:
        """Remember the point of a shot that was given up: the scanner is told that nothing came of it."""
        visit = shot // self.search.scanned.scan.repeats
        self._given_up[visit] = self._values_in(parameters)

    def values(self, visit: int) -> dict[str, float] | None:
        """The values of a point of which a shot was tried; None if none was."""
        shots = self._shots_of(visit)
        return self._values_in(shots[0].row["parameters"]) if shots else self._given_up.get(visit)

    def _values_in(self, parameters: Mapping[str, Any]) -> dict[str, float]:
        return {one.address: parameters[one.address] for one in self.search.ranges}

    def before(self, visit: int) -> list[VisitedPoint]:
        """What came of the points before one: those of which a shot was tried."""
        while len(self._visited) < visit:
            self._visited.append(self._visit(len(self._visited)))
        return [one for one in self._visited[:visit] if one.values]

    def missing_figure(self, shot: int) -> str:
        """What to say, once, of a shot that has not what the scan climbs on; "" if it has."""
        figure, figures = self.search.adaptive.figure, figures_of(self.shots[shot])
        if self._warned or figure in figures:
            return ""
        self._warned = True
        return missing_figure(shot, figure, CLIMBED, figures)

    def told(self, visit: int) -> dict[str, Any]:
        """A point and the best one so far, JSON-ready, for the run's events."""
        own = self._visit(visit)
        sign = 1.0 if self.search.adaptive.maximise else -1.0

        def plain(number: int, values: Mapping[str, Any], score: float) -> dict[str, Any]:
            value = None if math.isnan(score) else sign * score
            return {"point": number, "written": self.search.told(values), "value": value}

        while self._n_counted <= visit:
            self._count(self._n_counted)
        known = [one for one in self._point_scores.values() if one.n_scores]
        best = max(known, key=lambda one: (one.mean, -one.first), default=None)
        return {
            "figure": self.search.adaptive.figure,
            **plain(visit, own.values, own.score),
            "best": None if best is None else plain(best.first, best.values, best.mean),
        }

    def _count(self, visit: int) -> None:
        """Add a visit to those of its point: all of them count together."""
        one = self._visit(visit)
        standing = self._point_scores.setdefault(dumps(dict(one.values)), PointScore(visit, one.values))
        if not math.isnan(one.score):
            standing.total += one.score
            standing.n_scores += 1
        self._n_counted += 1

    def _shots_of(self, visit: int) -> list[Shot]:
        repeats = self.search.scanned.scan.repeats
        indices = range(visit * repeats, (visit + 1) * repeats)
        return [self.shots[index] for index in indices if index in self.shots]

    def _visit(self, visit: int) -> VisitedPoint:
        figures = [MappingProxyType(figures_of(shot)) for shot in self._shots_of(visit)]
        name, sign = self.search.adaptive.figure, 1.0 if self.search.adaptive.maximise else -1.0
        known = [sign * one[name] for one in figures if name in one]
        score = math.fsum(known) / len(known) if known else math.nan
        return VisitedPoint(MappingProxyType(self.values(visit) or {}), score, tuple(figures))
