"""A run goes from point to point of its scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from labseq.recording import RunWriter
from labseq.roles import RunObserver
from labseq.sequencer import Sequencer
from labseq.sequencer.lab import Lab
from labseq.session.assembly import Assembly
from labseq.session.between import ShotHooks
from labseq.session.labs import rebuild_lab
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
