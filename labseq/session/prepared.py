"""A run before its devices are opened, with its shots and points, for `labseq check` and sessions."""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Protocol

from labseq.assembly.assemble import Assembly
from labseq.assembly.lab import build_lab, choice_of, clock_for, warm
from labseq.assembly.point import Point
from labseq.data.reader import Run
from labseq.data.shot import CachingLoader, Shot
from labseq.guard import StopFlag
from labseq.recording.index import IndexRow
from labseq.roles import RunObserver, Step
from labseq.sequencer.lab import Lab
from labseq.session.checks import Analyses
from labseq.session.observers import Observers
from labseq.session.rehearsal import first_window_s


class History:
    """The shots of a run, both the shots that were taken or given up and the shots still to take.

    Args:
        run: The run before it was resumed. None for a new run.
        done: Its shots that are not taken again.

    Attributes:
        point_of_shot: Number of the point of each shot of the run.
        to_take: Shots still to take, in order.
        last: The shot added last. None before the first shot of this process.
        shots: Number of a point -> index of a shot -> the shot, if it counts. Only for adaptive scans.
        given_up: Number of a point -> a shot that was given up there. Only for adaptive scans.
    """

    def __init__(self, assembly: Assembly, seed: int, run: Run | None, done: Collection[int]) -> None:
        self.point_of_shot = assembly.point_of_shot(seed)
        self.to_take = [shot for shot in range(len(self.point_of_shot)) if shot not in done]
        self.last: int | None = None
        self.shots = defaultdict[int, dict[int, Shot]](dict)
        self.given_up: dict[int, IndexRow] = {}
        self._is_scan, self._is_search = assembly.scanned is not None, assembly.search is not None
        self._load = CachingLoader()
        if run is not None and self._is_search:
            for shot in run.shots:
                self.shots[self.point_of_shot[shot.index]][shot.index] = shot
            skipped = (attempt for attempt in run.attempts if attempt.index in run.skipped)
            self.given_up = {self.point_of_shot[attempt.index]: attempt.row for attempt in skipped}

    @property
    def next_number(self) -> int | None:
        """Number of the point of the next shot. None if no shot is left."""
        return self.point_of_shot[self.to_take[0]] if self.to_take else None

    def add(self, run_dir: Path, row: IndexRow) -> None:
        """Add the next shot, which was taken or given up."""
        self.last = row.shot
        self.to_take.remove(row.shot)
        if not self._is_search:  # nothing depends on the lines, and in a long run they would fill the memory
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
        """Shots still to take at the point of a shot. Empty without a scan, where each shot is separate."""
        number = self.point_of_shot[shot]
        is_there = (later for later in self.to_take if later > shot and self.point_of_shot[later] == number)
        return [*is_there] if self._is_scan else []


class Points(Protocol):
    """Gives the point of each shot of a run."""

    def next(self, history: History) -> Point | None:
        """The point of the next shot, the same object for all shots of a point. None to end the run.

        Raises:
            DeviceError: A scanner failed.
            StopRequested: The operator asked to stop.
        """
        ...

    def known(self, history: History) -> Mapping[int, Point]:
        """The points that can be checked before the run, number -> point."""
        ...


class ListedPoints:
    """Points that are known in advance. Without a scan, this is the settings of the files."""

    def __init__(self, assembly: Assembly) -> None:
        self._at = cache(assembly.at)  # the same object for the same point, so that nothing is built again

    def next(self, history: History) -> Point | None:
        """The point of the next shot. None after the last shot."""
        return None if history.next_number is None else self._at(history.next_number)

    def known(self, history: History) -> Mapping[int, Point]:
        """The points of the run."""
        return {number: self._at(number) for number in dict.fromkeys(history.point_of_shot)}


class PreparedRun:
    """A run before its devices are opened.

    Args:
        paced: Let virtual time pass at the speed of real time.
        observer: Receives every event.
        root: The folder for the data.
        run: The earlier run, if it is resumed, else None.
        done: Its shots that are not taken again.

    Attributes:
        assembly: Its files, plugins and settings.
        seed: Its seed.
        stop_flag: The request to stop it.
        observers: Receive its events.
        analyses: The analyses of its shots.
        history: The shots that were taken, and the shots still to take.
        points: Gives the point of each shot.
        root: The folder for the data, absolute.
    """

    def __init__(
        self,
        assembly: Assembly,
        observer: RunObserver | None,
        *,
        paced: bool,
        root: Path,
        run: Run | None,
        done: Collection[int],
    ) -> None:
        self.assembly = assembly
        self.root = root.absolute()  # some vendors' libraries change the working folder
        seed = assembly.sequence.seed if run is None else run.seed
        self.seed = secrets.randbits(63) if seed is None else seed
        self.stop_flag = StopFlag()
        self.observers = Observers(assembly.hardware.host, observer)
        self.analyses = self._analysis_processes(run) if assembly.sequence.analysis else Analyses()
        self.history = History(assembly, self.seed, run, done)
        self.points: Points = ListedPoints(assembly)
        if assembly.search is not None:
            from labseq.session.adaptive import SearchedPoints  # loads modules that other runs do not need

            self.points = SearchedPoints(self, assembly.search)
        self._is_paced = paced

    def build_lab(self, point: Point | None = None) -> Lab:
        """Construct the object of every role with the run's clock, without opening a device.

        Args:
            point: Point of the scan. None for the first point.
        """
        clock = clock_for(self.stop_flag, virtual=self.assembly.virtual_time, paced=self._is_paced)
        return build_lab(point or self.assembly.first_point, self.assembly.target, clock, self.seed)

    def warm(self, lab: Lab, *, devices: bool = True) -> None:
        """Compile the kernels of a lab. See :func:`labseq.assembly.lab.warm`."""
        warm(lab, self.stop_flag, self.observers, devices=devices)

    def choose(self, lab: Lab, steps: Sequence[tuple[str, Step]]) -> Sequence[str]:
        """The choice of a planner that chooses how to plan, then the alternatives. May take seconds.

        Empty if the planner has no choice, or nothing is planned.
        """
        window_s = first_window_s(steps)
        return () if window_s is None else choice_of(lab.planner, lab.target, window_s, self.stop_flag)

    def choose_planner(self, lab: Lab, point: Point) -> None:
        """Let a planner that chooses how to plan do so, and log the choice."""
        if chosen := self.choose(lab, point.steps):
            self.observers.event("planner_chosen", {"chosen": [*chosen]})

    def warn(self, text: str) -> None:
        """Report a warning."""
        self.observers.event("warning", {"text": text})

    def _analysis_processes(self, run: Run | None) -> Analyses:
        """The analyses of the sequence, with the results that the run needs."""
        from labseq.session.analysis_processes import AnalysisProcesses  # other runs do not need its modules

        checks, search = self.assembly.sequence.policy.checks, self.assembly.search
        needed = {check.value: "" for check in checks}
        needed |= {check.value: "for a check that stops it" for check in checks if check.then == "stop"}
        if search is not None:
            needed[search.scan.choice.quantity] = "to choose the next point"
        analyses = self.assembly.resolved["analysis"]
        return AnalysisProcesses(analyses, needed, self.observers, self.stop_flag, run)
