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
            "exposure": "number of the exposure in the shot, from 0: the image of this number",
            "row": "row of its site",
            "col": "column of its site",
            "lost": "whether the exposure lost it",
        }
    },
)
"""An atom that was there when an exposure began."""


def table_of(exposures: Iterable[tuple[Mask, Mask]]) -> NDArray[Any]:
    """The atoms of each exposure, :data:`ATOMS`; from where they were, and where they were lost."""
    rows = [
        (exposure, row, col, lost[row, col])
        for exposure, (occupied, lost) in enumerate(exposures)
        for row, col in np.argwhere(occupied)
    ]
    return np.array(rows, ATOMS)


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
