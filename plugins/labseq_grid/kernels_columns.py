"""Kernels that choose the columns of a batch whose rows are given.

A batch takes the atoms of ``k`` source rows to as many goal rows, in order, and the atoms of its source
columns to as many goal columns, in order. The content of a column in these rows is a *pattern*, in which bit
i is row i. A source column with pattern a can go to a goal column with the vacancies b if a is part of b.

The cost of a batch is the expected number of atoms lost, less the losses that no way to its vacancies avoids.
In all kernels ``rows``, int64 (2, >= k), are the source rows and the goal rows, ascending, and ``columns``,
int64 (3, n_cols), pattern, goal and source of each column, ascending.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

EMPTY: Final = 0
SPARE: Final = 1
UNWANTED: Final = 2
STAYS: Final = 3

# Chosen: n_bits counts the bits of four.
MAX_ROWS: Final = 4
"""Maximum number of rows of a batch."""
TOLERANCE: Final = 1e-9
"""Losses that differ by less, in atoms, are equal, so that rounding does not decide."""

Lattice = tuple[Bytes, Bytes, Floats]
"""The sites of one orientation, in three arrays (n_rows, n_cols). They hold EMPTY, SPARE, UNWANTED or STAYS,
uint8, 1 where an atom may be dropped off, uint8, and the losses that no way to a vacancy avoids, float64."""
LATTICE: Final = "Tuple((uint8[:, ::1], uint8[:, ::1], float64[:, ::1]))"
Limits = tuple[int, int, int, int]
"""Maximum number of tweezers, rows and columns of a batch, and of columns from a source to its goal."""
LIMITS: Final = "UniTuple(int64, 4)"
Costs = tuple[float, float, float, float, float]
"""Expected losses of a batch without ways, of one site of its longest way, of a further stage of its
drop-off, of one site of the way of a tweezer (its atom costs as much again), and of taking an atom that might
stay where others must go."""
COSTS: Final = "UniTuple(float64, 5)"
Work = tuple[Ints, Floats, Floats, NDArray[np.int16], Ints, Floats, Floats]
"""Scratch arrays of :func:`workspace`."""
WORK: Final = (
    "Tuple((int64[::1], float64[::1], float64[::1], int16[:, ::1], int64[::1], float64[::1], float64[::1]))"
)
View = tuple[Lattice, Limits, Costs, Work]
"""One orientation of the grid, with rows and columns as they are, or swapped."""
VIEW: Final = f"Tuple(({LATTICE}, {LIMITS}, {COSTS}, {WORK}))"


@helper_kernel(f"{WORK}(int64)")
def workspace(n: int) -> Work:
    """Scratch arrays of :func:`match_columns` for lines of up to ``n`` sites.

    These are the pattern of each source column, -1 if an atom stays in it, int64 (n,), the gain of its atoms
    to spare, float64 (n,), the highest gain with sources before a column, float64 (n + 1,), the last source
    of this gain, for each goal, int16 (n, n + 1), the goals, int64 (n,), the gain of each pattern, float64,
    and the costs of the columns, float64 (n,).
    """
    return (
        np.empty(n, np.int64),
        np.empty(n),
        np.empty(n + 1),
        np.empty((n, n + 1), np.int16),
        np.empty(n, np.int64),
        np.empty(1 << MAX_ROWS),
        np.empty(n),
    )


@helper_kernel("int64(int64)")
def n_bits(pattern: int) -> int:
    """Count the bits of a pattern of at most 4 rows."""
    twos = pattern - ((pattern >> 1) & 0x5)
    return (twos & 0x3) + ((twos >> 2) & 0x3)


@helper_kernel(f"void({VIEW}, int64[:, ::1], int64)")
def read_sources(view: View, rows: Ints, k: int) -> None:
    """Read the patterns of the source columns, and the gain of their atoms to spare."""
    (source, _, _), _, costs, work = view
    for col in range(source.shape[1]):
        pattern, gain = 0, 0.0
        for i in range(k):
            atom = source[rows[0, i], col]
            if atom == STAYS:
                pattern = -1
                break
            pattern |= int(atom != EMPTY) << i
            gain -= costs[4] if atom == SPARE else 0.0
        work[0][col], work[1][col] = pattern, gain


@helper_kernel(f"int64({VIEW}, int64[:, ::1], int64, int64, float64)")
def read_goal(view: View, rows: Ints, k: int, col: int, price: float) -> int:
    """Compute the gain of each pattern in a goal column, less the cost of the ways along columns.

    Returns:
        The pattern of its vacancies. The gains of other patterns are meaningless.
    """
    (_, vacant, unavoidable), _, costs, work = view
    vacancies, gains = 0, work[5]
    gains[0] = 0.0
    for i in range(k):
        row = rows[1, i]
        ways = costs[3] * abs(rows[0, i] - row)
        gain = price + unavoidable[row, col] - ways
        for part in range(1 << i):
            gains[part] -= ways  # cost of the tweezer
            gains[part | 1 << i] = gains[part] + gain
        vacancies |= int(vacant[row, col]) << i
    return vacancies


@helper_kernel(f"int64({VIEW}, int64[:, ::1], int64, float64, int64[:, ::1])")
def match_columns(view: View, rows: Ints, k: int, price: float, columns: Ints) -> int:
    """Match source columns with goal columns in order, with the highest gain.

    A dynamic programme over the goals, as for the longest common subsequence, finds for each column the
    highest gain of sources before it.

    Args:
        rows: See the module.
        k: Number of rows.
        price: Gain of an atom.
        columns: Result, see the module.

    Returns:
        Number of columns.
    """
    n_cols, band, way = view[0][0].shape[1], view[1][3], view[2][3]
    patterns, spare, most, last, goals, gains, _ = view[3]
    read_sources(view, rows, k)
    most[0] = 0.0
    filled = n_goals = 0  # ``most`` is known up to this column
    for goal in range(n_cols):
        vacancies = read_goal(view, rows, k, goal, price)
        if vacancies == 0:
            continue
        low, high = max(0, goal - band), min(n_cols - 1, goal + band)
        while filled <= high:
            filled += 1
            most[filled] = most[filled - 1]
        for col in range(high, low - 1, -1):
            last[n_goals, col + 1] = -1
            pattern = patterns[col]
            if pattern <= 0 or pattern & ~vacancies:
                continue
            gain = gains[pattern] + spare[col] - way * abs(col - goal) * (k + n_bits(pattern))
            if most[col] + gain > most[col + 1] + TOLERANCE:
                most[col + 1] = most[col] + gain
                last[n_goals, col + 1] = col
        for col in range(low + 1, high + 1):
            if most[col] > most[col + 1]:
                most[col + 1], last[n_goals, col + 1] = most[col], last[n_goals, col]
        goals[n_goals] = goal
        n_goals += 1
    return trace_columns(view, n_goals, columns)


@helper_kernel(f"int64({VIEW}, int64, int64[:, ::1])")
def trace_columns(view: View, n_goals: int, columns: Ints) -> int:
    """Read the columns from the finished programme of :func:`match_columns`, backwards."""
    n_cols, band = view[0][0].shape[1], view[1][3]
    patterns, _, _, last, goals, _, _ = view[3]
    n, end = 0, n_cols
    for i in range(n_goals - 1, -1, -1):
        low, high = goals[i] - band, min(n_cols - 1, goals[i] + band)
        end = min(end, high + 1)
        if end > max(0, low) and last[i, end] >= 0:
            end = int(last[i, end])
            columns[0, n], columns[1, n], columns[2, n] = patterns[end], goals[i], end
            n += 1
    for j in range(n // 2):
        for i in range(3):
            columns[i, j], columns[i, n - 1 - j] = columns[i, n - 1 - j], columns[i, j]
    return n


@helper_kernel(f"void({VIEW}, int64[:, ::1], int64, int64[:, ::1], int64)")
def find_costs(view: View, rows: Ints, k: int, columns: Ints, n: int) -> None:
    """Find the costs of columns, which are their passes less the passes that no way avoids."""
    unavoidable, costs, spare, cost = view[0][2], view[2], view[3][1], view[3][6]
    for j in range(n):
        pattern, goal, source = columns[0, j], columns[1, j], columns[2, j]
        cost[j] = -spare[source]
        for i in range(k):
            ways = costs[3] * (abs(goal - source) + abs(rows[0, i] - rows[1, i]))
            cost[j] += ways
            if pattern >> i & 1:
                cost[j] += ways - unavoidable[rows[1, i], goal]


@helper_kernel(f"boolean({VIEW}, int64[:, ::1], int64, int64[:, ::1], int64)")
def lands_on_atom(view: View, rows: Ints, k: int, columns: Ints, j: int) -> bool:
    """True if an empty tweezer of a column would end on an atom."""
    for i in range(k):
        if not columns[0, j] >> i & 1 and view[0][0][rows[1, i], columns[1, j]] != EMPTY:
            return True
    return False


@helper_kernel("void(float64[::1], int64[:, ::1], int64, int64[::1])")
def sort_columns(cost: Floats, columns: Ints, n: int, order: Ints) -> None:
    """List columns in order of their costs per atom."""
    for j in range(n):
        place = j
        while place > 0:
            before = order[place - 1]
            if cost[before] * n_bits(columns[0, j]) <= cost[j] * n_bits(columns[0, before]) + TOLERANCE:
                break
            order[place] = before
            place -= 1
        order[place] = j


@helper_kernel(f"Tuple((float64, int64))({VIEW}, int64[:, ::1], int64, int64[:, ::1], int64)")
def cut_columns(view: View, rows: Ints, k: int, columns: Ints, n: int) -> tuple[float, int]:
    """Keep the columns that cost least per atom, as many as limits allow.

    Returns:
        The cost per atom, and the number of columns.
    """
    _, limits, costs, work = view
    limit, cost, order = min(limits[0] // k, limits[2]), work[6], np.empty(n, np.int64)
    find_costs(view, rows, k, columns, n)
    sort_columns(cost, columns, n, order)
    down = furthest = 0
    for i in range(k):
        down = max(down, abs(rows[0, i] - rows[1, i]))
    for j in range(n):
        furthest = max(furthest, abs(columns[1, j] - columns[2, j]))
    least, longest, n_kept = np.inf, 0, 0
    for across in range(furthest + 1):
        total, atoms, taken, in_stages = costs[0] + costs[1] * (down + across), 0, 0, k == 1
        for place in range(n):
            j = order[place]
            if abs(columns[1, j] - columns[2, j]) > across:
                continue
            if taken == limit:
                break
            if not in_stages and lands_on_atom(view, rows, k, columns, j):
                in_stages = True
                total += (k - 1) * costs[2]
            taken += 1
            atoms += n_bits(columns[0, j])
            total += cost[j]
            if total < atoms * least - TOLERANCE:
                least, longest, n_kept = float(total / atoms), across, taken
    return least, keep_columns(order, longest, n_kept, columns, n)


@helper_kernel("int64(int64[::1], int64, int64, int64[:, ::1], int64)")
def keep_columns(order: Ints, longest: int, n_kept: int, columns: Ints, n: int) -> int:
    """Keep the first ``n_kept`` columns of an order whose ways are no longer than ``longest``."""
    kept = np.zeros(n, np.bool_)
    for place in range(n):
        j = order[place]
        if n_kept > 0 and abs(columns[1, j] - columns[2, j]) <= longest:
            kept[j] = True
            n_kept -= 1
    m = 0
    for j in range(n):
        if kept[j]:
            for i in range(3):
                columns[i, m] = columns[i, j]
            m += 1
    return m


@helper_kernel(f"Tuple((float64, int64))({VIEW}, int64[:, ::1], int64, float64, int64[:, ::1])")
def choose_columns(view: View, rows: Ints, k: int, price: float, columns: Ints) -> tuple[float, int]:
    """Choose the columns that cost least per atom, if that is less than ``price``.

    Returns:
        The cost per atom, or inf without such a choice, and the number of columns.
    """
    n = match_columns(view, rows, k, price, columns)
    if n == 0:
        return np.inf, 0
    return cut_columns(view, rows, k, columns, n)
