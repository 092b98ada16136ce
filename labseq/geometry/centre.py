"""Sites by their distance from the centre of a target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.model import SiteGrid


def from_the_centre(fill: NDArray[np.bool_], grid: SiteGrid) -> NDArray[np.intp]:
    """List fill sites, those nearest to their common centre first.

    Distances are those on the lattice; of sites equally far the one in the upper
    row, then in the left column, comes first.

    Args:
        fill: bool (n_rows, n_cols).
        grid: Tells the lattice.

    Returns:
        int (n_fill,), row * n_cols + column of each: indices of ``fill.reshape(-1)``.

    Example:
        >>> from_the_centre(np.ones((1, 5), np.bool_), SiteGrid()).tolist()
        [2, 1, 3, 0, 4]
    """
    rows, cols = np.nonzero(fill)
    down = len(rows) * rows - rows.sum()  # from the centre, times the number of sites: exact in integers
    right = len(cols) * cols - cols.sum()
    shear = grid.shear if grid.lattice == "triangular" else 0
    distance = down**2 + right**2 + shear * down * right  # |right a1 + down a2|^2 / a^2
    nearest_first: NDArray[np.intp] = (rows * fill.shape[1] + cols)[np.lexsort((cols, rows, distance))]
    return nearest_first


def nearest_to_centre(fill: NDArray[np.bool_], n_sites: int, grid: SiteGrid) -> NDArray[np.bool_]:
    """Keep the fill sites that lie nearest to their common centre, see :func:`from_the_centre`.

    This is what a planner fills when it has only ``n_sites`` atoms.

    Args:
        fill: bool (n_rows, n_cols).
        n_sites: How many sites to keep at most.
        grid: Tells the lattice.

    Returns:
        bool (n_rows, n_cols); ``fill`` itself if it has no more sites.

    Example:
        >>> nearest_to_centre(np.ones((1, 5), np.bool_), 2, SiteGrid()).tolist()
        [[False, True, True, False, False]]
    """
    if np.count_nonzero(fill) <= n_sites:
        return fill
    nearest = np.zeros(fill.shape, np.bool_)
    nearest.reshape(-1)[from_the_centre(fill, grid)[:n_sites]] = True
    return nearest
