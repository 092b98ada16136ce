"""Kernels of Tetris: rows piled up from the top, then columns; vocabulary as in ``kernels_lines``."""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq_scans.kernels_lines import (
    GRID,
    GROWING,
    Bools,
    Growing,
    Ints,
    add_line,
    column_sums,
    empty_plan,
    settle,
    supply_columns,
)


@helper_kernel(f"int64[:, ::1]({GRID})")
def fill_rows(fill: Bools) -> Ints:
    """List the rows of each column's fill sites, int64 (n_cols, n_rows + 1); ``n_rows`` after the last."""
    n_rows, n_cols = fill.shape
    rows = np.full((n_cols, n_rows + 1), n_rows, np.int64)
    for col in range(n_cols):
        n = 0
        for row in range(n_rows):
            if fill[row, col]:
                rows[col, n] = row
                n += 1
    return rows


@helper_kernel("void(bool_[::1], int64[:, ::1], int64[::1], bool_[::1])")
def choose_columns(atoms: Bools, rows: Ints, piled: Ints, chosen: Bools) -> None:
    """Choose the columns that the atoms of a row go to: those whose next open target row is the uppermost.

    Of equals, columns that hold an atom of this row already come first, then the left ones.

    Args:
        atoms: bool (n_cols,), the row.
        rows: int64 (n_cols, n_rows + 1), see :func:`fill_rows`.
        piled: int64 (n_cols,), how many of each column's target rows have their atom; updated.
        chosen: Result, bool (n_cols,).
    """
    n_rows = rows.shape[1] - 1
    for col in range(len(atoms)):
        chosen[col] = False
    for _ in range(np.count_nonzero(atoms)):
        best, best_rank = -1, 2 * n_rows
        for col in range(len(atoms)):
            rank = 2 * rows[col, piled[col]] + (0 if atoms[col] else 1)
            if not chosen[col] and rank < best_rank:
                best, best_rank = col, rank
        if best < 0:
            return
        chosen[best] = True
    for col in range(len(atoms)):
        piled[col] += chosen[col]


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], {GRID}, int64)")
def pile_up(plan: Growing, atoms: Bools, fill: Bools, limit: int) -> Growing:
    """Arrange row after row, from the top, until each target site has its atom in its column."""
    n_rows, n_cols = atoms.shape
    rows = fill_rows(fill)
    piled = np.zeros(n_cols, np.int64)
    chosen = np.empty(n_cols, np.bool_)
    anywhere = np.zeros(n_cols, np.bool_)
    for row in range(n_rows):
        choose_columns(atoms[row], rows, piled, chosen)
        source, goal = settle(atoms[row], chosen, anywhere, False, False)
        for site in source:
            atoms[row, site] = False
        for site in goal:
            atoms[row, site] = True
        plan = add_line(plan, source, goal, n_cols, row, True, limit, 0)
    return plan


@kernel(f"{GROWING}({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_tetris(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int
) -> Growing:
    """Plan the Tetris algorithm.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Maximum number of atoms in a batch that moves along a row.
        column_limit: Maximum number of atoms in a batch that moves along a column.
        slots: Ejection slots on each side.
    """
    n_rows, n_cols = occupied.shape
    atoms = occupied.copy()
    plan = pile_up(empty_plan(atoms.size), atoms, fill, row_limit)
    plan = supply_columns(plan, atoms, column_sums(atoms) - column_sums(fill), row_limit)
    for col in range(n_cols):
        line = atoms[:, col].copy(), fill[:, col].copy(), clear[:, col].copy()
        source, goal = settle(line[0], line[1], line[2], slots > 0, slots > 0)
        plan = add_line(plan, source, goal, n_rows, col, False, column_limit, slots)
    return plan
