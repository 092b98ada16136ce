"""Kernels of the variant as in the paper's text: each row is sorted once, for the columns most in need.

The vocabulary is that of :mod:`labseq_psca.kernels_lines` and :mod:`labseq_psca.kernels_rows`.
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


@helper_kernel("int64[::1](bool_[:, ::1], int64)")
def order_of_rows(atoms: Bools, order: int) -> Ints:
    """The rows in the order in which they are sorted; of equal ones the upper first."""
    n_rows, n_cols = atoms.shape
    rows = np.empty(n_rows, np.int64)
    place = np.empty(n_rows, np.int64)
    for row in range(n_rows):
        n_atoms = 0
        for col in range(n_cols):
            n_atoms += atoms[row, col]
        its_place = place_in_order(n_atoms, n_cols, order)
        i = row
        while i > 0 and place[i - 1] > its_place:
            place[i], rows[i] = place[i - 1], rows[i - 1]
            i -= 1
        place[i], rows[i] = its_place, row
    return rows


@helper_kernel("int64(bool_[::1], int64[::1], int64[::1], int64[::1])")
def exchange_for_need(row: Bools, need: Ints, count: Ints, change: Ints) -> int:
    """Give atoms of a row to the columns that lack most, from the columns that have most to spare.

    Of equal columns the left one comes first.

    Args:
        row: bool (n_cols,), the row's atoms.
        need: int64 (n_cols,), fill sites of each column.
        count: int64 (n_cols,), its atoms.
        change: Result, int64 (n_cols,), the exchange.

    Returns:
        How many columns are helped.
    """
    change[:] = 0
    n = 0
    while True:
        taker = giver = -1
        for col in range(len(row)):
            if change[col] != 0:
                continue
            spare = count[col] - need[col]
            if not row[col] and spare < 0 and (taker < 0 or spare < count[taker] - need[taker]):
                taker = col
            if row[col] and spare > 0 and (giver < 0 or spare > count[giver] - need[giver]):
                giver = col
        if taker < 0 or giver < 0:
            return n
        change[taker], change[giver] = 1, -1
        n += 1


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], {GRID}, {GRID}, int64, int64)")
def sort_rows(plan: Growing, atoms: Bools, fill: Bools, clear: Bools, limit: int, order: int) -> Growing:
    """Sort each row once, then those again that can still help, until every column has enough.

    Where no row can help a column that lacks atoms, an atom moves within another column first.
    Updates ``atoms``.
    """
    n_cols = atoms.shape[1]
    need, room, count = count_columns(atoms, fill, clear)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    line = np.empty((2, n_cols), np.int64)
    while weigh_columns(need, room, count, weight, leave) > 0:
        n_batches = plan[2]
        for row in order_of_rows(atoms, order):
            if exchange_for_need(atoms[row], need, count, change) > 0:
                plan = sort_row(plan, atoms, row, change, count, line, limit)
        if plan[2] == n_batches:
            plan = unlock_row(plan, atoms, weight, leave)
        if plan[2] == n_batches:
            break
    return plan


@kernel(f"{FINISHED}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_as_in_paper(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> Finished:
    """Plan row sorting and column compression.

    Arguments as for :func:`labseq_psca.kernels_fewest.plan_fewest`.
    """
    atoms = occupied.copy()
    plan = sort_rows(empty_plan(atoms.size), atoms, fill, clear, row_limit, order)
    return finished(compress_columns(plan, atoms, fill, clear, column_limit, slots), False)
