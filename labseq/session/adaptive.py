"""The points of an adaptive scan, which its scanner chooses by the results of earlier points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from labseq.assembly.point import Point
from labseq.assembly.quantities import missing_quantity
from labseq.assembly.search import TO_OPTIMISE, Search
from labseq.data.columns import quantities_in
from labseq.data.quantities import make_quantity
from labseq.data.shot import Shot
from labseq.errors import DeviceError
from labseq.model import VisitedPoint
from labseq.recording.folders import RESULT_PREFIX

if TYPE_CHECKING:
    from labseq.session.prepared import History, PreparedRun


class SearchedPoints:
    """Points that a scanner chooses by the results of earlier points.

    Its choice depends only on the shots on disk. A resumed run continues as the original would have, and a
    repeated shot is taken at its old point.

    Args:
        run: The run, which receives the result of each point.
        search: The scanner, and its ranges.
    """

    def __init__(self, run: PreparedRun, search: Search) -> None:
        self._run = run
        self._search = search
        self._scanner = search.make_scanner(run.seed)
        choice, results = search.scan.choice, run.analyses.values
        self._quantity = make_quantity(choice.quantity, run.assembly.target, results)
        self._sign = 1.0 if choice.minimise is None else -1.0
        self._current: tuple[int | None, Point | None] = -1, None
        self._visited: list[VisitedPoint] = []
        # the analyses warn of missing results
        self._has_warned = self._quantity.name.startswith(RESULT_PREFIX)

    def next(self, history: History) -> Point | None:
        """The point of the next shot. The scanner is asked once all shots of the previous point are done."""
        number, last = history.next_number, history.last
        if last is not None:
            self._warn_if_missing(history.shots[history.point_of_shot[last]].get(last))
        if self._current[0] != number:
            if last is not None:
                self._report(history, history.point_of_shot[last])
            values = self._values(history, number) or self._choose(history, number)
            self._current = number, None if values is None else self._search.at(values)
        return self._current[1]

    def known(self, history: History) -> Mapping[int, Point]:
        """The point of the first shot to take, and the corners of the ranges, numbered from 1."""
        corners, first = self._search.corners, self.next(history)
        points = [corners.at(n) for n in range(math.prod(corners.scan.shape))]
        return dict(enumerate(points if first is None else [first, *points], start=1))

    def _choose(self, history: History, number: int | None) -> dict[str, float] | None:
        """Ask the scanner. None if it has finished, or if no shot is left."""
        if number is None:
            return None
        visited = [one for one in self._first(history, number) if one.values]
        values = self._search.choose(self._scanner, visited, self._run.stop_flag)
        if values is None and number == 0:
            raise DeviceError(self._search.name, "next_point() gave no point at all; expected a first point")
        if values is None and history.last is not None:
            ended = {"scanner": self._search.name, "n_shots": history.to_take[0]}
            self._run.observers.event("scan_ended", ended)
        return values

    def _report(self, history: History, number: int) -> None:
        """Report the score of a point whose shots have all been taken, and the best point so far."""
        visited = self._first(history, number + 1)
        scores: dict[tuple[float, ...], tuple[int, list[float]]] = {}
        for place, one in enumerate(visited):  # a point that is visited again has the mean score
            if not math.isnan(one.score):
                scores.setdefault((*one.values.values(),), (place, []))[1].append(one.score)

        def plain(place: int, score: float) -> dict[str, Any]:
            value = None if math.isnan(score) else self._sign * score
            return {"point": place, "written": self._search.written(visited[place].values), "value": value}

        means = [(sum(own) / len(own), -first) for first, own in scores.values()]
        mean, first = max(means, default=(math.nan, 0))
        best = plain(-first, mean) if means else None
        about = {"figure": self._quantity.name, **plain(number, visited[number].score), "best": best}
        self._run.observers.event("scan_point", about)

    def _values(self, history: History, number: int | None) -> dict[str, float] | None:
        """The values of a point. None if no shot was attempted there."""
        if number is None:
            return None
        rows = [shot.row for shot in history.shots[number].values()]
        row = rows[0] if rows else history.given_up.get(number)
        return None if row is None else self._search.values_in(row.parameters)

    def _warn_if_missing(self, shot: Shot | None) -> None:
        """Warn once if a shot does not have the quantity, because its name may be misspelt."""
        if shot is not None and not self._has_warned and math.isnan(self._quantity.of_shot(shot)):
            self._has_warned = True
            present = quantities_in(shot.row)
            self._run.warn(missing_quantity(shot.index, self._quantity.name, TO_OPTIMISE, present))

    def _first(self, history: History, n_points: int) -> list[VisitedPoint]:
        """The results of the first points, whose shots have all been taken or skipped. Computed once."""
        for number in range(len(self._visited), n_points):
            self._visited.append(self._visit(history, number))
        return self._visited[:n_points]

    def _visit(self, history: History, number: int) -> VisitedPoint:
        shots = [shot for _, shot in sorted(history.shots[number].items())]
        name = self._quantity.name
        self._run.analyses.await_shots(name, [shot.index for shot in shots])
        quantities: list[Mapping[str, float]] = []
        for shot in shots:
            value = self._quantity.of_shot(shot)
            own = {} if math.isnan(value) else {name: value}
            quantities.append(MappingProxyType(quantities_in(shot.row) | own))
        score = self._sign * self._quantity.over(shots).value
        return VisitedPoint(MappingProxyType(self._values(history, number) or {}), score, tuple(quantities))
