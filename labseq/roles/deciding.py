"""The roles that decide or analyse the result, which are planner, detector, scanner and analysis.

All are pure functions of their inputs. A class needs only the methods of its role. It need not be derived
from the role's class.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

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
    """Decides the moves. It is deterministic, does no I/O and leaves the input unchanged."""

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target.

        With too few atoms it fills as many sites as possible, from the centre of the target.

        Args:
            occupancy: bool (n_rows, n_cols), as detected. It may have any memory layout, and be read-only.
            target: The target pattern.
        """
        ...


Detection: TypeAlias = (
    tuple[Occupancy, NDArray[np.float32]] | tuple[Occupancy, NDArray[np.float32], NDArray[np.float64]]
)
"""Occupancy and confidence of each site, and the signal behind the decision if the detector has one."""


class Detector(Protocol):
    """Turns a frame into an occupancy."""

    def detect(self, frame: Frame) -> Detection:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site, float32 (n_rows, n_cols),
            0 at the threshold and 1 for certainty. A detector that decides by a threshold adds the signal
            of each site, float64 (n_rows, n_cols), which is then recorded with the image.
        """
        ...


class Scanner(Protocol):
    """Chooses the points of an adaptive scan, one after another.

    The choice depends only on its settings, the space (including its seed) and the points visited so far. It
    does no I/O. So a resumed run continues like an uninterrupted run. It may cache results as long as they
    change no choice.
    """

    def next_point(self, visited: Sequence[VisitedPoint]) -> Mapping[str, float] | None:
        """Choose the next point.

        Args:
            visited: The points so far with their scores, in order. Empty at the first call. A point may occur
                more than once.

        Returns:
            A value for each address, SI, within its range (:meth:`labseq.plugin.ScanRange.at` gives such
            values), or None to end the run.
        """
        ...


class RecordedShot(Protocol):
    """A shot read back from disk. The ``Shot`` of ``labseq.open_run`` has more."""

    @property
    def index(self) -> int:
        """Index of the shot in the run, from 0."""
        ...

    @property
    def target(self) -> TargetPattern:
        """The target pattern."""
        ...

    @property
    def success(self) -> bool:
        """Whether its last ``image`` step met the target."""
        ...

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on its last ``image`` step, or nan if it has none."""
        ...

    @property
    def images(self) -> Sequence[ImageRecord]:
        """The images without their frames, in the order they were taken."""
        ...

    @property
    def occupancies(self) -> NDArray[np.bool_]:
        """The detected occupancies, bool (n_images, n_rows, n_cols)."""
        ...

    @property
    def confidences(self) -> NDArray[np.float32]:
        """The detector's confidence, float32 (n_images, n_rows, n_cols)."""
        ...

    @property
    def frames(self) -> NDArray[np.uint16]:
        """The recorded frames, uint16 (n_frames, height, width)."""
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
        """Values read from devices or recorded by steps."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Settings of this shot that differ from the files, address -> value. Scanned values are in SI."""
        ...


class Analysis(Protocol):
    """Computes results from each shot, in a separate process next to the run.

    It may have an attribute ``results``, the names of its results that are single values. ``labseq check``
    then refuses a check or an adaptive scan that needs any other result.
    """

    def shot(self, shot: RecordedShot) -> Mapping[str, Any]:
        """Analyse a shot.

        Args:
            shot: The shot, complete and on disk. Shots come in the order they were taken.

        Returns:
            The shot's line in the results, name -> number, text, array, or lists and mappings of them. "shot"
            and "error" cannot be names of results.
        """
        ...


@runtime_checkable
class NeedsWarmUp(Protocol):
    """A planner or detector with kernels to compile before the first shot."""

    def warm(self) -> None:
        """Import every kernel that a shot will need. labseq then compiles or loads them."""
        ...


@runtime_checkable
class ChoosesPlanner(Protocol):
    """A planner that chooses how it plans for a target, before the first shot."""

    def choose(self, target: TargetPattern, window_s: float) -> Sequence[str]:
        """Choose how to plan, or recall an earlier choice.

        Args:
            target: The target.
            window_s: Time from the start of the first cycle in which its batches must end.

        Returns:
            The choice, then the alternatives, one line each, for ``labseq check`` and the log of the run.
        """
        ...


@runtime_checkable
class ReportsSignals(Protocol):
    """A detector that reports the signals it compares with its thresholds.

    Its thresholds can be calibrated, and they are recorded together with its sites in each shot's file.
    """

    @property
    def signal_unit(self) -> str:
        """Unit of the signals, for example "counts" or "log-odds"."""
        ...

    @property
    def sites_px(self) -> NDArray[np.float64]:
        """Positions of the sites on the frame, float64 (n_rows, n_cols, 2), (y, x) in pixels."""
        ...

    @property
    def thresholds(self) -> NDArray[np.float64]:
        """Thresholds, float64 (n_rows, n_cols). A site holds an atom if its signal exceeds its threshold."""
        ...

    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """The values that are compared with the thresholds of the sites, float64 (n_rows, n_cols)."""
        ...
