"""Takes the shots of a run: the points of its scan are known in advance, or chosen one by one."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol, cast

from labseq.errors import DeviceError
from labseq.guard import Guard, StopFlag
from labseq.messages import clean
from labseq.model import ScanRange, VisitedPoint
from labseq.plain import dumps
from labseq.recording import Run, RunWriter, Shot
from labseq.recording.columns import quantities_in
from labseq.recording.quantities import Quantity, make_quantity
from labseq.recording.results import PREFIX
from labseq.recording.shot import caching_loader
from labseq.roles import Scanner
from labseq.sequencer.leader import Emit
from labseq.sequencer.run import Sequencer
from labseq.session.assembly import CLIMBED, Assembly, Search
from labseq.session.awaited import AwaitedResults
from labseq.session.chosen import construct_one
from labseq.session.lab import rebuild_lab
from labseq.session.policies import Checks, check_stop_file, missing_quantity
from labseq.session.scan import Point
from labseq.units import written


class ShotTaker(Protocol):
    """Takes the shots of a run one after the other."""

    def take(self, shot: int, point: Point, skipped: Collection[int]) -> Mapping[int, str]:
        """Take and record a shot.

        Args:
            skipped: Shots that will not be taken.

        Returns:
            The shot and why, if it failed for good.

        Raises:
            LabseqError: The error that ends the run.
        """
        ...


class OwnShots:
    """Takes the shots in this process.

    Args:
        sequencer: Open, at the point of the first shot.
        point: That point.
        changes: Address -> value of what differs from the files in every shot.
    """

    def __init__(self, sequencer: Sequencer, point: Point, changes: Mapping[str, Any], seed: int) -> None:
        self._sequencer = sequencer
        self._point = point
        self._changes = changes
        self._seed = seed

    def take(self, shot: int, point: Point, skipped: Collection[int] = ()) -> Mapping[int, str]:  # noqa: ARG002
        """See :class:`ShotTaker`."""
        if point is not self._point:
            lab, reopened = rebuild_lab(self._sequencer.lab, self._point, point, self._seed)
            self._sequencer.change(lab, point.steps, {**self._changes, **point.parameters}, reopened)
            self._point = point
        return self._sequencer.run([shot])


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
        self._seed = seed
        self._missing = [shot for shot in range(assembly.sequence.shots) if shot not in done]
        self._current: tuple[int, Point | None] = -1, None
        self.points = self._points_of_shots()

    def _points_of_shots(self) -> list[int]:
        n_shots, scanned = self.assembly.sequence.shots, self.assembly.scanned
        if scanned is None:
            return [0] * n_shots
        return [int(point) for point in scanned.scan.points_of_shots(self._seed)[:n_shots]]

    @cached_property
    def shots(self) -> list[int]:
        """Indices of the shots to take, in order."""
        return self._missing

    @property
    def n_points(self) -> int:
        """Number of points of the run."""
        return len({*self.points})

    @property
    def first(self) -> Point:
        """The settings of the first shot to take."""
        point = self._point_of(self.shots[0])
        assert point is not None
        return point

    def each(self) -> Iterator[Point]:
        """The settings of each point with a shot to take."""
        return map(self.assembly.at, dict.fromkeys(self.points[shot] for shot in self.shots))

    def representative_labs(self) -> Iterator[Point]:
        """One point for each combination of planner and profile; that of the first shot comes first."""
        seen: set[tuple[int, int]] = set()
        for point in self.each():
            key = id(point.planner), id(point.hardware)
            if key not in seen:
                seen.add(key)
                yield point

    def counted(self) -> list[tuple[Point, int]]:
        """Each point of the run, with the number of its shots."""
        return [(self.assembly.at(point), n) for point, n in Counter(self.points).items()]

    def run(self, taker: ShotTaker, writer: RunWriter, checks: Checks, emit: Emit) -> None:
        """Take all shots; an adaptive scan ends earlier if the scanner has finished.

        Args:
            taker: Takes each of them.
            checks: Checks each result; may end the run, or skip the other shots of a point.

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
            given_up = taker.take(shot, point, skipped)
            if warning := self._add_result(writer):
                emit("warning", {"text": warning})
            why = next(iter(given_up.values()), "") or checks.after(writer.last_row)
            if why:
                skip([*given_up, *self._later_at_its_point(shot)], why)
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
        awaited: AwaitedResults | None = None,
    ) -> None:
        self._search = search
        self.scanner_name = search.name
        super().__init__(assembly, seed, done)
        self._scanner = ScannerCall(search, seed, stop)
        self._results = Results(
            search,
            {} if run is None else {shot.index: shot for shot in run.shots},
            make_quantity(search.adaptive.quantity, assembly.target, awaited.values if awaited else None),
            awaited,
        )
        for attempt in () if run is None else run.attempts:
            if run is not None and attempt.index in run.skipped:
                self._results.add_skipped(attempt.index, attempt.row["parameters"])
        self._load = caching_loader()

    def _points_of_shots(self) -> list[int]:
        repeats = self._search.scanned.scan.repeats
        return [shot // repeats for shot in range(self.assembly.sequence.shots)]

    @cached_property
    def shots(self) -> list[int]:
        """Indices of the shots to take, at most; none if the scanner has finished."""
        if not self._missing or self._point_of(self._missing[0]) is not None:
            return self._missing
        if self._results.is_empty:
            raise DeviceError(self._search.name, "next_point() gave no point at all; expected a first one")
        return []

    @property
    def n_points(self) -> int:
        """The largest possible number of points."""
        return self._search.adaptive.n_points

    def each(self) -> Iterator[Point]:
        """The settings of the first shot to take, and of the corners of the ranges."""
        if self.shots:
            yield self.first
        yield from map(self.assembly.at, range(math.prod(self._search.scanned.scan.shape)))

    def representative_labs(self) -> Iterator[Point]:
        """The first point, and two opposite corners."""
        points = [*self.each()]
        yield from (*points[:2], points[-1])

    def counted(self) -> list[tuple[Point, int]]:
        """Each corner, as if all shots were taken there."""
        n_corners = math.prod(self._search.scanned.scan.shape)
        return [(self.assembly.at(corner), self.assembly.sequence.shots) for corner in range(n_corners)]

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; see :meth:`Search.record`."""
        return self._search.record()

    def _settings(self, place: int) -> Point | None:
        values = self._results.values(place)
        if values is None:
            values = self._scanner.choose(self._results.before(place))
        return None if values is None else self._search.at(values)

    def _add_result(self, writer: RunWriter) -> str:
        row = writer.last_row
        if not row["counts"]:
            self._results.add_skipped(row["shot"], row["parameters"])
            return ""
        shot = Shot(writer.run_dir / row["file"], json.loads(dumps(row)), self._load)
        self._results.shots[shot.index] = shot
        return self._results.missing_quantity(shot.index)

    def _progress(self, shot: int) -> dict[str, Any]:
        return self._results.progress(self.place_of(shot))


def scan_run_of(
    assembly: Assembly,
    seed: int,
    stop: StopFlag,
    run: Run | None = None,
    done: Collection[int] = (),
    awaited: AwaitedResults | None = None,
) -> ScanRun:
    """The shots of a run and their points."""
    if assembly.search is None:
        return ScanRun(assembly, seed, done)
    return AdaptiveScanRun(assembly, assembly.search, seed, stop, run, done, awaited)


def point_of(assembly: Assembly, shot: Shot, scan_run: ScanRun) -> Point:
    """The settings that a recorded shot was taken with.

    Args:
        assembly: The run, assembled from its own recorded files.
    """
    if assembly.search is None:
        return assembly.at(scan_run.points[shot.index])
    values = {one.address: shot.row["parameters"][one.address] for one in assembly.search.ranges}
    return assembly.search.at(values)


@dataclass(slots=True, eq=False)
class Results:
    """The results of the points of an adaptive scan.

    Attributes:
        search: The scanner and its ranges.
        shots: The shots that count: index -> shot.
        quantity: What is optimised.
        awaited: The results of analyses that this needs.
    """

    search: Search
    shots: dict[int, Shot]
    quantity: Quantity
    awaited: AwaitedResults | None = None
    _visited: dict[int, VisitedPoint] = field(default_factory=dict[int, VisitedPoint])
    _skipped: dict[int, dict[str, float]] = field(default_factory=dict[int, dict[str, float]])
    _scores: dict[str, tuple[int, list[float]]] = field(default_factory=dict[str, tuple[int, list[float]]])
    _n_counted: int = 0
    _warned: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether no shot has been taken."""
        return not (self.shots or self._skipped)

    def add_skipped(self, shot: int, parameters: Mapping[str, Any]) -> None:
        """Remember the point of a skipped shot: the scanner receives the point without a score."""
        visit = shot // self.search.scanned.scan.repeats
        self._skipped[visit] = self._values_in(parameters)

    def values(self, visit: int) -> dict[str, float] | None:
        """The values of a point; None if no shot was attempted there."""
        shots = self._shots_of(visit)
        return self._values_in(shots[0].row["parameters"]) if shots else self._skipped.get(visit)

    def _values_in(self, parameters: Mapping[str, Any]) -> dict[str, float]:
        return {one.address: parameters[one.address] for one in self.search.ranges}

    def before(self, visit: int) -> list[VisitedPoint]:
        """The results of all points before the given one, as the scanner receives them."""
        return [one for one in map(self._visit, range(visit)) if one.values]

    def missing_quantity(self, shot: int) -> str:
        """A warning, given once, that a shot lacks the quantity that the scan optimises; else ""."""
        name = self.quantity.name
        if self._warned or name.startswith(PREFIX) or not math.isnan(self.quantity.of_shot(self.shots[shot])):
            return ""
        self._warned = True
        return missing_quantity(shot, name, CLIMBED, quantities_in(self.shots[shot].row))

    def progress(self, visit: int) -> dict[str, Any]:
        """The score of a point and the best one so far, JSON-ready, for the run's events."""
        own = self._visit(visit)
        sign = 1.0 if self.search.adaptive.maximise else -1.0

        def plain(number: int, values: Mapping[str, Any], score: float) -> dict[str, Any]:
            value = None if math.isnan(score) else sign * score
            return {"point": number, "written": self.search.written(values), "value": value}

        for number in range(self._n_counted, visit + 1):  # a point that is visited again has the mean score
            one = self._visit(number)
            _, scores = self._scores.setdefault(dumps(dict(one.values)), (number, []))
            scores += [] if math.isnan(one.score) else [one.score]
        self._n_counted = max(self._n_counted, visit + 1)
        means = [(sum(scores) / len(scores), -first) for first, scores in self._scores.values() if scores]
        mean, first = max(means, default=(math.nan, 0))
        return {
            "figure": self.search.adaptive.quantity,
            **plain(visit, own.values, own.score),
            "best": plain(-first, self._visit(-first).values, mean) if means else None,
        }

    def _shots_of(self, visit: int) -> list[Shot]:
        repeats = self.search.scanned.scan.repeats
        indices = range(visit * repeats, (visit + 1) * repeats)
        return [self.shots[index] for index in indices if index in self.shots]

    def _visit(self, visit: int) -> VisitedPoint:
        """The result of a point whose shots have all been taken or skipped; worked out once."""
        if visit not in self._visited:
            self._visited[visit] = self._result(visit)
        return self._visited[visit]

    def _result(self, visit: int) -> VisitedPoint:
        shots, sign = self._shots_of(visit), 1.0 if self.search.adaptive.maximise else -1.0
        if self.awaited is not None:
            self.awaited.await_shots(self.quantity.name, [shot.index for shot in shots])
        quantities = [MappingProxyType(quantities_in(shot.row) | self._value(shot)) for shot in shots]
        score = sign * self.quantity.over(shots).value
        return VisitedPoint(MappingProxyType(self.values(visit) or {}), score, tuple(quantities))

    def _value(self, shot: Shot) -> dict[str, float]:
        value = self.quantity.of_shot(shot)
        return {} if math.isnan(value) else {self.quantity.name: value}


class ScannerCall:
    """Calls a scanner, with a timeout, and checks its answers.

    Raises:
        ConfigError: The scanner refuses its settings; with their place.
        PluginLoadError: Its constructor raised.
    """

    def __init__(self, search: Search, seed: int, stop: StopFlag) -> None:
        self._search = search
        self._stop = stop
        self._timeout_s = search.scanned.hardware.profile.timeouts.call
        self._scanner: Scanner = construct_one(search.chosen, search.space(seed))

    def choose(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The next point, address -> value; None if the scanner has finished.

        Raises:
            DeviceError: The scanner raised, or returned no point of its ranges; names the scanner.
            DeviceTimeoutError: It did not answer in time.
            StopRequested: The operator asked to stop.
        """
        guard = Guard(self._stop)
        try:
            return guard.call(self._search.name, self._timeout_s, self.next_point, tuple(visited))
        finally:
            guard.end()

    def next_point(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The scanner's answer, checked. Error messages of a guarded call name this function."""
        try:
            answer: Any = self._scanner.next_point(visited)
            given = dict(cast("Mapping[Any, Any]", answer)) if isinstance(answer, Mapping) else None
        except Exception as error:
            text = f"next_point() raised {type(error).__name__}"
            raise self._error(f"{text}: {error}" if str(error) else text) from error
        if answer is None:
            return None
        ranges = {one.address: one for one in self._search.ranges}
        if given is None or {*given} != {*ranges}:
            came = f"a {type(answer).__name__}" if given is None else f"values for {_names(given)}"
            raise self._error(f"next_point() gave {came}; expected a value for each of {_names(ranges)}")
        units = dict(zip(ranges, self._search.units, strict=True))
        return {address: self._value(one, given[address], units[address]) for address, one in ranges.items()}

    def _value(self, range_: ScanRange, value: object, unit: str) -> float:
        """A value snapped to its range, without rounding errors."""
        what = "a whole number" if range_.is_whole else "a number"
        expected = f"{what} from {written(range_.low, unit)} to {written(range_.high, unit)}"
        expected += f" on one of its {range_.n_steps} steps" if range_.n_steps else ""
        near = range_.allowed(value)
        if near is not None:
            return near
        came = f"{value:.12g} (SI)" if isinstance(value, float) and unit else clean(repr(value))
        raise self._error(f"next_point() gave {came} for '{range_.address}'; expected {expected}")

    def _error(self, text: str) -> DeviceError:
        return DeviceError(self._search.name, text)


def _names(addresses: Mapping[Any, Any]) -> str:
    return ", ".join(f"'{clean(str(address))}'" for address in addresses) or "no address"
