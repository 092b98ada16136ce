"""Kernels that choose the rows of a batch.

The *cost* of a batch is the number of atoms that it is expected to lose, for each vacancy that it fills. It
is estimated for all pairs of a source row and a goal row, in both orientations, and computed for the pairs of
lowest cost. As sites are used up, a cost only rises, so a pair is computed again only when it comes first.
Starting from the best pairs, rows are added while the cost falls.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq.plugin import helper_kernel
from labseq_grid.kernels_columns import (
    MAX_ROWS,
    SPARE,
    TOLERANCE,
    UNWANTED,
    VIEW,
    Bytes,
    Floats,
    Ints,
    View,
    choose_columns,
)

# With 1 planning takes 0.7 times as long, and motion from 64 x 64 to 48 x 48 sites 8 % longer.
STARTS: Final = 3
"""Number of pairs of rows to which others are added."""
# With 20 planning of 64 x 64 sites takes a third longer, and plans are as good.
BAND: Final = 10
"""Sources are at most this many columns from their goals, unless nothing else is left."""
# This and the next three shorten the search. They are chosen, not measured.
NEAR: Final = 4
"""Rows that are added are at most this far from the source rows."""
APART: Final = 1
"""Ways of rows that are added differ by at most this from the way of the first row."""
DEAREST: Final = 2.0
"""A pair of rows that costs more than this many times as much as the batch is not added to it."""
RISE: Final = 1.3
"""Prices rise by this factor while there is nothing at the price."""

NOWHERE: Final = 1 << 20
"""Distance where there is no atom."""

Pairs = tuple[Floats, Ints, Floats, Ints, Ints]
"""Pairs of rows of one orientation, with the cost, float64 (n_rows, n_rows), by source and goal, the time
when it was found as in :func:`find_starts`, int64, the same shape, the lowest cost for each source, float64
(n_rows,), the number of the batch that last changed sources and vacancies of each row, int64 (2, n_rows), and
distances of :func:`find_nearest`, int64 (n_rows, n_cols)."""
PAIRS: Final = "Tuple((float64[:, ::1], int64[:, ::1], float64[::1], int64[:, ::1], int64[:, ::1]))"
Batch = tuple[int, Ints, Ints]
"""Orientation, source and goal rows, int64 (2, k), pattern, goal and source of each column, int64 (3, m)."""
State = tuple[tuple[View, Pairs], tuple[View, Pairs]]
"""The grid and its pairs of rows, in both orientations."""
STATE: Final = f"UniTuple(Tuple(({VIEW}, {PAIRS})), 2)"
BATCH: Final = "Tuple((int64, int64[:, ::1], int64[:, ::1]))"


@helper_kernel("void(uint8[:, ::1], int64, int64[:, ::1])")
def find_nearest(source: Bytes, row: int, nearest: Ints) -> None:
    """Distance of each column of a row from the nearest atom of the row that may be taken."""
    n_cols = source.shape[1]
    away = NOWHERE
    for col in range(n_cols):
        away = 0 if source[row, col] in (SPARE, UNWANTED) else away + 1
        nearest[row, col] = away
    away = NOWHERE
    for col in range(n_cols - 1, -1, -1):
        away = 0 if nearest[row, col] == 0 else away + 1
        nearest[row, col] = min(nearest[row, col], away)


@helper_kernel(f"float64({VIEW}, int64, int64, int64[:, ::1])")
def estimate(view: View, row: int, to: int, nearest: Ints) -> float:
    """Estimate the cost of a pair of rows as if each vacancy could have its nearest atom."""
    (_, vacant, unavoidable), limits, costs, work = view
    n, passes = work[0], work[1]
    down, limit, furthest = abs(row - to), min(limits[0], limits[2]), -1
    for col in range(vacant.shape[1]):
        away = nearest[row, col]
        if vacant[to, col] and away <= limits[3]:
            while furthest < away:
                furthest += 1
                n[furthest], passes[furthest] = 0, 0.0
            n[away] += 1
            passes[away] += 2.0 * costs[3] * (down + away) - unavoidable[to, col]
    least, total, atoms = np.inf, 0.0, 0
    for away in range(furthest + 1):
        atoms += n[away]
        total += passes[away]
        if atoms > 0:
            moving = costs[0] + costs[1] * (down + away)
            least = min(least, moving / min(atoms, limit) + total / atoms)
    return least


@helper_kernel(f"{PAIRS}({VIEW})")
def make_pairs(view: View) -> Pairs:
    """Estimate the costs of all pairs of rows."""
    source = view[0][0]
    n_rows, n_cols = source.shape
    cost, when = np.empty((n_rows, n_rows)), np.zeros((n_rows, n_rows), np.int64)
    least, nearest = np.empty(n_rows), np.empty((n_rows, n_cols), np.int64)
    pairs = cost, when, least, np.full((2, n_rows), -1), nearest
    for row in range(n_rows):
        find_nearest(source, row, nearest)
        least[row] = np.inf
        for to in range(n_rows):
            cost[row, to] = estimate(view, row, to, nearest)
            least[row] = min(least[row], cost[row, to])
    return pairs


@helper_kernel(f"void({PAIRS}, int64, int64, float64)")
def set_cost(pairs: Pairs, row: int, to: int, value: float) -> None:
    """Set the cost of a pair."""
    cost, _, least, _, _ = pairs
    cost[row, to] = value
    least[row] = np.inf
    for other in range(len(least)):
        least[row] = min(least[row], cost[row, other])


@helper_kernel(f"Tuple((float64, int64, int64))({VIEW}, {PAIRS}, int64[:, ::1], float64, int64[:, ::1])")
def add_rows(view: View, pairs: Pairs, rows: Ints, price: float, columns: Ints) -> tuple[float, int, int]:
    """Choose the columns of a pair of rows, and add rows while the cost falls.

    Returns:
        The cost, and the numbers of rows and columns.
    """
    limits, n_rows = view[1], len(pairs[2])
    cost, m = choose_columns(view, rows, 1, price, columns)
    trial, best_rows = np.empty_like(rows), np.empty_like(rows)
    more = np.empty_like(columns)
    k, way = 1, rows[1, 0] - rows[0, 0]
    while m > 0 and k < min(MAX_ROWS, limits[1], limits[0]):
        before = cost
        low, high = max(0, rows[0, 0] - NEAR), min(n_rows, rows[0, k - 1] + NEAR + 1)
        for row in range(low, high):
            for to in range(max(0, row + way - APART), min(n_rows, row + way + APART + 1)):
                if pairs[0][row, to] > DEAREST * cost or not insert_row(rows, k, row, to, trial):
                    continue
                value, n = choose_columns(view, trial, k + 1, cost, more)
                if value < cost - TOLERANCE:
                    cost, m = value, n
                    copy_columns(more, n, columns)
                    copy_columns(trial, k + 1, best_rows)
        if cost == before:
            break
        k += 1
        copy_columns(best_rows, k, rows)
    return cost, k, m


@helper_kernel("void(int64[:, ::1], int64, int64[:, ::1])")
def copy_columns(columns: Ints, n: int, to: Ints) -> None:
    """Copy the first ``n`` columns."""
    for i in range(len(columns)):
        for j in range(n):
            to[i, j] = columns[i, j]


@helper_kernel("boolean(int64[:, ::1], int64, int64, int64, int64[:, ::1])")
def insert_row(rows: Ints, k: int, row: int, to: int, longer: Ints) -> bool:
    """Insert a source row and its goal row, unless the order of the ``k`` others forbids it."""
    place = 0
    while place < k and rows[0, place] < row:
        place += 1
    for i in range(place):
        longer[0, i], longer[1, i] = rows[0, i], rows[1, i]
    longer[0, place], longer[1, place] = row, to
    for i in range(place, k):
        longer[0, i + 1], longer[1, i + 1] = rows[0, i], rows[1, i]
    above = place == 0 or rows[1, place - 1] < to
    return above and (place == k or (rows[0, place] > row and rows[1, place] > to))


@helper_kernel(f"float64({VIEW}, {PAIRS}, int64, int64, int64, int64[:, ::1])")
def update_cost(view: View, pairs: Pairs, number: int, row: int, to: int, columns: Ints) -> float:
    """Compute the cost of a pair of rows more precisely, in as many steps as it takes to be lowest.

    It is estimated first. Then columns are chosen, at prices that rise until there is a choice.
    """
    cost, when, _, changed, nearest = pairs
    before, now = cost[row, to], 2 * number
    if when[row, to] < 2 * (max(changed[0, row], changed[1, to]) + 1):
        when[row, to] = now
        return max(before, estimate(view, row, to, nearest))
    rows = np.empty((2, 1), np.int64)
    rows[0, 0], rows[1, 0] = row, to
    price = RISE * before
    value, n = choose_columns(view, rows, 1, price, columns)
    if n == 0:
        return price
    when[row, to] = now + 1
    return value


@helper_kernel("int64(float64[::1])")
def lowest(values: Floats) -> int:
    """The index of the lowest value, the first of several."""
    index = 0
    for i in range(1, len(values)):
        if values[i] < values[index]:
            index = i
    return index


@helper_kernel(f"int64({STATE}, int64, int64[:, ::1])")
def find_starts(state: State, number: int, starts: Ints) -> int:
    """Find the pairs of rows of lowest cost.

    A cost that was estimated before batch i is marked with 2 i, and a computed cost with 2 i + 1. It holds
    until a site of the two rows changes.

    Args:
        state: The state before the batch.
        number: Number of the batch.
        starts: Result, int64 (n, 3), orientation, source row and goal row.

    Returns:
        The number of pairs.
    """
    columns, found = np.empty((3, len(state[0][0][3][0])), np.int64), np.empty(len(starts))
    n = 0
    while n < len(starts):
        row, other = lowest(state[0][1][2]), lowest(state[1][1][2])
        a = 0 if state[0][1][2][row] <= state[1][1][2][other] else 1
        if a == 1:
            row = other
        view, pairs = state[a]
        cost, when, _, changed, _ = pairs
        to = lowest(cost[row])
        if cost[row, to] == np.inf:
            break
        if when[row, to] % 2 == 1 and when[row, to] // 2 > max(changed[0, row], changed[1, to]):
            starts[n, 0], starts[n, 1], starts[n, 2], found[n] = a, row, to, cost[row, to]
            set_cost(pairs, row, to, np.inf)  # until all pairs are found
            n += 1
        else:
            set_cost(pairs, row, to, update_cost(view, pairs, number, row, to, columns))
    for i in range(n):
        set_cost(state[starts[i, 0]][1], starts[i, 1], starts[i, 2], found[i])
    return n


@helper_kernel(f"{BATCH}({STATE}, int64)")
def best_batch(state: State, number: int) -> Batch:
    """Find the batch of lowest cost.

    Args:
        state: The state before it.
        number: Its number.

    Returns:
        The batch, without columns if there is none.
    """
    starts = np.empty((STARTS, 3), np.int64)
    best, orientation, best_k, best_m = np.inf, 0, 0, 0
    n_most = len(state[0][0][3][0])
    rows, columns = np.empty((2, MAX_ROWS), np.int64), np.empty((3, n_most), np.int64)
    best_rows, best_columns = np.empty_like(rows), np.empty_like(columns)
    for i in range(find_starts(state, number, starts)):
        rows[0, 0], rows[1, 0] = starts[i, 1], starts[i, 2]
        view, pairs = state[starts[i, 0]]
        price = pairs[0][starts[i, 1], starts[i, 2]] + TOLERANCE
        cost, k, m = add_rows(view, pairs, rows, price, columns)
        if cost < best - TOLERANCE:
            best, orientation, best_k, best_m = cost, starts[i, 0], k, m
            copy_columns(rows, k, best_rows)
            copy_columns(columns, m, best_columns)
    return orientation, best_rows[:, :best_k].copy(), best_columns[:, :best_m].copy()
