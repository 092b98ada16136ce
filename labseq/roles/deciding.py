"""The roles that decide, and those that look at what came of it: planner, detector, scanner, analysis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.model import (
    CycleRecord,
    Frame,
    ImageRecord,
    Occupancy,
    Plan,
    StageTiming,
    TargetPattern,
    VisitedPoint,
)


class Planner(Protocol):
    """Decides the moves. Pure: deterministic, no I/O, the input left untouched."""

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target.

        With too few atoms it fills what it can, from the centre of the target.

        Args:
            occupancy: bool (n_rows, n_cols), as detected; of any memory layout, and
                perhaps read-only.
            target: What to end with.
        """
        ...


class Detector(Protocol):
    """Turns a frame into an occupancy."""

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site,
            float32 (n_rows, n_cols), 0 at the threshold and 1 for certainty.
        """
        ...


class Scanner(Protocol):
    """Chooses the points of an adaptive scan, one after another.

    Pure: what it chooses follows from its settings, the space (its seed included) and the points
    visited so far, and from nothing else; it does no I/O. So a run that is resumed goes on as it
    would have. It may keep what it has worked out, as long as nobody can tell.
    """

    def next_point(self, visited: Sequence[VisitedPoint]) -> Mapping[str, float] | None:
        """Choose the next point.

        Args:
            visited: The points so far with their scores, in order; none at the first call. A point
                may stand in it more than once.

        Returns:
            A value for each address, SI, within its range (:meth:`labseq.ScanRange.at` gives such
            values); or None if there is nothing more to find out: the run ends then.
        """
        ...


class RecordedShot(Protocol):
    """A shot that was taken, read back from disk: a ``Shot`` of ``labseq.open_run``, which tells more."""

    @property
    def index(self) -> int:
        """Index of the shot in the run, from 0."""
        ...

    @property
    def target(self) -> TargetPattern:
        """What the array was to look like."""
        ...

    @property
    def success(self) -> bool:
        """Whether its last ``image`` step met the target."""
        ...

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on its last ``image`` step; nan without one."""
        ...

    @property
    def images(self) -> Sequence[ImageRecord]:
        """The images without their frames, in the order they were taken."""
        ...

    @property
    def occupancies(self) -> NDArray[np.bool_]:
        """As detected, bool (n_images, n_rows, n_cols)."""
        ...

    @property
    def confidences(self) -> NDArray[np.float32]:
        """The detector's confidence, float32 (n_images, n_rows, n_cols)."""
        ...

    @property
    def frames(self) -> NDArray[np.uint16]:
        """The frames that were kept, uint16 (n_frames, height, width)."""
        ...

    @property
    def cycles(self) -> Sequence[CycleRecord]:
        """The rearrangement cycles."""
        ...

    @property
    def timing(self) -> Sequence[StageTiming]:
        """The stages, in the order they ended."""
        ...

    @property
    def readings(self) -> Mapping[str, Any]:
        """Values read from devices, and noted by steps."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """What differs from the files in this shot: address -> value; those of a scan in SI."""
        ...


class Analysis(Protocol):
    """Works something out of each shot, in a process of its own beside the run."""

    def shot(self, shot: RecordedShot) -> Mapping[str, Any]:
        """Analyse a shot.

        Args:
            shot: The shot, whole and on disk; shots come in the order they were taken.

        Returns:
            Name -> number, text, array, or lists and mappings of them: what the shot's line of
            the results says. "shot" and "error" are no names of results.
        """
        ...


@runtime_checkable
class NeedsWarmUp(Protocol):
    """A planner, detector or driver with kernels to compile before the first shot."""

    def warm(self) -> None:
        """Compile (or load from the cache) every kernel that a shot will need."""
        ...


@runtime_checkable
class ReportsSignals(Protocol):
    """A detector that tells what it compares with its thresholds, so that they can be calibrated."""

    @property
    def signal_unit(self) -> str:
        """Unit of the signals: "counts", "log-odds"."""
        ...

    @property
    def sites_px(self) -> NDArray[np.float64]:
        """Where it looks for the atoms, float64 (n_rows, n_cols, 2), (y, x) in pixels."""
        ...

    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """What is compared with the threshold of each site, float64 (n_rows, n_cols)."""
        ...
