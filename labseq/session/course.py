"""A run goes from point to point of its scan, known beforehand or chosen one by one."""

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
from labseq.session.between_shots import ShotHooks
from labseq.session.lab import rebuild_lab
from labseq.session.scan import Point


class ScanRun:
    """The point of each shot of a run, and which shots are to be taken.

    Args:
        assembly: The run; without a scan all shots are at one point.
        seed: The run's seed.
        done: Shots that were taken before.

    Attributes:
        points: The point of each shot of the run.
        shots: Indices of the shots to take, in order.
        is_adaptive: Whether the points are chosen while the run goes on.
    """

    is_adaptive = False

    def __init__(self, assembly: Assembly, seed: int, done: Collection[int] = ()) -> None:
        self.assembly = assembly
        self._seed = seed
        scanned, n_shots = assembly.scanned, assembly.sequence.shots
        self.points = [0] * n_shots
        if scanned is not None:
            self.points = [int(point) for point in scanned.scan.points_of_shots(seed)[:n_shots]]
        self.shots = [shot for shot in range(n_shots) if shot not in done]

    @property
    def n_points(self) -> int:
        """Number of points that the run's shots are at."""
        return len({*self.points})

    @property
    def first(self) -> Point:
        """The settings of the first shot to take."""
        return self.assembly.at(self.points[self.shots[0]])

    def each(self) -> Iterator[Point]:
        """The settings of each point that a shot to take is at."""
        return map(self.assembly.at, dict.fromkeys(self.points[shot] for shot in self.shots))

    def representative_labs(self) -> Iterator[Point]:
        """One point for each planner and profile that there are, the first shot's first."""
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
        """Say where the results come from, and who is told; before :meth:`run`."""

    def run(self, sequencer: Sequencer, lab: Lab, changes: Mapping[str, Any], shot_hooks: ShotHooks) -> None:
        """Take all shots.

        Args:
            sequencer: Open, at the point of the first shot.
            lab: What it is open with.
            changes: What differs from the files in every shot: address -> value.
            between: What is done between two shots; what it raises ends the run.

        Raises:
            LabseqError: Whatever ended the run before its last shot.
        """
        now, before = self.points[self.shots[0]], self.first
        skipped = set(self._skip_before(shot_hooks))
        for shot in self.shots:
            if shot in skipped:
                continue
            shot_hooks.before()
            point = self.points[shot]
            if point != now:
                after = self.assembly.at(point)
                lab = self._go_on(sequencer, lab, before, after, changes)
                now, before = point, after
            given_up = sequencer.run([shot])
            skipped.update(self._skip(shot, given_up, shot_hooks))

    def _skip_before(self, shot_hooks: ShotHooks) -> list[int]:
        """Put down what should have been, had the run not died right after its last shot."""
        shot, why = shot_hooks.left_open
        left = self._later_at_its_point(shot) if why else []
        shot_hooks.skip(left, why)
        return left

    def _skip(self, shot: int, given_up: Mapping[int, str], shot_hooks: ShotHooks) -> list[int]:
        """Put down what is left out after a shot."""
        why = shot_hooks.after([*given_up.values()])
        left = [*given_up, *self._later_at_its_point(shot)] if why else []
        shot_hooks.skip(left, why)
        return left

    def _later_at_its_point(self, shot: int) -> list[int]:
        """Shots still to take at the point of a shot; without a scan each shot stands for itself."""
        if self.assembly.scanned is None:
            return []
        return [later for later in self.shots if later > shot and self.points[later] == self.points[shot]]

    def _go_on(
        self, sequencer: Sequencer, lab: Lab, before: Point, after: Point, changes: Mapping[str, Any]
    ) -> Lab:
        """Bring the lab from one point to the next."""
        lab, reopened = rebuild_lab(lab, before, after, self._seed)
        sequencer.change(lab, after.steps, {**changes, **after.parameters}, reopened)
        return lab

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; empty without one.

        ``addresses``: what is scanned; ``points``: the values of each point, SI; ``written``: the
        same as the sequence has them; ``point_of_shot``: the point of each shot, counted from 0.
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


def course_of(
    assembly: Assembly, seed: int, stop: StopFlag, run: Run | None = None, done: Collection[int] = ()
) -> ScanRun:
    """The way of a run through the points of its scan.

    Args:
        assembly: The run.
        seed: Its seed.
        stop: The request to stop.
        run: The same run as it was before, if it goes on.
        done: Shots that need not be taken.
    """
    if assembly.search is None:
        return ScanRun(assembly, seed, done)
    return AdaptiveScanRun(assembly, assembly.search, seed, stop, run, done)


