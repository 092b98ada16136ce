"""Takes the shots of a run: the points of its scan are known in advance, or chosen one by one."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from typing import Any

from labseq.errors import DeviceError
from labseq.guard import StopFlag
from labseq.plain import dumps
from labseq.recording import Run, RunWriter, Shot
from labseq.roles import RunObserver
from labseq.sequencer import Sequencer
from labseq.sequencer.lab import Lab
from labseq.session.adaptive import Results, ScannerCall, Search
from labseq.session.assembly import Assembly
from labseq.session.lab import rebuild_lab
from labseq.session.policies import ShotHooks
from labseq.session.scan import Point


class ScanRun:
    """The shots of a run whose points are known in advance; without a scan, all shots are at one point.

    Args:
        assembly: The run.
        seed: The run's seed.
        done: Shots that were taken before.

    Attributes:
        points: The point of each shot of the run.
        is_adaptive: Whether the points are chosen during the run.
    """

    is_adaptive = False

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
            key = id(point.planner), id(point.bench)
            if key not in seen:
                seen.add(key)
                yield point

    def counted(self) -> list[tuple[Point, int]]:
        """Each point of the run, with the number of its shots."""
        return [(self.assembly.at(point), n) for point, n in Counter(self.points).items()]

    def follow(self, writer: RunWriter, observer: RunObserver) -> None:
        """Connect the recorded results and the observer of events; called before :meth:`run`."""

    def run(self, sequencer: Sequencer, lab: Lab, changes: Mapping[str, Any], shot_hooks: ShotHooks) -> None:
        """Take all shots; an adaptive scan ends earlier if the scanner has finished.

        Args:
            sequencer: Open, at the point of the first shot.
            lab: The open devices.
            changes: Address -> value of what differs from the files in every shot.
            shot_hooks: Called between two shots; their exceptions end the run.

        Raises:
            LabseqError: The error that ended the run before its last shot.
        """
        before, skipped = self.first, set(self._skip_before(shot_hooks))
        for shot in self.shots:
            if shot in skipped:
                continue
            shot_hooks.before()
            point = self._point_of(shot)
            if point is None:
                self._scanner_ended(shot)
                return
            if point is not before:
                lab, reopened = rebuild_lab(lab, before, point, self._seed)
                sequencer.change(lab, point.steps, {**changes, **point.parameters}, reopened)
                before = point
            given_up = sequencer.run([shot])
            self._add_result(shot)
            skipped.update(self._skip(shot, given_up, shot_hooks))
            self._report_point(shot, skipped)

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

    def _place(self, shot: int) -> int:
        """Index of the point of a shot."""
        return self.points[shot]

    def _settings(self, place: int) -> Point | None:
        """The settings of a point; None if the scanner has finished."""
        return self.assembly.at(place)

    def _point_of(self, shot: int) -> Point | None:
        """The settings of a shot; the same object for following shots of the same point."""
        place = self._place(shot)
        if self._current[0] != place:
            self._current = place, self._settings(place)
        return self._current[1]

    def _later_at_its_point(self, shot: int) -> list[int]:
        """Shots still to take at the point of a shot; none without a scan, where each shot is separate."""
        if self.assembly.scanned is None:
            return []
        place = self._place(shot)
        return [later for later in self.shots if later > shot and self._place(later) == place]

    def _skip_before(self, shot_hooks: ShotHooks) -> list[int]:
        """Record the shots to skip if an earlier process died before it could record them."""
        shot, why = shot_hooks.left_open
        left = self._later_at_its_point(shot) if why else []
        shot_hooks.skip(left, why)
        return left

    def _skip(self, shot: int, given_up: Mapping[int, str], shot_hooks: ShotHooks) -> list[int]:
        """Record the shots to skip after a shot."""
        why = shot_hooks.after([*given_up.values()])
        left = [*given_up, *self._later_at_its_point(shot)] if why else []
        shot_hooks.skip(left, why)
        return left

    def _scanner_ended(self, shot: int) -> None:
        """Report that the scanner has finished; adaptive scans only."""

    def _add_result(self, shot: int) -> None:
        """Read the result of a shot; adaptive scans only."""

    def _report_point(self, shot: int, skipped: Collection[int]) -> None:
        """Report the result of a point after its last shot; adaptive scans only."""


class AdaptiveScanRun(ScanRun):
    """The shots of an adaptive scan.

    The scanner's choice depends only on the shots on disk, their lines in the index: a resumed
    run continues as the original would have, and a shot that is repeated is taken at its old point.

    Args:
        assembly: The run.
        search: The scanner and its ranges.
        seed: The run's seed.
        stop: The request to stop.
        run: The run so far, if it is resumed.
        done: Shots that were taken before.
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
    ) -> None:
        self._search = search
        super().__init__(assembly, seed, done)
        self._scanner = ScannerCall(search, seed, stop)
        self._results = Results(search, {} if run is None else {shot.index: shot for shot in run.shots})
        for attempt in () if run is None else run.attempts:
            if run is not None and attempt.index in run.skipped:
                self._results.add_skipped(attempt.index, attempt.row["parameters"])
        self._writer: RunWriter | None = None
        self._observer: RunObserver | None = None

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

    def follow(self, writer: RunWriter, observer: RunObserver) -> None:
        """Connect the recorded results and the observer of events."""
        self._writer, self._observer = writer, observer

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; see :meth:`Search.record`."""
        return self._search.record()

    def _settings(self, place: int) -> Point | None:
        values = self._results.values(place)
        if values is None:
            values = self._scanner.choose(self._results.before(place))
        return None if values is None else self._search.at(values)

    def _scanner_ended(self, shot: int) -> None:
        self._log_event("scan_ended", {"scanner": self._search.name, "n_shots": shot})

    def _add_result(self, shot: int) -> None:
        assert self._writer is not None
        row = self._writer.last_row
        if not row["counts"]:
            self._results.add_skipped(shot, row["parameters"])
            return
        self._results.add(Shot(self._writer.run_dir / row["file"], json.loads(dumps(row))))
        if warning := self._results.missing_figure(shot):
            self._log_event("warning", {"text": warning})

    def _report_point(self, shot: int, skipped: Collection[int]) -> None:
        if set(skipped).issuperset(self._later_at_its_point(shot)):
            self._log_event("scan_point", self._results.progress(self._place(shot)))

    def _log_event(self, name: str, values: Mapping[str, Any]) -> None:
        if self._observer is not None:
            self._observer.event(name, values)


def scan_run_of(
    assembly: Assembly, seed: int, stop: StopFlag, run: Run | None = None, done: Collection[int] = ()
) -> ScanRun:
    """The shots of a run and their points.

    Args:
        assembly: The run.
        seed: Its seed.
        stop: The request to stop.
        run: The run so far, if it is resumed.
        done: Shots that need not be taken.
    """
    if assembly.search is None:
        return ScanRun(assembly, seed, done)
    return AdaptiveScanRun(assembly, assembly.search, seed, stop, run, done)


def point_of(assembly: Assembly, shot: Shot, scan_run: ScanRun) -> Point:
    """The settings that a recorded shot was taken with.

    Args:
        assembly: The run, assembled from its own recorded files.
        shot: The shot.
        scan_run: The run's shots and points.
    """
    if assembly.search is None:
        return assembly.at(scan_run.points[shot.index])
    values = {one.address: shot.row["parameters"][one.address] for one in assembly.search.ranges}
    return assembly.search.at(values)
