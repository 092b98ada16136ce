"""What the lattices that dilute a triangular one have in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq import ConfigError, SiteGrid
from labseq.errors import Problem


def need_triangular(grid: SiteGrid, name: str) -> None:
    """Refuse a square grid, on which the pattern would be another lattice.

    Raises:
        ConfigError: The grid is square.
    """
    if grid.lattice != "triangular":
        raise ConfigError(
            Problem(
                f"the pattern '{name}' dilutes a triangular lattice, and the grid is {grid.lattice}",
                expected="a profile with 'lattice: triangular'",
                hint="draw what you mean with the pattern 'bitmap'",
            )
        )


def as_sheared(mask: NDArray[np.bool_], grid: SiteGrid) -> NDArray[np.bool_]:
    """A mask made for ``shear: +1``, mirrored left to right on a grid with ``shear: -1``.

    So the array of atoms is the mirror image too.
    """
    return mask if grid.shear > 0 else mask[:, ::-1]