class AdaptiveScanRun(ScanRun):
    """The course of an adaptive scan.

    What the scanner chooses follows from the shots on disk alone, their lines in the index: so a run
    that is resumed goes on as it would have, and a shot that is taken again is taken at its old point.

    Args:
        assembly: The run.
        search: What chooses its points.
        seed: The run's seed.
        stop: The request to stop.
        run: The run as it was before, if it goes on.
        done: Shots that need not be taken.
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
        self.assembly = assembly
        self._seed = seed
        self._search = search
        self._asker = ScannerCall(search, seed, stop)
        self._missing = [shot for shot in range(assembly.sequence.shots) if shot not in done]
        self._results = Results(search, {} if run is None else {shot.index: shot for shot in run.shots})
        if run is not None:
            for attempt in run.attempts:
                if attempt.index in run.skipped:
                    self._results.give_up(attempt.index, attempt.row["parameters"])
        self._at: tuple[int, Point | None] = -1, None
        self._writer: RunWriter | None = None
        self._observer: RunObserver | None = None

    @cached_property
    def shots(self) -> list[int]:  # pyright: ignore[reportIncompatibleVariableOverride] - known once asked
        """Indices of the shots to take at most; none if the scanner wants no more."""
        if not self._missing or self._point_of(self._missing[0]) is not None:
            return self._missing
        if self._results.is_empty:
            raise DeviceError(self._search.name, "next_point() gave no point at all; expected a first one")
        return []

    @property
    def n_points(self) -> int:
        """The most points that there may be."""
        return self._search.adaptive.n_points

    @property
    def first(self) -> Point:
        """The settings of the first shot to take."""
        point = self._point_of(self.shots[0])
        assert point is not None
        return point

    def each(self) -> Iterator[Point]:
        """The settings of the first shot to take, and of the corners of what is chosen from."""
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
        """Say where the results come from, and who is told what they mean."""
        self._writer, self._observer = writer, observer

    def run(self, sequencer: Sequencer, lab: Lab, changes: Mapping[str, Any], shot_hooks: ShotHooks) -> None:
        """Take shots until there are no more, or the scanner wants none."""
        before, skipped = self.first, set(self._skip_before(shot_hooks))
        for shot in self.shots:
            if shot in skipped:
                continue
            shot_hooks.before()
            point = self._point_of(shot)
            if point is None:
                self._log_event("scan_ended", {"scanner": self._search.name, "n_shots": shot})
                return
            if point is not before:
                lab = self._go_on(sequencer, lab, before, point, changes)
                before = point
            given_up = sequencer.run([shot])
            self._note(shot)
            skipped.update(self._skip(shot, given_up, shot_hooks))
            if skipped.issuperset(self._later_at_its_point(shot)):
                visit = shot // self._search.scanned.scan.repeats
                self._log_event("scan_point", self._results.told(visit))

    def _later_at_its_point(self, shot: int) -> list[int]:
        repeats = self._search.scanned.scan.repeats
        return [later for later in self.shots if later > shot and later // repeats == shot // repeats]

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; see :meth:`Search.record`."""
        return self._search.record()

    def _log_event(self, name: str, values: Mapping[str, Any]) -> None:
        if self._observer is not None:
            self._observer.event(name, values)

    def _point_of(self, shot: int) -> Point | None:
        """The settings of a shot: those of the others of its point, else what the scanner chooses."""
        visit = shot // self._search.scanned.scan.repeats
        if self._at[0] != visit:
            values = self._results.values(visit)
            if values is None:
                values = self._asker.ask(self._results.before(visit))
            point = None
            if values is not None:
                point = self._search.at(values)
            self._at = visit, point
        return self._at[1]

    def _note(self, shot: int) -> None:
        """Take in what came of a shot."""
        assert self._writer is not None
        row = self._writer.last_row
        if not row["counts"]:
            self._results.give_up(shot, row["parameters"])
            return
        self._results.add(Shot(self._writer.run_dir / row["file"], json.loads(dumps(row))))
        if warning := self._results.missing_figure(shot):
            self._log_event("warning", {"text": warning})


def point_of(assembly: Assembly, shot: Shot, course: ScanRun) -> Point:
    """The settings that a recorded shot was taken with.

    Args:
        assembly: The run, put together of its own files.
        shot: The shot.
        course: The course of the run.
    """
    if assembly.search is None:
        return assembly.at(course.points[shot.index])
    values = {one.address: shot.row["parameters"][one.address] for one in assembly.search.ranges}
    return assembly.search.at(values)
