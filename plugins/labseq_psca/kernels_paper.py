"""Kernels of the variant as in the paper: each row sort helps one column.

The vocabulary is that of :mod:`labseq_psca.kernels_lines` and :mod:`labseq_psca.kernels_rows`.
``spare``, int64 (n_cols,), is the number of atoms that a column has too many, above 0, or
too few, below 0; 0 if it takes no part.
"""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq_psca.kernels_lines import (
    FINISHED,
    GRID,
    GROWING,
    Bools,
    Finished,
    Growing,
    Ints,
    compress_columns,
    empty_plan,
    finished,
)
from labseq_psca.kernels_rows import count_columns, place_in_order, sort_row, unlock_row, weigh_columns


@helper_kernel("int64(bool_[::1], int64[::1], int64[::1], int64)")
def partner(row: Bools, need: Ints, spare: Ints, col: int) -> int:
    """Find the column that exchanges an atom with another one in a row.

    An atom comes from the most distant of the target's columns that have too many,
    otherwise from the most distant other one: of the rules that were tried, with this one
    the numbers of batches come nearest to the paper's. An atom goes to the nearest column.

    Args:
        row: bool (n_cols,), the row's atoms.
        need: int64 (n_cols,), fill sites of the column.
        spare: int64 (n_cols,).
        col: The other column: with a vacancy it needs an atom, with an atom a vacancy.

    Returns:
        The column, of equal ones the left one; -1 if there is none.
    """
    n_cols, needs_atom = len(row), not row[col]
    best, best_rank = -1, 0
    for other in range(n_cols):
        away = abs(other - col)
        if needs_atom:
            fits = row[other] & (spare[other] > 0)
            rank = away + (n_cols if need[other] > 0 else 0)
        else:
            fits = (not row[other]) & (spare[other] < 0)
            rank = n_cols - away
        if fits and rank > best_rank:
            best, best_rank = other, rank
    return best


@helper_kernel("UniTuple(int64, 2)(bool_[:, ::1], int64[::1], int64[::1], int64, int64)")
def first_row(atoms: Bools, need: Ints, spare: Ints, col: int, order: int) -> tuple[int, int]:
    """Find the first row, by an order, in which a column can exchange an atom.

    The column ``col`` needs an atom if its ``spare`` is below 0, otherwise a vacancy.

    Returns:
        The row and the other column, or (-1, -1).
    """
    n_rows, n_cols = atoms.shape
    row = other = -1
    first = 0
    for r in range(n_rows):
        if atoms[r, col] == (spare[col] < 0):
            continue
        n_atoms = 0
        for c in range(n_cols):
            n_atoms += atoms[r, c]
        place = place_in_order(n_atoms, n_cols, order)
        if row >= 0 and place >= first:
            continue
        found = partner(atoms[r], need, spare, col)
        if found >= 0:
            row, other, first = r, found, place
    return row, other


@helper_kernel("int64(int64[::1], int64[::1], int64[::1], int64[::1])")
def column_in_need(need: Ints, room: Ints, count: Ints, spare: Ints) -> int:
    """Find the column that lacks most atoms; if none does, the target's column with most too many.

    Works out ``spare``. Returns -1 if all columns of the target hold what they need.
    """
    lacking = crowded = -1
    for col in range(len(need)):
        spare[col] = count[col] - need[col]
        if spare[col] < 0 and (lacking < 0 or spare[col] < spare[lacking]):
            lacking = col
        if spare[col] > 0 and need[col] > 0 and (crowded < 0 or spare[col] > spare[crowded]):
            crowded = col
    if lacking < 0 and crowded >= 0:
        for col in range(len(need)):
            if need[col] == 0:
                spare[col] = min(0, count[col] - room[col])
    return lacking if lacking >= 0 else crowded


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], {GRID}, {GRID}, int64, int64)")
def sort_rows(plan: Growing, atoms: Bools, fill: Bools, clear: Bools, limit: int, order: int) -> Growing:
    """Sort rows until every column of the target holds as many atoms as it has fill sites, no more.

    Each sort helps one column. Where none can help a column that lacks atoms, an
    atom moves within another column first; columns that cannot get rid of their
    surplus keep it. Updates ``atoms``.
    """
    n_cols = atoms.shape[1]
    need, room, count = count_columns(atoms, fill, clear)
    spare = np.empty(n_cols, np.int64)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    line = np.empty((2, n_cols), np.int64)
    while True:
        col = column_in_need(need, room, count, spare)
        if col < 0:
            return plan
        row, other = first_row(atoms, need, spare, col, order)
        n_batches = plan[2]
        if row >= 0:
            change[:] = 0
            change[col], change[other] = (1, -1) if spare[col] < 0 else (-1, 1)
            plan = sort_row(plan, atoms, row, change, count, line, limit)
        elif weigh_columns(need, room, count, weight, leave) > 0:
            worth = weight[col]
            weight[:] = 0
            weight[col] = worth
            plan = unlock_row(plan, atoms, weight, leave)
        if plan[2] == n_batches:
            return plan


@kernel(f"{FINISHED}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_as_in_paper(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> Finished:
    """Plan row sorting, one column at a time, and column compression.

    Arguments as for :func:`labseq_psca.kernels_fewest.plan_fewest`.
    """
    atoms = occupied.copy()
    plan = sort_rows(empty_plan(atoms.size), atoms, fill, clear, row_limit, order)
    return finished(compress_columns(plan, atoms, fill, clear, column_limit, slots), False)
