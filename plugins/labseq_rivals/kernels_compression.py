"""Kernel of the compression algorithm of Schymik et al., with boards and paths as in ``kernels_board``."""

from __future__ import annotations

import numpy as np

from labseq.plugin import const, kernel
from labseq.plugin.plan_kernels import FINISHED_PLAN, FinishedPlan, empty_plan, finished
from labseq_rivals.kernels_board import (
    GRID,
    NO_END,
    Bools,
    Ints,
    board_of,
    cheapest_path,
    clear_surplus,
    shift,
    sites_with_margin,
    with_margin,
)


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, {const('int64', 1)}, boolean)")
def plan_compression(
    occupied: Bools, fill_sites: Bools, clear_sites: Bools, order: Ints, may_eject: bool
) -> FinishedPlan:
    """Fill each site in turn with the nearest atom not placed yet, then clear what must be empty.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        order: int64 (n_fill,), the fill sites, row * n_cols + col, the innermost first.
        may_eject: True if atoms can be ejected.
    """
    n_cols = occupied.shape[1]
    plan, board = empty_plan(occupied.size), board_of(occupied)
    atoms = board[0]
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    end_cost = np.full(len(atoms), NO_END, np.int64)
    for site in range(len(atoms)):
        if atoms[site]:
            end_cost[site] = 2 if fill[site] else (0 if clear[site] else 1)
    hole = np.zeros(len(atoms), np.bool_)
    for site in sites_with_margin(order, n_cols):
        if not atoms[site]:
            hole[site] = True
            path = cheapest_path(board, hole, end_cost)
            hole[site] = False
            end_cost[path[0]] = NO_END
            plan = shift(plan, board, path[::-1].copy())
        end_cost[site] = NO_END
    return finished(clear_surplus(plan, board, fill_sites, clear_sites, may_eject))
