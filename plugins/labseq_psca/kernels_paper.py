"""Kernels of the variant as in the paper's text, which sorts each row once for the columns most in need.

Names are as in :mod:`labseq_psca.kernels_lines`.
"""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    FinishedPlan,
    GrowingPlan,
    column_sums,
    count_moves,
    empty_plan,
    finished,
    unlock_row,
)
from labseq_psca.kernels_lines import GRID, Bools, Ints, compress_columns, place_in_order, sort_row


@helper_kernel()
def order_of_rows(atoms: Bools, order: int) -> Ints:
    """The rows in the order in which they are sorted, with the upper of equal rows first."""
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


@helper_kernel()
def exchange_for_need(row: Bools, need: Ints, count: Ints, change: Ints) -> int:
    """Give atoms of a row to the columns that lack most, from the columns that have most to spare.

    The left of equal columns comes first.

    Args:
        row: bool (n_cols,), the row's atoms.
        need: int64 (n_cols,), fill sites of each column.
        count: int64 (n_cols,), atoms of each column.
        change: Result, int64 (n_cols,), the exchange.

    Returns:
        Number of columns that are helped.
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


@helper_kernel()
def sort_rows(plan: GrowingPlan, atoms: Bools, fill: Bools, limit: int, order: int) -> GrowingPlan:
    """Sort each row once, then again the rows that can still help, until every column has enough.

    Where no row can help a column that lacks atoms, an atom moves within another column first.
    Updates ``atoms``.
    """
    need, count = column_sums(fill), column_sums(atoms)
    change = np.empty(len(need), np.int64)
    while (count < need).any():
        n_moves = count_moves(plan)
        for row in order_of_rows(atoms, order):
            if exchange_for_need(atoms[row], need, count, change) > 0:
                plan = sort_row(plan, atoms, row, change, count, limit)
        if count_moves(plan) == n_moves:
            plan = unlock_row(plan, atoms, count - need)
        if count_moves(plan) == n_moves:
            break
    return plan


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_as_in_paper(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> FinishedPlan:
    """Plan row sorting and column compression.

    Arguments as for :func:`labseq_psca.kernels_fewest.plan_fewest`.
    """
    atoms = occupied.copy()
    plan = sort_rows(empty_plan(2 * atoms.size), atoms, fill, row_limit, order)
    return finished(compress_columns(plan, atoms, fill, clear, column_limit, slots))
