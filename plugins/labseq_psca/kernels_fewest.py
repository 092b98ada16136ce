"""Kernels of the generalised PSCA, which sorts rows to help all columns and compares both orientations.

Its plans have fewer batches than the plans of :mod:`labseq_psca.kernels_paper`, as in the paper's text.

Everything is written for row sorting and then column compression. The other orientation is the same on the
transposed grid. Names are as in :mod:`labseq_psca.kernels_lines`. ``need``, ``room`` and ``count``, int64
(n_cols,), are the fill sites of each column, its sites that may hold an atom, and its atoms now.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    GROWING_PLAN,
    FinishedPlan,
    GrowingPlan,
    column_sums,
    count_moves,
    empty_plan,
    finished,
    unlock_row,
)
from labseq_psca.kernels_lines import (
    GRID,
    IMPOSSIBLE,
    Bools,
    Ints,
    compress_columns,
    place_in_order,
    sort_row,
)

# Worth of changes in units of one atom moved, see docs/explanation/psca.md, "Choices".
NEED: Final = 80  # for an atom in a column that lacks atoms, this plus the number of columns, times its lack,
LACK_COUNTS: Final = 8  # which counts up to here
TARGET_COLUMN: Final = 20  # subtracted for an atom that leaves a column with fill sites
ON_TARGET: Final = 10  # added for an atom that lands on a fill site, subtracted if it leaves a fill site
EFFORT: Final = 240  # columns looked at closely for each choice, but no fewer than
ROWS_TRIED: Final = 3  # number of rows, more hardly helps
PLACES: Final = 1 << 20  # more than twice any place in an order
PER_BATCH: Final = 1000  # worth per batch is compared in integers, in thousandths

Work = tuple[Ints, NDArray[np.int8], Ints, Ints]
"""int64 (> n_cols,) and int8 (n_cols, > n_cols) for an exchange, and int64 (3, n_cols) and (n_rows,)."""


@helper_kernel()
def weigh_columns(need: Ints, room: Ints, count: Ints, weight: Ints, leave: Ints) -> int:
    """Compute the worth of an atom more or less for each column.

    Args:
        need: See the module.
        room: See the module.
        count: See the module.
        weight: Result, int64 (n_cols,), worth of one atom more, 0 if it lacks none.
        leave: Result, int64 (n_cols,), cost of one atom less, -1 if it can spare none.

    Returns:
        Number of atoms that all columns lack.
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
def rank_rows(atoms: Bools, weight: Ints, leave: Ints, limit: int, order: int, rank: Ints) -> None:
    """Compute an upper bound for the worth of sorting each row, per batch.

    The result, int64 (n_rows,), is the bound times PLACES, plus more for rows that come first in the order,
    or 0 for rows that cannot help. ``weight`` and ``leave`` come from :func:`weigh_columns`.
    """
    n_rows, n_cols = atoms.shape
    for row in range(n_rows):
        n_atoms = n_leavers = n_vacancies = total = 0
        least = IMPOSSIBLE
        for col in range(n_cols):  # without branches, which would be mispredicted
            atom = atoms[row, col]
            wanted = (weight[col] > 0) & (not atom)
            n_atoms += atom
            n_leavers += atom & (leave[col] >= 0)
            n_vacancies += wanted
            total += weight[col] if wanted else 0
            least = min(least, weight[col] if wanted else IMPOSSIBLE)
        n_most = min(n_leavers, n_vacancies)
        rank[row] = 0
        if n_most > 0:
            worth = total - (n_vacancies - n_most) * least + (ON_TARGET - 1) * n_most
            bound = worth * PER_BATCH // ((n_most + limit - 1) // limit)
            rank[row] = bound * PLACES + PLACES // 2 - place_in_order(n_atoms, n_cols, order)


