"""Kernels that the row sorts of both variants share.

In all of them ``need``, ``room`` and ``count``, int64 (n_cols,), are the fill sites of
each column, its sites that may hold an atom, and its atoms now. ``change``, int64
(n_cols,), is an exchange of a row's atoms: -1 where an atom leaves its column, 1 where a
vacancy is filled, otherwise 0; the atoms of the row keep their order.
"""

from __future__ import annotations

from typing import Final

from labseq.plugin import helper_kernel
from labseq.plugin.plan_kernels import GrowingPlan, add_line, sites_of
from labseq_psca.kernels_columns import Bools, Ints

NEED: Final = 80  # for an atom in a column that lacks one: this plus the number of columns, times its lack,
LACK_COUNTS: Final = 8  # which counts up to here
TARGET_COLUMN: Final = 20  # less for an atom that leaves a column with fill sites

# Which of equal rows goes first: closest to half filled, or by a factor of its number of atoms.
HALF_FILLED: Final = 0
FULLEST: Final = -1
EMPTIEST: Final = 1


@helper_kernel()
def place_in_order(n_atoms: int, n_sites: int, order: int) -> int:
    """Place of a row in an order (HALF_FILLED, FULLEST or EMPTIEST); lower goes first."""
    return abs(2 * n_atoms - n_sites) if order == HALF_FILLED else order * n_atoms


@helper_kernel()
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


@helper_kernel()
def sort_row(plan: GrowingPlan, atoms: Bools, row: int, change: Ints, count: Ints, limit: int) -> GrowingPlan:
    """Carry out an exchange in a row; updates ``atoms`` and ``count``."""
    n_cols = len(change)
    source = sites_of(atoms[row])
    for col in range(n_cols):
        if change[col] != 0:
            atoms[row, col] = change[col] > 0
            count[col] += change[col]
    return add_line(plan, (True, row, n_cols), source, sites_of(atoms[row]), limit, 0)
