"""Kernels that the row sorts of both variants share.

In all of them ``need``, ``room`` and ``count``, int64 (n_cols,), are the fill sites of
each column, its sites that may hold an atom, and its atoms now. ``change``, int64
(n_cols,), is an exchange of a row's atoms: -1 where an atom leaves its column, 1 where a
vacancy is filled, otherwise 0; the atoms of the row keep their order.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq.plugin import helper_kernel
from labseq_psca.kernels_lines import GRID, GROWING, Bools, Growing, Ints, add_line, add_move

NEED: Final = 80  # for an atom in a column that lacks one: this plus the number of columns, times its lack,
LACK_COUNTS: Final = 8  # which counts up to here
TARGET_COLUMN: Final = 20  # less for an atom that leaves a column with fill sites

# Which of equal rows goes first: closest to half filled, or by a factor of its number of atoms.
HALF_FILLED: Final = 0
FULLEST: Final = -1
EMPTIEST: Final = 1


@helper_kernel("int64(int64, int64, int64)")
def place_in_order(n_atoms: int, n_sites: int, order: int) -> int:
    """Place of a row in an order (HALF_FILLED, FULLEST or EMPTIEST); lower goes first."""
    return abs(2 * n_atoms - n_sites) if order == HALF_FILLED else order * n_atoms


@helper_kernel(f"UniTuple(int64[::1], 3)({GRID}, {GRID}, {GRID})")
def count_columns(atoms: Bools, fill: Bools, clear: Bools) -> tuple[Ints, Ints, Ints]:
    """Count the fill sites of each column, its sites that may hold an atom, and its atoms."""
    n_rows, n_cols = atoms.shape
    need = np.zeros(n_cols, np.int64)
    room = np.zeros(n_cols, np.int64)
    count = np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            need[col] += fill[row, col]
            room[col] += not clear[row, col]
            count[col] += atoms[row, col]
    return need, room, count


@helper_kernel("int64(int64[::1], int64[::1], int64[::1], int64[::1], int64[::1])")
def weigh_columns(need: Ints, room: Ints, count: Ints, weight: Ints, leave: Ints) -> int:
    """Work out what one atom more or less is worth to each column.

    Args:
        need: See the module, as for ``room`` and ``count``.
        room: See there.
        count: See there.
        weight: Result, int64 (n_cols,): worth of one more; 0 if it lacks none.
        leave: Result, int64 (n_cols,): cost of one less; -1 if it can spare none.

    Returns:
        How many atoms the columns lack in all.
    """
    n_lacking = 0
    for col in range(len(need)):
        lack = need[col] - count[col]
        weight[col] = 0
        leave[col] = -1
        if lack > 0:
            n_lacking += lack
            weight[col] = (NEED + len(need)) * min(lack, LACK_COUNTS)
        elif lack < 0:
            leave[col] = TARGET_COLUMN if need[col] > 0 and count[col] <= room[col] else 0
    return n_lacking


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], int64, int64[::1], int64[::1], int64[:, ::1], int64)")
def sort_row(
    plan: Growing, atoms: Bools, row: int, change: Ints, count: Ints, work: Ints, limit: int
) -> Growing:
    """Carry out an exchange in a row; updates ``atoms`` and ``count``; ``work`` is int64 (2, n_cols)."""
    n_cols = len(change)
    source, goal = work[0], work[1]
    n_atoms = n_goals = 0
    for col in range(n_cols):
        if atoms[row, col]:
            source[n_atoms] = col
            n_atoms += 1
        if change[col] != 0:
            atoms[row, col] = change[col] > 0
            count[col] += change[col]
        if atoms[row, col]:
            goal[n_goals] = col
            n_goals += 1
    return add_line(plan, source[:n_atoms], goal[:n_atoms], n_cols, row, True, limit, 0)


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], int64[::1], int64[::1])")
def unlock_row(plan: Growing, atoms: Bools, weight: Ints, leave: Ints) -> Growing:
    """Move an atom within its column, the shortest way after which some row can be sorted; updates ``atoms``.

    Needed when columns lack atoms, yet no row holds both an atom to spare and a
    vacancy to fill. In the rows with such a vacancy the columns with atoms to spare
    are then empty too, and the nearest of their atoms has a free path there. Where
    there is no such move the plan stays as it is.
    """
    n_rows, n_cols = atoms.shape
    lacking = np.zeros(n_rows, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            if weight[col] > 0 and not atoms[row, col]:
                lacking[row] = True
    column, start, end = -1, 0, n_rows
    for col in range(n_cols):
        last_atom = last_lacking = -n_rows
        for row in range(n_rows if leave[col] >= 0 else 0):
            if atoms[row, col]:
                last_atom = row
            elif lacking[row]:
                last_lacking = row
            if abs(last_atom - last_lacking) < abs(start - end) and min(last_atom, last_lacking) >= 0:
                column, start, end = col, last_atom, last_lacking
    return plan if column < 0 else add_move(plan, atoms, start, column, end, column)