@helper_kernel()
def best_exchange(atoms: Bools, gain: Ints, cost: Ints, work: Work, change: Ints) -> int:
    """Find the atoms of a row that should leave their columns, and the vacancies to fill.

    The order is kept, so atoms between a leaver and a filled vacancy shift by one place each. An atom moves
    if it leaves, or if its balance (leavers minus filled vacancies to its left) is not zero. A dynamic
    programme over columns and balances finds the exchange of highest worth. It looks only at balances that
    can occur and can return to zero.

    Args:
        atoms: bool (n,), the row.
        gain: int64 (n,), worth of filling a vacancy, 0 where it is not wanted.
        cost: int64 (n,), cost of an atom's leaving, -1 where it must stay.
        work: Scratch arrays.
        change: Result, int64 (n,), the exchange.

    Returns:
        Gains minus costs minus one for each atom moved.
    """
    worth, step, _, _ = work
    n = len(atoms)
    leavers_left = vacancies_left = 0
    for col in range(n):
        change[col] = 0
        leavers_left += atoms[col] and cost[col] >= 0
        vacancies_left += not atoms[col] and gain[col] > 0
    even = min(leavers_left, vacancies_left)
    if even == 0:
        return 0
    for i in range(2 * even + 1):
        worth[i] = -IMPOSSIBLE
    worth[even] = 0
    low = high = even
    leavers = vacancies = 0
    for col in range(n):
        can_leave = atoms[col] and cost[col] >= 0
        can_fill = not atoms[col] and gain[col] > 0
        leavers += can_leave
        leavers_left -= can_leave
        vacancies += can_fill
        vacancies_left -= can_fill
        low, high = even - min(vacancies, leavers_left), even + min(leavers, vacancies_left)
        if can_fill:
            for i in range(low, high + 1):
                filling = worth[i + 1] + gain[col] if i < 2 * even else -IMPOSSIBLE
                step[col, i] = filling > worth[i]
                worth[i] = max(filling, worth[i])
        elif can_leave:
            for i in range(high, low - 1, -1):
                leaving = worth[i - 1] - cost[col] - 1 if i > 0 else -IMPOSSIBLE
                staying = worth[i] - (i != even)
                step[col, i] = -1 if leaving > staying else 0
                worth[i] = max(leaving, staying)
        elif atoms[col]:
            for i in range(low, high + 1):
                worth[i] -= i != even
    i = even
    for col in range(n - 1, -1, -1):
        if (atoms[col] and cost[col] >= 0) or (not atoms[col] and gain[col] > 0):
            change[col] = step[col, i]
            i += step[col, i]
    return int(worth[even])


@helper_kernel()
def n_moved(atoms: Bools, change: Ints) -> int:
    """Count the atoms of a row that an exchange moves."""
    n = balance = 0
    for col in range(len(atoms)):
        balance -= change[col]
        if atoms[col] and (balance != 0 or change[col] != 0):
            n += 1
    return n


