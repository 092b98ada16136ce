"""Kernel of the compression algorithm: the target is filled from its centre outwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_single._kernels_moves import GROWING, Growing, clear_surplus, shift
from labseq_single._kernels_paths import (
    GRID,
    NO_END,
    cheapest_path,
    grid_sites,
    sites_with_margin,
    with_margin,
)

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@kernel(f"Tuple(({GROWING}))({GRID}, {GRID}, {GRID}, {const('int64', 1)}, boolean)")
def plan_compression(
    occupied: Bools, fill_sites: Bools, clear_sites: Bools, order: Ints, may_eject: bool
) -> Growing:
    """Fill each site in turn with the nearest atom not placed yet, then clear what must be empty.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        order: int64 (n_fill,), the fill sites, row * n_cols + col, the innermost first.
        may_eject: Whether atoms can be ejected.

    Returns:
        moves, int16 (>= n, 4), and whether each is linked, bool (>= n,); their number n.
    """
    n_rows, n_cols = occupied.shape
    width = n_cols + 2
    atoms, inside = with_margin(occupied), grid_sites(n_rows, n_cols)
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    moves, linked, n = np.empty((occupied.size, 4), np.int16), np.empty(occupied.size, np.bool_), 0
    end_cost = np.full(len(atoms), NO_END, np.int64)
    for site in range(len(atoms)):
        if atoms[site]:
            end_cost[site] = 2 if fill[site] else (0 if clear[site] else 1)
    hole = np.zeros(len(atoms), np.bool_)
    for site in sites_with_margin(order, n_cols):
        if not atoms[site]:
            hole[site] = True
            path = cheapest_path(atoms, inside, width, hole, end_cost)
            hole[site] = False
            end_cost[path[0]] = NO_END
            moves, linked, n = shift(moves, linked, n, atoms, inside, width, path[::-1].copy())
        end_cost[site] = NO_END
    return clear_surplus(moves, linked, n, atoms, inside, width, fill, clear, may_eject)
