"""The cells around the sites of a lattice: hexagons on the triangular one, squares on the square one."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.sheet import place_sites
from labseq.model import SiteGrid

Floats = NDArray[np.float64]

_TOUCHING = 1.01
"""Distance up to which sites are neighbours, in units of the spacing."""


def neighbours(grid: SiteGrid) -> NDArray[np.int64]:
    """How far the nearest sites are, in rows and columns, counter-clockwise as seen in a picture.

    Returns:
        int64 (n, 2), 6 of them on a triangular lattice and 4 on a square one.

    Example:
        >>> neighbours(SiteGrid(lattice="square")).tolist()
        [[-1, 0], [0, 1], [1, 0], [0, -1]]
    """
    steps = np.array([step for step in product((-1, 0, 1), repeat=2) if any(step)])
    x, y = place_sites(steps, grid).T
    near = np.hypot(x, y) < _TOUCHING
    order = np.argsort(np.arctan2(y[near], x[near]), kind="stable")
    return steps[near][order]


def cell(grid: SiteGrid) -> Floats:
    """Corners of the cell around a site at the origin, float64 (n, 2), x and y in units of the spacing.

    Example:
        >>> cell(SiteGrid(lattice="square")).tolist()
        [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    """
    return _edges(grid)[:, 0]


def outline(sites: NDArray[np.bool_], grid: SiteGrid) -> Floats:
    """The border around some sites.

    Args:
        sites: bool (n_rows, n_cols).
        grid: The grid that they lie on.

    Returns:
        float64 (n, 2, 2): start and end (x, y) of each stretch, in units of the spacing.

    Example:
        >>> len(outline(np.array([[True, True]]), SiteGrid(1, 2)))
        10
    """
    padded = np.pad(sites, 1)
    stretches: list[Floats] = []
    for (row, col), edge in zip(neighbours(grid), _edges(grid), strict=True):
        beside = np.roll(padded, (-row, -col), axis=(0, 1))[1:-1, 1:-1]
        open_here = np.argwhere(sites & ~beside)
        stretches.append(place_sites(open_here, grid)[:, None] + edge)
    return np.concatenate(stretches)


def _edges(grid: SiteGrid) -> Floats:
    """The stretch of the border towards each neighbour, float64 (n, 2, 2); each begins where one ends."""
    to = place_sites(neighbours(grid), grid)
    aside = np.stack([-to[:, 1], to[:, 0]], axis=1)
    half = np.tan(np.pi / len(to)) / 2
    edges: Floats = np.stack([to / 2 - half * aside, to / 2 + half * aside], axis=1)
    return edges.round(12)
