"""Takes the shots of a run: the points of its scan are known in advance, or chosen one by one."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from labseq.assembly.lab import rebuild_lab
from labseq.assembly.points import Point
from labseq.assembly.policies import missing_quantity
from labseq.assembly.search import CLIMBED, ScannerCall, Search
from labseq.config.scan import Scan
from labseq.data import Run, Shot
from labseq.data.columns import quantities_in
from labseq.data.quantities import make_quantity
from labseq.data.shot import caching_loader
from labseq.errors import DeviceError
from labseq.guard import StopFlag
from labseq.model import RunRecord, VisitedPoint
from labseq.plain import dumps
from labseq.recording import RunWriter
from labseq.recording.results import PREFIX
from labseq.roles import RunObserver
from labseq.sequencer.lab import Lab
from labseq.sequencer.leader import Emit
from labseq.sequencer.policies import RunPolicy
from labseq.sequencer.run import Sequencer, ShotSink
from labseq.session.analysis_processes import AnalysisProcesses
from labseq.session.checks import Checks
from labseq.session.stopping import check_stop_file
from labseq.watchdog import Watchdog

if TYPE_CHECKING:
    from labseq.assembly.assemble import Assembly


class ShotTaker:
    """Takes the shots, each at its point.

    Args:
        lab: The devices, not open, at the point of the first shot.
        point: That point.
        record: The record of the run.
        policy: Reactions to failures and exceeded budgets.
        stop: The request to stop.
        sink: Receives the shots.
        observer: Receives the events.
        watchdog: Switches the outputs off if this process dies or hangs.

    Attributes:
        sequencer: Runs the shots; the caller opens it and shuts it down.
    """

    def __init__(
        self,
        lab: Lab,
        point: Point,
        record: RunRecord,
        policy: RunPolicy,
        stop: StopFlag,
        sink: ShotSink,
        observer: RunObserver,
        watchdog: Watchdog,
    ) -> None:
        self._point = point
        self._seed = record.seed
        self._changes = {address: change["value"] for address, change in record.overrides.items()}
        self.sequencer = Sequencer(
            lab,
            point.steps,
            stop,
            sink,
            observer,
            seed=record.seed,
            policy=policy,
            parameters={**self._changes, **point.parameters},
            watchdog=watchdog,
        )

    def take(self, shot: int, point: Point) -> str:
        """Take and record a shot.

        Returns:
            Why it failed for good, or "".

        Raises:
            LabseqError: The error that ends the run.
        """
        if point is not self._point:
            lab, reopened = rebuild_lab(self.sequencer.lab, self._point, point, self._seed)
            self.sequencer.change(lab, point.steps, {**self._changes, **point.parameters}, reopened)
            self._point = point
        return self.sequencer.run([shot]).get(shot, "")


class KnownPoint(NamedTuple):
    """A point of a run that is known before its first shot.

    Attributes:
        number: Its number in the scan; of an adaptive scan, any number above 0.
        settings: The settings of its shots.
        n_shots: Shots of the run there; of an adaptive scan, as if all shots were taken there.
    """

    number: int
    settings: Point
    n_shots: int


class ScanRun:
    """The shots of a run whose points are known in advance; without a scan, all shots are at one point.

    Attributes:
        points: The point of each shot of the run.
        is_adaptive: Whether the points are chosen during the run.
    """

    is_adaptive = False
    scanner_name = ""

    def __init__(self, assembly: Assembly, seed: int, done: Collection[int] = ()) -> None:
        self.assembly = assembly
        n_shots, scanned = assembly.sequence.shots, assembly.scanned
        self._missing = [shot for shot in range(n_shots) if shot not in done]
        self.points = [0] * n_shots
        if scanned is not None:
            self.points = self._points_of_shots(scanned.scan, seed)[:n_shots]
        self._current: tuple[int, Point | None] = -1, None

    def _points_of_shots(self, scan: Scan, seed: int) -> list[int]:
        return scan.points_of_shots(seed).tolist()

    @cached_property
    def shots(self) -> list[int]:
        """Indices of the shots to take, in order."""
        return self._missing

    @property
    def n_points(self) -> int:
        """Number of points of the run; of an adaptive scan at most."""
        return len({*self.points})

    @property
    def first(self) -> Point:
        """The settings of the first shot to take."""
        point = self._point_of(self.shots[0])
        assert point is not None
        return point

    def known_points(self) -> list[KnownPoint]:
        """The points of the run; of an adaptive scan, the next one and the corners of the ranges."""
        return [KnownPoint(point, self.assembly.at(point), n) for point, n in Counter(self.points).items()]

    def known_labs(self) -> list[Point]:
        """One point for each combination of planner and profile; that of the first shot comes first."""
        found: dict[tuple[int, int], Point] = {}
        for point in (self.first, *(one.settings for one in self.known_points())):
            found.setdefault((id(point.planner), id(point.hardware)), point)
        return [*found.values()]

    def run(
        self, taker: ShotTaker, writer: RunWriter, checks: Checks, emit: Emit, after_shot: Callable[[], None]
    ) -> None:
        """Take all shots; an adaptive scan ends earlier if the scanner has finished.

        Args:
            taker: Takes each of them.
            checks: Checks each result; may end the run, or skip the other shots of a point.
            emit: Receives the events.
            after_shot: Called after each shot.

        Raises:
            StopRequested: Another process asked the run to end.
            CheckFailedError: A value is outside the limits of a check that stops the run.
            LabseqError: Another error that ended the run before its last shot.
        """
        skipped = set[int]()

        def skip(shots: Sequence[int], why: str) -> None:
            if shots:
                writer.skip(shots, why)
                which = f"shot {shots[0]} is" if len(shots) == 1 else f"{len(shots)} shots are"
                emit("warning", {"text": f"{which} skipped: {why}"})
                emit("shots_skipped", {"shots": [*shots], "why": why})
                skipped.update(shots)

        last, why = checks.left_open
        if why:  # an earlier process may have died before it could record what it skips
            skip(self._later_at_its_point(last), why)
        for shot in self.shots:
            if shot in skipped:
                continue
            check_stop_file(writer.run_dir)
            point = self._point_of(shot)
            if point is None:
                emit("scan_ended", {"scanner": self.scanner_name, "n_shots": shot})
                return
            given_up = taker.take(shot, point)
            after_shot()
            if warning := self._add_result(writer):
                emit("warning", {"text": warning})
            if why := given_up or checks.after(writer.last_row):
                skip([*([shot] if given_up else []), *self._later_at_its_point(shot)], why)
            if self.is_adaptive and skipped.issuperset(self._later_at_its_point(shot)):
                emit("scan_point", self._progress(shot))

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; empty without one.

        ``addresses``: the scanned addresses; ``points``: the values of each point, SI; ``written``: the
        same in the units of the sequence; ``point_of_shot``: the point of each shot, counted from 0.
        """
        scanned = self.assembly.scanned
        if scanned is None:
            return {}
        scan = scanned.scan
        points = range(scan.n_points)
        addresses = [axis.address for axis in scan.axes]
        at = [self.assembly.at(point).parameters for point in points]
        return {
            "addresses": addresses,
            "points": [[parameters[address] for address in addresses] for parameters in at],
            "written": [[str(node.raw or node.plain()) for _, node in scan.values(p)] for p in points],
            "repeats": scan.repeats,
            "order": scan.order,
            "point_of_shot": self.points,
        }

    def place_of(self, shot: int) -> int:
        """Index of the point of a shot."""
        return self.points[shot]

    def _settings(self, place: int) -> Point | None:
        """The settings of a point; None if the scanner has finished."""
        return self.assembly.at(place)

    def _point_of(self, shot: int) -> Point | None:
        """The settings of a shot; the same object for following shots of the same point."""
        place = self.place_of(shot)
        if self._current[0] != place:
            self._current = place, self._settings(place)
        return self._current[1]

    def _later_at_its_point(self, shot: int) -> list[int]:
        """Shots still to take at the point of a shot; none without a scan, where each shot is separate."""
        if self.assembly.scanned is None:
            return []
        place = self.place_of(shot)
        return [later for later in self.shots if later > shot and self.place_of(later) == place]

    def _add_result(self, writer: RunWriter) -> str:  # noqa: ARG002
        """Read the result of the last shot, if the next points depend on it; returns a warning, or ""."""
        return ""

    def _progress(self, shot: int) -> dict[str, Any]:  # noqa: ARG002
        """The result of the point of a shot, for the run's events; of an adaptive scan."""
        return {}


