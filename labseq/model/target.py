"""What the array shall look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.model.arrays import read_only


@dataclass(frozen=True, slots=True, eq=False)
class TargetPattern:
    """Which sites must hold an atom and which must be empty.

    Attributes:
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty. All others are
            reservoir: an atom there does no harm.
        name: For records and the screen.
    """

    fill: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    name: str = "target"

    def __post_init__(self) -> None:
        shape = np.shape(self.fill)
        object.__setattr__(self, "fill", read_only(self.fill, np.bool_, (-1, -1), "fill"))
        object.__setattr__(self, "clear", read_only(self.clear, np.bool_, shape, "clear"))
        if np.any(self.fill & self.clear):
            raise ValueError("a site cannot be in both fill and clear")

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return self.fill.shape[0], self.fill.shape[1]

    @property
    def n_atoms(self) -> int:
        """Number of sites that must hold an atom."""
        return int(np.count_nonzero(self.fill))

    def n_defects(self, occupancy: NDArray[np.bool_]) -> int:
        """Number of empty target sites."""
        return int(np.count_nonzero(self.fill & ~occupancy))

    def n_surplus(self, occupancy: NDArray[np.bool_]) -> int:
        """Number of atoms on sites that must be empty."""
        return int(np.count_nonzero(self.clear & occupancy))

    def is_met_by(self, occupancy: NDArray[np.bool_]) -> bool:
        """Whether every fill site holds an atom and every clear site is empty."""
        return not np.any((self.fill & ~occupancy) | (self.clear & occupancy))

    def filling_fraction(self, occupancy: NDArray[np.bool_]) -> float:
        """Fraction of the fill sites that hold an atom (1.0 for a target without atoms)."""
        n_atoms = self.n_atoms
        return 1.0 - self.n_defects(occupancy) / n_atoms if n_atoms else 1.0
