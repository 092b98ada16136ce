"""The atoms on the sites, and their temperatures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Atoms:
    """The atoms on the sites; all that acts on them changes them in place.

    Args:
        occupied: Which sites hold an atom (n_rows, n_cols), C-contiguous; it is kept.
        temperature: Temperature of all atoms.

    Attributes:
        occupied: Which sites hold an atom.
        heat: float64 (n_rows, n_cols), temperatures of the atoms in kelvin, as they would be in static
            tweezers of the nominal depth.
        since_s: float64 (n_rows, n_cols), the times that these belong to.
    """

    def __init__(self, occupied: Mask, temperature: float) -> None:
        self.occupied = occupied
        self.heat: Floats = np.full(occupied.shape, temperature)
        self.since_s: Floats = np.zeros(occupied.shape)

    def lose(self, gone: Any) -> int:
        """Remove the atoms of some sites (n_rows, n_cols); returns how many there were."""
        lost = self.occupied & gone
        self.occupied &= ~lost
        return int(np.count_nonzero(lost))
