"""The roles that decide: planner and detector."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.model import (
    Frame,
    Occupancy,
    Plan,
    TargetPattern,
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


@runtime_checkable
class Warmable(Protocol):
    """A planner, detector or driver with kernels to compile before the first shot."""

    def warm(self) -> None:
        """Compile (or load from the cache) every kernel that a shot will need."""
        ...


@runtime_checkable
class SignalTeller(Protocol):
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
