"""Where the shots of a run are taken: at points known in advance, or at those that a scanner chooses."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from labseq.assembly.points import Point
from labseq.assembly.policies import missing_quantity
from labseq.assembly.search import TO_OPTIMISE, Search
from labseq.data import Run, Shot
from labseq.data.columns import quantities_in
from labseq.data.quantities import make_quantity
from labseq.data.shot import caching_loader
from labseq.errors import DeviceError
from labseq.model import VisitedPoint
from labseq.recording.index import IndexRow
from labseq.recording.results import PREFIX

if TYPE_CHECKING:
    from labseq.assembly.assemble import Assembly
    from labseq.session.prepared import PreparedRun


class History:
    """The shots of a run: those that were taken or given up, and those still to take.

    Args:
        run: The run before it was resumed; None for a new one.
        done: Its shots that are not taken again.

    Attributes:
        point_of_shot: Number of the point of each shot of the run.
        to_take: Shots still to take, in order.
        last: The shot added last; None before the first one of this process.
        shots: Number of a point -> index of a shot -> the shots taken there that count; of an adaptive scan.
        given_up: Number of a point -> a shot that was given up there; likewise.
    """

    def __init__(
        self, assembly: Assembly, seed: int, run: Run | None = None, done: Collection[int] = ()
    ) -> None:
        self.point_of_shot = assembly.point_of_shot(seed)
        self.to_take = [shot for shot in range(len(self.point_of_shot)) if shot not in done]
        self.last: int | None = None
        self.shots = defaultdict[int, dict[int, Shot]](dict)
        self.given_up: dict[int, IndexRow] = {}
        self._is_scan, self._is_search = assembly.scanned is not None, assembly.search is not None
        self._load = caching_loader()
        if run is not None and self._is_search:
            for shot in run.shots:
                self.shots[self.point_of_shot[shot.index]][shot.index] = shot
            skipped = (attempt for attempt in run.attempts if attempt.index in run.skipped)
            self.given_up = {self.point_of_shot[attempt.index]: attempt.row for attempt in skipped}

    @property
    def next_number(self) -> int | None:
        """Number of the point of the next shot; None if no shot is left."""
        return self.point_of_shot[self.to_take[0]] if self.to_take else None

    def add(self, run_dir: Path, row: IndexRow) -> None:
        """Add the next shot, which was taken or given up."""
        self.last = row.shot
        self.to_take.remove(row.shot)
        if not self._is_search:  # nothing depends on the lines; those of a long run would fill the memory
            return
        number = self.point_of_shot[row.shot]
        if row.counts:
            self.shots[number][row.shot] = Shot(run_dir, row, self._load)
        else:
            self.given_up[number] = row

    def skip(self, shots: Sequence[int]) -> None:
        """Do not take these shots."""
        skipped = {*shots}
        self.to_take = [shot for shot in self.to_take if shot not in skipped]

    def later_at_its_point(self, shot: int) -> list[int]:
        """Shots still to take at the point of a shot; none without a scan, where each shot is separate."""
        number = self.point_of_shot[shot]
        is_there = (later for later in self.to_take if later > shot and self.point_of_shot[later] == number)
        return [*is_there] if self._is_scan else []


class Points(Protocol):
    """Says where the shots of a run are taken."""

    def next(self, history: History) -> Point | None:
        """The point of the next shot, the same object for following shots of a point; None to end the run.

        Raises:
            DeviceError: A scanner failed.
            StopRequested: The operator asked to stop.
        """
        ...

    def known(self, history: History) -> Mapping[int, Point]:
        """The points that can be checked before the run: number -> point."""
        ...


class ListedPoints:
    """Points that are known in advance; without a scan, the settings of the files."""

    def __init__(self, assembly: Assembly) -> None:
        self._at = cache(assembly.at)  # the same object for the same point, so that nothing is built again

    def next(self, history: History) -> Point | None:
        """The point of the next shot; None after the last one."""
        return None if history.next_number is None else self._at(history.next_number)

    def known(self, history: History) -> Mapping[int, Point]:
        """The points of the run."""
        return {number: self._at(number) for number in dict.fromkeys(history.point_of_shot)}


class SearchedPoints:
    """Points that a scanner chooses by the results of those before.

    Its choice depends only on the shots on disk: a resumed run continues as the original would have, and a
    shot that is repeated is taken at its old point.

    Args:
        run: The run; receives the result of each point.
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
        self._has_warned = self._quantity.name.startswith(PREFIX)  # the analyses warn of missing results

    def next(self, history: History) -> Point | None:
        """The point of the next shot; the scanner is asked when all shots of the one before are there."""
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
        """The point of the first shot to take, and the corners of the ranges; numbered from 1."""
        corners, first = self._search.corners, self.next(history)
        points = [corners.at(n) for n in range(math.prod(corners.scan.shape))]
        return dict(enumerate(points if first is None else [first, *points], start=1))

    def _choose(self, history: History, number: int | None) -> dict[str, float] | None:
        """Ask the scanner; None if it has finished, or if no shot is left."""
        if number is None:
            return None
        visited = [one for one in self._first(history, number) if one.values]
        values = self._search.choose(self._scanner, visited, self._run.stop_flag)
        if values is None and number == 0:
            raise DeviceError(self._search.name, "next_point() gave no point at all; expected a first one")
        if values is None and history.last is not None:
            ended = {"scanner": self._search.name, "n_shots": history.to_take[0]}
            self._run.observers.event("scan_ended", ended)
        return values

    def _report(self, history: History, number: int) -> None:
        """Report the score of a point whose shots have all been taken, and the best one so far."""
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
        """The values of a point; None if no shot was attempted there."""
        if number is None:
            return None
        rows = [shot.row for shot in history.shots[number].values()]
        row = rows[0] if rows else history.given_up.get(number)
        return None if row is None else self._search.values_in(row.parameters)

    def _warn_if_missing(self, shot: Shot | None) -> None:
        """Warn once if a shot does not have the quantity: its name may be misspelt."""
        if shot is not None and not self._has_warned and math.isnan(self._quantity.of_shot(shot)):
            self._has_warned = True
            present = quantities_in(shot.row)
            self._run.warn(missing_quantity(shot.index, self._quantity.name, TO_OPTIMISE, present))

    def _first(self, history: History, n_points: int) -> list[VisitedPoint]:
        """The results of the first points, whose shots have all been taken or skipped; worked out once."""
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
