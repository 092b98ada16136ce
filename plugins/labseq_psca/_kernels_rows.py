"""Kernels of row sorting: which row next, and which of its atoms change their column."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

LINE: Final = const("bool_", 1)
GRID: Final = const("bool_", 2)
IMPOSSIBLE: Final = 1 << 60

# What changes are worth, in units of one atom moved: README, "Choices".
NEED: Final = 80  # for an atom in a column that lacks one: this plus the number of columns, times its lack,
LACK_COUNTS: Final = 8  # which counts up to here
ON_TARGET: Final = 10  # more for an atom that lands on a fill site, less for one that leaves it
TARGET_COLUMN: Final = 20  # less for an atom that leaves a column with fill sites
EFFORT: Final = 240  # columns looked at closely for each choice, but no fewer than
ROWS_TRIED: Final = 3  # so many rows; more hardly helps
PER_BATCH: Final = 1000  # worth per batch is compared in integers, in thousandths

# Which of equal rows goes first: closest to half filled, or by a factor of its number of atoms.
HALF_FILLED: Final = 0
FULLEST: Final = -1
EMPTIEST: Final = 1


@kernel("int64(int64[::1], int64[::1], int64[::1], int64[::1], int64[::1])")
def weigh_columns(need: Ints, room: Ints, count: Ints, weight: Ints, leave: Ints) -> int:
    """Work out what one atom more or less is worth to each column.

    Args:
        need: int64 (n_cols,), fill sites of the column.
        room: int64 (n_cols,), its sites that may hold an atom.
        count: int64 (n_cols,), its atoms now.
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


@kernel("int64(int64, int64, int64)")
def place_in_order(n_atoms: int, n_sites: int, order: int) -> int:
    """Place of a row in an order; lower goes first."""
    return abs(2 * n_atoms - n_sites) if order == HALF_FILLED else order * n_atoms


@kernel(f"void({GRID}, int64[::1], int64[::1], int64, int64, int64[:, ::1])")
def rank_rows(atoms: Bools, weight: Ints, leave: Ints, limit: int, order: int, rank: Ints) -> None:
    """Bound from above what sorting each row is worth per batch.

    Args:
        atoms: bool (n_rows, n_cols).
        weight: int64 (n_cols,), see :func:`weigh_columns`.
        leave: int64 (n_cols,), likewise.
        limit: Most atoms in a batch.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.
        rank: Result, int64 (n_rows, 2): the bound, and the place in the order.
    """
    n_rows, n_cols = atoms.shape
    for row in range(n_rows):
        n_atoms = n_leavers = n_vacancies = total = 0
        least = IMPOSSIBLE
        for col in range(n_cols):
            if atoms[row, col]:
                n_atoms += 1
                if leave[col] >= 0:
                    n_leavers += 1
            elif weight[col] > 0:
                n_vacancies += 1
                total += weight[col]
                least = min(least, weight[col])
        n_most = min(n_leavers, n_vacancies)
        rank[row, 0] = 0
        rank[row, 1] = place_in_order(n_atoms, n_cols, order)
        if n_most > 0:
            worth = total - (n_vacancies - n_most) * least + (ON_TARGET - 1) * n_most
            rank[row, 0] = worth * PER_BATCH // ((n_most + limit - 1) // limit)


@kernel(f"int64({LINE}, int64[::1], int64[::1], int64[::1], int8[:, ::1], int64[::1])")
def best_exchange(
    atoms: Bools, gain: Ints, cost: Ints, worth: Ints, step: NDArray[np.int8], change: Ints
) -> int:
    """Find the atoms of a row that had best leave their columns, and the vacancies to fill.

    The order is kept, so atoms between a leaver and a filled vacancy shift by one
    place each: atoms move that leave, or whose balance (leavers minus filled
    vacancies to their left) is not zero. A dynamic programme over columns and
    balances finds the exchange that is worth most; of the balances only those are
    looked at that can come about and can be evened out again.

    Args:
        atoms: bool (n,), the row.
        gain: int64 (n,), worth of filling a vacancy; 0 where it is not wanted.
        cost: int64 (n,), cost of an atom's leaving; -1 where it must stay.
        worth: Work space, int64 (> n,).
        step: Work space, int8 (>= n, > n).
        change: Result, int64 (n,): -1 the atom leaves, 1 the vacancy is filled, else 0.

    Returns:
        Gains minus costs minus one for each atom moved.
    """
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


