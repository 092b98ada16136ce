"""Kernels of the Tetris algorithm: rows are piled up, then columns are compressed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_scans._kernels_columns import column_sums, supply_columns
from labseq_scans._kernels_lines import GRID, GROWING, Growing, Log, add_line, settle

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@kernel(f"int64[:, ::1]({GRID})")
def fill_rows(fill: Bools) -> Ints:
    """List the rows of each column's fill sites.

    Args:
        fill: bool (n_rows, n_cols).

    Returns:
        int64 (n_cols, n_rows + 1): rows, ascending; ``n_rows`` after the last.
    """
    n_rows, n_cols = fill.shape
    rows = np.full((n_cols, n_rows + 1), n_rows, np.int64)
    for col in range(n_cols):
        n = 0
        for row in range(n_rows):
            if fill[row, col]:
                rows[col, n] = row
                n += 1
    return rows


@kernel("void(bool_[::1], int64[:, ::1], int64[::1], bool_[::1])")
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


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], {GRID}, int64)")
def pile_up(log: Log, n_moves: int, n_batches: int, atoms: Bools, fill: Bools, limit: int) -> Growing:
    """Arrange row after row, from the top, until each target site has its atom in its column.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols); updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        limit: Most atoms in a batch.
    """
    n_rows, n_cols = atoms.shape
    rows = fill_rows(fill)
    piled = np.zeros(n_cols, np.int64)
    chosen = np.empty(n_cols, np.bool_)
    anywhere = np.zeros(n_cols, np.bool_)
    source = np.empty(n_cols, np.int64)
    goal = np.empty(n_cols, np.int64)
    for row in range(n_rows):
        choose_columns(atoms[row], rows, piled, chosen)
        n_atoms = settle(atoms[row], chosen, anywhere, False, False, source, goal)
        for i in range(n_atoms):
            atoms[row, source[i]] = False
        for i in range(n_atoms):
            atoms[row, goal[i]] = True
        log, n_moves, n_batches = add_line(
            log, n_moves, n_batches, source, goal, n_atoms, n_cols, row, True, limit, 0
        )
    return log, n_moves, n_batches


@kernel(f"Tuple(({GROWING}))({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_tetris(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int
) -> Growing:
    """Plan the Tetris algorithm.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        slots: Ejection slots on each side.

    Returns:
        The log of atom moves, int32 (>= n_moves, 5), ``n_moves``, and the number of batches.
    """
    n_rows, n_cols = occupied.shape
    atoms = occupied.copy()
    log = np.empty((2 * occupied.size, 5), np.int32)
    log, n_moves, n_batches = pile_up(log, 0, 0, atoms, fill, row_limit)
    spare = column_sums(atoms) - column_sums(fill)
    log, n_moves, n_batches = supply_columns(log, n_moves, n_batches, atoms, spare, row_limit)
    source = np.empty(n_rows, np.int64)
    goal = np.empty(n_rows, np.int64)
    for col in range(n_cols):
        n_atoms = settle(
            atoms[:, col].copy(),
            fill[:, col].copy(),
            clear[:, col].copy(),
            slots > 0,
            slots > 0,
            source,
            goal,
        )
        log, n_moves, n_batches = add_line(
            log, n_moves, n_batches, source, goal, n_atoms, n_rows, col, False, column_limit, slots
        )
    return log, n_moves, n_batches