@helper_kernel()
def choose_row(
    atoms: Bools, fill: Bools, weight: Ints, leave: Ints, limit: int, order: int, work: Work, change: Ints
) -> int:
    """Choose the row whose sorting helps most per batch, and find its exchange.

    Rows are examined in the order of their bounds, until no bound is above the best worth.

    Returns:
        The row, or -1 if no row helps.
    """
    n_cols = atoms.shape[1]
    _, _, lists, rank = work
    gain, cost, trial = lists[0], lists[1], lists[2]
    rank_rows(atoms, weight, leave, limit, order, rank)
    best = 0
    best_row = -1
    for _ in range(max(ROWS_TRIED, EFFORT // n_cols)):
        row = 0
        for other in range(1, len(rank)):
            if rank[other] > rank[row]:
                row = other
        if rank[row] // PLACES <= best:
            break
        for col in range(n_cols):
            on_target = ON_TARGET if fill[row, col] else 0
            gain[col] = weight[col] + on_target if weight[col] > 0 else 0
            cost[col] = leave[col] + on_target if leave[col] >= 0 else -1
        total = best_exchange(atoms[row], gain, cost, work, trial)
        n_batches = (n_moved(atoms[row], trial) + limit - 1) // limit
        if total * PER_BATCH > best * n_batches:
            best = total * PER_BATCH // n_batches
            best_row = row
            for col in range(n_cols):
                change[col] = trial[col]
        rank[row] = 0
    return best_row


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, bool_[:, ::1], {GRID}, {GRID}, int64, int64)")
def sort_rows(
    plan: GrowingPlan, atoms: Bools, fill: Bools, clear: Bools, limit: int, order: int
) -> GrowingPlan:
    """Sort rows until every column has at least as many atoms as fill sites. Updates ``atoms``."""
    n_rows, n_cols = atoms.shape
    need, room, count = column_sums(fill), n_rows - column_sums(clear), column_sums(atoms)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    work = (
        np.empty(n_cols + 1, np.int64),
        np.empty((n_cols, n_cols + 1), np.int8),
        np.empty((3, n_cols), np.int64),
        np.empty(n_rows, np.int64),
    )
    while weigh_columns(need, room, count, weight, leave) > 0:
        row = choose_row(atoms, fill, weight, leave, limit, order, work, change)
        n_moves = count_moves(plan)
        if row >= 0:
            plan = sort_row(plan, atoms, row, change, count, limit)
        else:
            plan = unlock_row(plan, atoms, count - need)
        if count_moves(plan) == n_moves:
            break
    return plan


@helper_kernel(f"int64({GRID}, {GRID}, {GRID}, int64)")
def least_batches(atoms: Bools, fill: Bools, clear: Bools, limit: int) -> int:
    """Minimum number of batches for the compression of all columns, after row sorting."""
    n_rows, n_cols = atoms.shape
    vacant = np.zeros(n_cols, np.int64)
    surplus = np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            vacant[col] += fill[row, col] and not atoms[row, col]
            surplus[col] += clear[row, col] and atoms[row, col]
    n = 0
    for col in range(n_cols):
        n += (max(vacant[col], surplus[col]) + limit - 1) // limit
    return n


@helper_kernel()
def transposed(sites: Bools) -> Bools:
    """Swap rows and columns, into a contiguous array."""
    n_rows, n_cols = sites.shape
    swapped = np.empty((n_cols, n_rows), np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            swapped[col, row] = sites[row, col]
    return swapped


@helper_kernel()
def costs(plan: GrowingPlan) -> tuple[int, int, int]:
    """Number of batches, number of atom moves, and total distance in sites."""
    moves, _, _, n_batches = plan
    n_moves, distance = count_moves(plan), 0
    for i in range(n_moves):
        distance += int(abs(moves[i, 2] - moves[i, 0])) + int(abs(moves[i, 3] - moves[i, 1]))
    return n_batches, n_moves, distance


@helper_kernel()
def finished_swapped(plan: GrowingPlan) -> FinishedPlan:
    """Cut a plan of the transposed grid to its batches, and swap its rows and columns back."""
    moves, offsets, linked = finished(plan)
    for move in moves:
        move[0], move[1], move[2], move[3] = move[1], move[0], move[3], move[2]
    return moves, offsets, linked


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_fewest(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> FinishedPlan:
    """Plan both orientations and keep the plan with fewer batches, then atom moves, then distance.

    The orientation that promises fewer batches after sorting is completed first, and the other only if it can
    still be as good.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Maximum number of atoms in a batch that moves along a row.
        column_limit: Maximum number of atoms in a batch that moves along a column.
        slots: Ejection slots on each side.
        order: Which of equal rows goes first, as in :func:`labseq_psca.kernels_lines.place_in_order`.
    """
    atoms = occupied.copy()
    other_atoms, other_fill, other_clear = transposed(occupied), transposed(fill), transposed(clear)
    plan = sort_rows(empty_plan(2 * atoms.size), atoms, fill, clear, row_limit, order)
    other = sort_rows(empty_plan(2 * atoms.size), other_atoms, other_fill, other_clear, column_limit, order)
    least = plan[3] + least_batches(atoms, fill, clear, column_limit)
    other_least = other[3] + least_batches(other_atoms, other_fill, other_clear, row_limit)
    if least <= other_least:
        plan = compress_columns(plan, atoms, fill, clear, column_limit, slots)
        if plan[3] < other_least:
            return finished(plan)
    other = compress_columns(other, other_atoms, other_fill, other_clear, row_limit, slots)
    if least > other_least:
        if other[3] < least:
            return finished_swapped(other)
        plan = compress_columns(plan, atoms, fill, clear, column_limit, slots)
    return finished(plan) if costs(plan) <= costs(other) else finished_swapped(other)
