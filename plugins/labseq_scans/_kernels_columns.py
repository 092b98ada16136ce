"""Kernels that work on columns: how many atoms they hold and need, and moves from column to column."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_scans._kernels_lines import GRID, GROWING, LINE, Growing, Log, add_line, record, sites_of

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@kernel(f"int64[::1]({GRID})")
def column_sums(sites: Bools) -> Ints:
    """Count the marked sites of each column."""
    total = np.zeros(sites.shape[1], np.int64)
    for row in range(sites.shape[0]):
        for col in range(sites.shape[1]):
            total[col] += sites[row, col]
    return total


@kernel(f"UniTuple(int64, 2)({LINE}, int64[::1])")
def nearest_exchange(atoms: Bools, spare: Ints) -> tuple[int, int]:
    """Find the nearest atom and vacancy of a row of which the one can be spared and the other is lacking.

    Args:
        atoms: bool (n_cols,), the row.
        spare: int64 (n_cols,), atoms that the column can spare; below 0: that it lacks.

    Returns:
        The atom's column and the vacancy's; (-1, ``n_cols``) if there are none.
    """
    best_atom, best_vacancy = -1, len(atoms)
    atom = vacancy = -1
    for col in range(len(atoms)):
        if atoms[col] and spare[col] > 0:
            atom = col
        elif not atoms[col] and spare[col] < 0:
            vacancy = col
        else:
            continue
        if min(atom, vacancy) >= 0 and abs(atom - vacancy) < abs(best_atom - best_vacancy):
            best_atom, best_vacancy = atom, vacancy
    return best_atom, best_vacancy


@kernel(f"int64({GRID}, int64[::1])")
def row_of_nearest_exchange(atoms: Bools, spare: Ints) -> int:
    """Find the row with the nearest exchange; -1 if no row has one.

    Args:
        atoms: bool (n_rows, n_cols).
        spare: int64 (n_cols,), see :func:`nearest_exchange`.
    """
    best_row, best = -1, len(spare) + 1
    for row in range(len(atoms)):
        atom, vacancy = nearest_exchange(atoms[row], spare)
        if abs(atom - vacancy) < best:
            best_row, best = row, abs(atom - vacancy)
    return best_row


@kernel(f"UniTuple(int64, 3)({GRID}, int64[::1])")
def nearest_unlocking(atoms: Bools, spare: Ints) -> tuple[int, int, int]:
    """Find the shortest move within a column after which a row has an exchange.

    Needed where no row holds both an atom to spare and a vacancy to fill. In the
    rows with such a vacancy the columns with atoms to spare are then empty, so the
    nearest of their atoms has a free path there.

    Args:
        atoms: bool (n_rows, n_cols), with no exchange.
        spare: int64 (n_cols,), see :func:`nearest_exchange`.

    Returns:
        The column (-1 if there is none), the row of the atom, the row where it goes.
    """
    n_rows, n_cols = atoms.shape
    lacking = np.zeros(n_rows, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            if spare[col] < 0 and not atoms[row, col]:
                lacking[row] = True
    best_col, best_atom, best_goal = -1, 0, n_rows
    for col in range(n_cols):
        atom = goal = -1
        for row in range(n_rows if spare[col] > 0 else 0):
            if atoms[row, col]:
                atom = row
            elif lacking[row]:
                goal = row
            if min(atom, goal) >= 0 and abs(atom - goal) < abs(best_atom - best_goal):
                best_col, best_atom, best_goal = col, atom, goal
    return best_col, best_atom, best_goal


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], int64[::1], int64)")
def supply_columns(log: Log, n_moves: int, n_batches: int, atoms: Bools, spare: Ints, limit: int) -> Growing:
    """Give every column as many atoms as it needs, row by row, the row with the nearest exchange first.

    In a row all exchanges are made that there are, the nearest first. Its atoms
    keep their order: those between go on to the place of the next.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), no fewer than the columns need; updated.
        spare: int64 (n_cols,), see :func:`nearest_exchange`; updated.
        limit: Most atoms in a batch.
    """
    n_cols = len(spare)
    source = np.empty(n_cols, np.int64)
    goal = np.empty(n_cols, np.int64)
    while spare.min() < 0:
        row = row_of_nearest_exchange(atoms, spare)
        if row >= 0:
            n_atoms = sites_of(atoms[row], source)
            col, to_col = nearest_exchange(atoms[row], spare)
            while col >= 0:
                atoms[row, col], atoms[row, to_col] = False, True
                spare[col] -= 1
                spare[to_col] += 1
                col, to_col = nearest_exchange(atoms[row], spare)
            sites_of(atoms[row], goal)
            log, n_moves, n_batches = add_line(
                log, n_moves, n_batches, source, goal, n_atoms, n_cols, row, True, limit, 0
            )
            continue
        col, row, to_row = nearest_unlocking(atoms, spare)
        if col < 0:
            break
        atoms[row, col], atoms[to_row, col] = False, True
        log = record(log, n_moves, n_batches, row, col, to_row, col)
        n_moves += 1
        n_batches += 1
    return log, n_moves, n_batches