class AdaptiveScanRun(ScanRun):
    """The shots of an adaptive scan.

    The scanner's choice depends only on the shots on disk, their lines in the index: a resumed
    run continues as the original would have, and a shot that is repeated is taken at its old point.
    """

    is_adaptive = True

    def __init__(
        self,
        assembly: Assembly,
        search: Search,
        seed: int,
        stop: StopFlag,
        run: Run | None = None,
        done: Collection[int] = (),
        analyses: AnalysisProcesses | None = None,
    ) -> None:
        super().__init__(assembly, seed, done)
        self.scanner_name = search.name
        self._search = search
        self._scanner = ScannerCall(search, seed, stop)
        self._load = caching_loader()
        self._analyses = analyses
        results = analyses.values if analyses else None
        self._quantity = make_quantity(search.adaptive.quantity, assembly.target, results)
        self._sign = 1.0 if search.adaptive.maximise else -1.0
        self._has_warned = False
        self._visited: list[VisitedPoint] = []
        self._shots: dict[int, Shot] = {} if run is None else {shot.index: shot for shot in run.shots}
        self._skipped: dict[int, dict[str, float]] = {}  # the scanner receives these points without a score
        for attempt in () if run is None else run.attempts:
            if run is not None and attempt.index in run.skipped:
                self._skipped[self.place_of(attempt.index)] = self._values_in(attempt.row)

    def _points_of_shots(self, scan: Scan, seed: int) -> list[int]:  # noqa: ARG002
        return [shot // scan.repeats for shot in range(self.assembly.sequence.shots)]

    @cached_property
    def shots(self) -> list[int]:
        """Indices of the shots to take, at most; none if the scanner has finished."""
        if not self._missing or self._point_of(self._missing[0]) is not None:
            return self._missing
        if not (self._shots or self._skipped):
            raise DeviceError(self._search.name, "next_point() gave no point at all; expected a first one")
        return []

    @property
    def n_points(self) -> int:
        """The largest possible number of points."""
        return self._search.adaptive.n_points

    def known_points(self) -> list[KnownPoint]:
        """The point of the first shot to take, and the corners of the ranges."""
        corners = [self.assembly.at(n) for n in range(math.prod(self._search.scanned.scan.shape))]
        points = [self.first, *corners] if self.shots else corners
        return [KnownPoint(n, point, len(self.points)) for n, point in enumerate(points, start=1)]

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; see :meth:`Search.record`."""
        return self._search.record()

    def _settings(self, place: int) -> Point | None:
        values = self._values(place)
        if values is None:
            visited = [one for one in self._first(place) if one.values]
            values = self._scanner.choose(visited)
        return None if values is None else self._search.at(values)

    def _add_result(self, writer: RunWriter) -> str:
        row = writer.last_row
        if not row["counts"]:
            self._skipped[self.place_of(row["shot"])] = self._values_in(row)
            return ""
        shot = Shot(writer.run_dir / row["file"], json.loads(dumps(row)), self._load)
        self._shots[shot.index] = shot
        name = self._quantity.name
        if self._has_warned or name.startswith(PREFIX) or not math.isnan(self._quantity.of_shot(shot)):
            return ""
        self._has_warned = True
        return missing_quantity(shot.index, name, CLIMBED, quantities_in(shot.row))

    def _progress(self, shot: int) -> dict[str, Any]:
        """The score of the point of a shot and the best one so far, JSON-ready, for the run's events."""
        place = self.place_of(shot)
        visited = self._first(place + 1)
        scores: dict[tuple[float, ...], tuple[int, list[float]]] = {}
        for number, one in enumerate(visited):  # a point that is visited again has the mean score
            if not math.isnan(one.score):
                scores.setdefault((*one.values.values(),), (number, []))[1].append(one.score)

        def plain(number: int, score: float) -> dict[str, Any]:
            value = None if math.isnan(score) else self._sign * score
            return {"point": number, "written": self._search.written(visited[number].values), "value": value}

        means = [(sum(own) / len(own), -first) for first, own in scores.values()]
        mean, first = max(means, default=(math.nan, 0))
        return {
            "figure": self._quantity.name,
            **plain(place, visited[place].score),
            "best": plain(-first, mean) if means else None,
        }

    def _values(self, place: int) -> dict[str, float] | None:
        """The values of a point; None if no shot was attempted there."""
        shots = self._shots_at(place)
        return self._values_in(shots[0].row) if shots else self._skipped.get(place)

    def _values_in(self, row: Mapping[str, Any]) -> dict[str, float]:
        return {one.address: row["parameters"][one.address] for one in self._search.ranges}

    def _shots_at(self, place: int) -> list[Shot]:
        repeats = self._search.scanned.scan.repeats
        indices = range(place * repeats, (place + 1) * repeats)
        return [self._shots[index] for index in indices if index in self._shots]

    def _first(self, n_points: int) -> list[VisitedPoint]:
        """The results of the first points, whose shots have all been taken or skipped; worked out once."""
        for place in range(len(self._visited), n_points):
            self._visited.append(self._result(place))
        return self._visited[:n_points]

    def _result(self, place: int) -> VisitedPoint:
        shots, name = self._shots_at(place), self._quantity.name
        if self._analyses is not None:
            self._analyses.await_shots(name, [shot.index for shot in shots])
        quantities: list[Mapping[str, float]] = []
        for shot in shots:
            value = self._quantity.of_shot(shot)
            own = {} if math.isnan(value) else {name: value}
            quantities.append(MappingProxyType(quantities_in(shot.row) | own))
        score = self._sign * self._quantity.over(shots).value
        return VisitedPoint(MappingProxyType(self._values(place) or {}), score, tuple(quantities))


def scan_run_of(
    assembly: Assembly,
    seed: int,
    stop: StopFlag,
    run: Run | None = None,
    done: Collection[int] = (),
    analyses: AnalysisProcesses | None = None,
) -> ScanRun:
    """The shots of a run and their points."""
    if assembly.search is None:
        return ScanRun(assembly, seed, done)
    return AdaptiveScanRun(assembly, assembly.search, seed, stop, run, done, analyses)


def point_of(assembly: Assembly, shot: Shot, scan_run: ScanRun) -> Point:
    """The settings that a recorded shot was taken with.

    Args:
        assembly: The run, assembled from its own recorded files.
    """
    if assembly.search is None:
        return assembly.at(scan_run.points[shot.index])
    values = {one.address: shot.row["parameters"][one.address] for one in assembly.search.ranges}
    return assembly.search.at(values)