@kernel(f"int64({LINE}, int64[::1])")
def n_moved(atoms: Bools, change: Ints) -> int:
    """Count the atoms of a row that an exchange moves."""
    n = balance = 0
    for col in range(len(atoms)):
        balance -= change[col]
        if atoms[col] and (balance != 0 or change[col] != 0):
            n += 1
    return n


@kernel(f"int64({GRID}, {GRID}, int64[::1], int64[::1], int64, int64, int64[::1], int8[:, ::1], int64[::1])")
def choose_row(
    atoms: Bools,
    fill: Bools,
    weight: Ints,
    leave: Ints,
    limit: int,
    order: int,
    worth: Ints,
    step: NDArray[np.int8],
    change: Ints,
) -> int:
    """Choose the row whose sorting helps most per batch.

    Rows are looked at closely in the order of their bounds, until no bound beats what was found.

    Args:
        atoms: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        weight: int64 (n_cols,), see :func:`weigh_columns`.
        leave: int64 (n_cols,), likewise.
        limit: Most atoms in a batch.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.
        worth: Work space, see :func:`best_exchange`.
        step: Work space, likewise.
        change: Result, int64 (n_cols,), the row's exchange.

    Returns:
        The row, or -1 if no row helps.
    """
    n_rows, n_cols = atoms.shape
    rank = np.empty((n_rows, 2), np.int64)
    gain = np.empty(n_cols, np.int64)
    cost = np.empty(n_cols, np.int64)
    trial = np.empty(n_cols, np.int64)
    rank_rows(atoms, weight, leave, limit, order, rank)
    best = 0
    best_row = -1
    for _ in range(max(ROWS_TRIED, EFFORT // n_cols)):
        row = -1
        for r in range(n_rows):
            if rank[r, 0] > best and (
                row < 0
                or rank[r, 0] > rank[row, 0]
                or (rank[r, 0] == rank[row, 0] and rank[r, 1] < rank[row, 1])
            ):
                row = r
        if row < 0:
            break
        for col in range(n_cols):
            on_target = ON_TARGET if fill[row, col] else 0
            gain[col] = weight[col] + on_target if weight[col] > 0 else 0
            cost[col] = leave[col] + on_target if leave[col] >= 0 else -1
        total = best_exchange(atoms[row], gain, cost, worth, step, trial)
        n_batches = (n_moved(atoms[row], trial) + limit - 1) // limit
        if total * PER_BATCH > best * n_batches:
            best = total * PER_BATCH // n_batches
            best_row = row
            for col in range(n_cols):
                change[col] = trial[col]
        rank[row, 0] = 0
    return best_row


@kernel("int64(bool_[::1], int64[::1], int64[::1], int64[::1])")
def exchange(atoms: Bools, change: Ints, source: Ints, goal: Ints) -> int:
    """Carry out an exchange.

    Args:
        atoms: bool (n,), the row; updated.
        change: int64 (n,), see :func:`best_exchange`.
        source: Result, int64 (n,), where its atoms are, ascending.
        goal: Result, int64 (n,), where they go, ascending.

    Returns:
        Number of atoms in the row.
    """
    n_atoms = n_goals = 0
    for col in range(len(atoms)):
        if atoms[col]:
            source[n_atoms] = col
            n_atoms += 1
        if change[col] != 0:
            atoms[col] = change[col] > 0
        if atoms[col]:
            goal[n_goals] = col
            n_goals += 1
    return n_atoms


@kernel(f"UniTuple(int64, 3)({GRID}, int64[::1], int64[::1])")
def choose_unlocking(atoms: Bools, weight: Ints, leave: Ints) -> tuple[int, int, int]:
    """Find the shortest move within a column after which some row can be sorted.

    Needed when columns lack atoms, yet no row holds both an atom to spare and a
    vacancy to fill. In the rows with such a vacancy the columns with atoms to spare
    are then empty too, and the nearest of their atoms has a free path there.

    Args:
        atoms: bool (n_rows, n_cols).
        weight: int64 (n_cols,), see :func:`weigh_columns`.
        leave: int64 (n_cols,), likewise.

    Returns:
        The column (-1 if there is none), the row of the atom, the row where it goes.
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
    return column, start, end
