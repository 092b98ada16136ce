"""A run before its devices are opened: what `labseq check` looks at, and what a session then carries out."""

from __future__ import annotations

import secrets
from collections.abc import Collection

from labseq.assembly.assemble import Assembly
from labseq.assembly.lab import build_lab, clock_for, warm
from labseq.assembly.points import Point
from labseq.data import Run
from labseq.guard import StopFlag
from labseq.roles import RunObserver
from labseq.sequencer.lab import Lab
from labseq.session.analysis_processes import AnalysisProcesses
from labseq.session.observers import Observers
from labseq.session.scan import History, ListedPoints, Points, SearchedPoints


class PreparedRun:
    """A run before its devices are opened.

    Args:
        paced: Let virtual time pass at the speed of real time.
        observer: Receives every event.
        run: The run as it was before, if it is resumed.
        done: Its shots that are not taken again.

    Attributes:
        assembly: Its files, plugins and settings.
        seed: Its seed.
        stop_flag: The request to stop it.
        observers: Receive its events.
        analyses: The analyses of its shots.
        history: The shots that were taken, and those still to take.
        points: Says where they are taken.
    """

    def __init__(
        self,
        assembly: Assembly,
        observer: RunObserver | None = None,
        *,
        paced: bool = False,
        run: Run | None = None,
        done: Collection[int] = (),
    ) -> None:
        self.assembly = assembly
        seed = assembly.sequence.seed if run is None else run.seed
        self.seed = secrets.randbits(63) if seed is None else seed
        self.stop_flag = StopFlag()
        self.observers = Observers(assembly.hardware.host, observer)
        self.analyses = self._analysis_processes(run)
        self.history = History(assembly, self.seed, run, done)
        search = assembly.search
        self.points: Points = ListedPoints(assembly) if search is None else SearchedPoints(self, search)
        self._is_paced = paced

    def build_lab(self, point: Point | None = None) -> Lab:
        """Construct the object of every role with the run's clock; no device is opened.

        Args:
            point: Point of the scan; None for the first one.
        """
        clock = clock_for(self.stop_flag, virtual=self.assembly.virtual_time, paced=self._is_paced)
        return build_lab(point or self.assembly.first_point, self.assembly.target, clock, self.seed)

    def warm(self, lab: Lab, *, devices: bool = True) -> None:
        """Compile the kernels of a lab; see :func:`labseq.assembly.lab.warm`."""
        warm(lab, self.stop_flag, self.observers, devices=devices)

    def warn(self, text: str) -> None:
        """Report a warning."""
        self.observers.event("warning", {"text": text})

    def _analysis_processes(self, run: Run | None) -> AnalysisProcesses:
        """The analyses of the sequence, and what the run needs of their results."""
        checks, search = self.assembly.sequence.policy.checks, self.assembly.search
        needed = {check.value: "" for check in checks}
        needed |= {check.value: "for a check that stops it" for check in checks if check.then == "stop"}
        if search is not None:
            needed[search.scan.choice.quantity] = "to choose the next point"
        analyses = self.assembly.resolved["analysis"]
        return AnalysisProcesses(analyses, needed, self.observers, self.stop_flag, run)
