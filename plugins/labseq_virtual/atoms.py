"""The atoms on the sites, and their temperatures."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ATOMS: Final = np.dtype(
    [("exposure", np.int32), ("row", np.int16), ("col", np.int16), ("lost", np.bool_)],
    metadata={
        "descriptions": {
            "exposure": "number of the exposure, and so of the image, in the shot, from 0",
            "row": "row of its site",
            "col": "column of its site",
            "lost": "whether the atom was lost in the exposure",
        }
    },
)
"""An atom that existed when an exposure began."""


def table_of(exposures: Iterable[tuple[Mask, Mask]]) -> NDArray[Any]:
    """Table :data:`ATOMS` of the atoms of each exposure, from masks of the atoms and of lost atoms."""
    rows = [
        (exposure, row, col, lost[row, col])
        for exposure, (occupied, lost) in enumerate(exposures)
        for row, col in np.argwhere(occupied)
    ]
    return np.array(rows, ATOMS)


class Atoms:
    """The atoms on the sites, which are changed in place.

    Args:
        occupied: Sites with an atom (n_rows, n_cols), C-contiguous. The array is kept, not copied.
        temperature: Temperature of all atoms.

    Attributes:
        occupied: Sites with an atom.
        heat: float64 (n_rows, n_cols), temperatures of the atoms in kelvin, as they would be in static
            tweezers of the nominal depth.
        since_s: float64 (n_rows, n_cols), the times at which ``heat`` was valid.
    """

    def __init__(self, occupied: Mask, temperature: float) -> None:
        self.occupied = occupied
        self.heat: Floats = np.full(occupied.shape, temperature)
        self.since_s: Floats = np.zeros(occupied.shape)

    def lose(self, gone: Any) -> int:
        """Remove the atoms of some sites (n_rows, n_cols), and return their number."""
        lost = self.occupied & gone
        self.occupied &= ~lost
        return int(np.count_nonzero(lost))
