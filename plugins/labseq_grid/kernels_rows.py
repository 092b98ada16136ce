"""Kernels that choose the rows of a batch.

Any choice of up to three goal rows bounds what a batch to them can carry, whatever its source rows: the
vacancies in the columns with most of them. From the highest bound on, each is tried with all choices of
as many source rows, of those with most spare atoms, until no bound is above what has been found.
A *candidate* is int64: atoms carried, orientation, number of rows, source rows, goal rows.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq.plugin import helper_kernel
from labseq_grid.kernels_columns import (
    SPARE,
    Bytes,
    Ints,
    find_spare,
    most_carried,
)

MAX_ROWS: Final = 3
"""Maximum number of rows of a batch."""
SOURCE_ROWS: Final = 5
"""Number of source rows that are considered: those with most spare atoms."""
FEW: Final = 3
"""So few atoms are few: more source rows are considered, for all to be carried in one batch."""
SOURCE_ROWS_OF_FEW: Final = 12
GOAL_ROWS: Final = 22
"""Number of goal rows that are considered for three rows; for two rows three times as many."""
TRIALS: Final = 100
"""Maximum number of pairs of choices that are tried for each number of rows."""
WORK: Final = 4_000_000
"""Fewer are tried of large grids: so many steps of the programmes for the columns, about."""
N_KEPT: Final = 16
"""Number of candidates that are kept."""
SLACK: Final = 2
"""A candidate is kept if it carries at most so many atoms fewer than the best."""

ATOMS: Final = 0
ORIENTATION: Final = 1
N_ROWS: Final = 2
FROM: Final = 3
TO: Final = FROM + MAX_ROWS
CANDIDATE: Final = TO + MAX_ROWS

Candidates = tuple[Ints, int]
"""int64 (N_KEPT, CANDIDATE), the candidates, the best first; and how many there are."""
CANDIDATES: Final = "Tuple((int64[:, ::1], int64))"


@helper_kernel()
def count_sites(sites: Bytes, value: int, counts: Ints) -> None:
    """Count the sites of a value in each row."""
    for row in range(sites.shape[0]):
        counts[row] = 0
        for col in range(sites.shape[1]):
            counts[row] += sites[row, col] == value


@helper_kernel()
def n_choices(n_rows: int, n: int) -> int:
    """Number of choices of ``n`` of ``n_rows`` rows, n up to 3."""
    if n == 1:
        return n_rows
    if n == 2:
        return n_rows * (n_rows - 1) // 2
    return n_rows * (n_rows - 1) * (n_rows - 2) // 6


@helper_kernel()
def richest_rows(counts: Ints, n_most: int, rows: Ints) -> int:
    """List the rows with the highest counts above 0, in ascending order; return how many."""
    n = 0
    for row in range(len(counts)):
        if counts[row] == 0:
            continue
        if n == n_most:
            poorest = 0
            for i in range(1, n):
                if counts[rows[i]] <= counts[rows[poorest]]:
                    poorest = i
            if counts[row] <= counts[rows[poorest]]:
                continue
            n -= 1
            for i in range(poorest, n):
                rows[i] = rows[i + 1]
        rows[n] = row
        n += 1
    return n


@helper_kernel()
def choices(rows: Ints, n_rows: int, n: int, chosen: Ints) -> int:
    """List all choices of ``n`` of some rows, n up to 3, in ``chosen``; return how many."""
    count = 0
    for i in range(n_rows):
        if n == 1:
            chosen[count, 0] = rows[i]
            count += 1
            continue
        for j in range(i + 1, n_rows):
            if n == 2:
                chosen[count, 0], chosen[count, 1] = rows[i], rows[j]
                count += 1
                continue
            for k in range(j + 1, n_rows):
                chosen[count, 0], chosen[count, 1], chosen[count, 2] = rows[i], rows[j], rows[k]
                count += 1
    return count


@helper_kernel()
def bound(sites: Bytes, rows: Ints, n: int, limit: int, value: int) -> int:
    """Count the sites of a value in up to 3 rows, in the ``limit`` columns with most of them."""
    n_cols = sites.shape[1]
    one = two = three = 0
    if n == 1:
        for col in range(n_cols):
            one += sites[rows[0], col] == value
    elif n == 2:
        for col in range(n_cols):
            a, b = sites[rows[0], col] == value, sites[rows[1], col] == value
            one += a | b
            two += a & b
    else:
        for col in range(n_cols):
            a, b = sites[rows[0], col] == value, sites[rows[1], col] == value
            c = sites[rows[2], col] == value
            one += a | b | c
            two += (a & b) | (a & c) | (b & c)
            three += a & b & c
    return min(one, limit) + min(two, limit) + min(three, limit)


@helper_kernel()
def bounds(sites: Bytes, chosen: Ints, n: int, limit: int, value: int) -> Ints:
    """The bound of each choice of rows, see :func:`bound`."""
    found = np.empty(len(chosen), np.int64)
    for i in range(len(chosen)):
        found[i] = bound(sites, chosen[i], n, limit, value)
    return found


@helper_kernel()
def keep(candidates: Candidates, atoms: int, orientation: int, source: Ints, goal: Ints) -> Candidates:
    """Add a candidate to those that are kept."""
    kept, n_kept = candidates
    if n_kept == N_KEPT:
        if atoms <= kept[N_KEPT - 1, ATOMS]:
            return candidates
        n_kept -= 1
    place = n_kept
    while place > 0 and kept[place - 1, ATOMS] < atoms:
        kept[place] = kept[place - 1]
        place -= 1
    n = len(source)
    kept[place, ATOMS], kept[place, ORIENTATION], kept[place, N_ROWS] = atoms, orientation, n
    kept[place, FROM : FROM + n] = source
    kept[place, TO : TO + n] = goal
    return kept, n_kept + 1


@helper_kernel()
def worth_keeping(candidates: Candidates) -> int:
    """Least number of atoms of a candidate that would be kept."""
    kept, n_kept = candidates
    if n_kept == 0:
        return 1
    least = max(1, kept[0, ATOMS] - SLACK)
    return max(least, kept[N_KEPT - 1, ATOMS] + 1) if n_kept == N_KEPT else least


@helper_kernel(f"{CANDIDATES}({CANDIDATES}, uint8[:, ::1], uint8[:, ::1], int64, int64, int64, int64)")
def try_rows(
    candidates: Candidates, source: Bytes, vacant: Bytes, n: int, limit: int, orientation: int, n_left: int
) -> Candidates:
    """Add the best candidates of ``n`` rows, n up to 3, to those that are kept.

    Args:
        candidates: Those that are kept.
        source: uint8 (n_rows, n_cols), see :mod:`labseq_grid.kernels_columns`.
        vacant: The same shape.
        n: Number of rows.
        limit: Maximum number of columns.
        orientation: What the candidates are marked with.
        n_left: Number of atoms after which the search is over.
    """
    n_rows, n_cols = source.shape
    counts, rows = np.empty(n_rows, np.int64), np.empty(n_rows, np.int64)
    count_sites(source, SPARE, counts)
    n_sources = richest_rows(counts, SOURCE_ROWS_OF_FEW if n_left <= FEW else SOURCE_ROWS, rows)
    froms = np.empty((n_choices(n_sources, n), MAX_ROWS), np.int64)
    n_froms = choices(rows, n_sources, n, froms)
    count_sites(vacant, 1, counts)
    n_goals = richest_rows(counts, n_rows if n == 1 else GOAL_ROWS * (3 if n == 2 else 1), rows)
    tos = np.empty((n_choices(n_goals, n), MAX_ROWS), np.int64)
    n_tos = choices(rows, n_goals, n, tos)
    if n_froms == 0 or n_tos == 0:
        return candidates
    from_bounds, to_bounds = bounds(source, froms, n, limit, SPARE), bounds(vacant, tos, n, limit, 1)
    highest = to_bounds.max()
    spare = np.empty((n_froms, 1 << n, n_cols + 1), np.int64)
    end = np.empty((limit + 1, highest + 1), np.int64)
    has_spare = np.zeros(n_froms, np.bool_)
    n_trials = work = 0
    for level in range(highest, 0, -1):
        for k in range(n_tos):
            if to_bounds[k] != level:
                continue
            for i in range(n_froms):
                most = min(level, from_bounds[i], n_left)
                if most < worth_keeping(candidates):
                    continue
                if not has_spare[i]:
                    find_spare(source, froms[i], n, spare[i])
                    has_spare[i] = True
                atoms = most_carried(spare[i], n, vacant, tos[k], limit, most, end)
                if atoms >= worth_keeping(candidates):
                    candidates = keep(candidates, atoms, orientation, froms[i, :n], tos[k, :n])
                n_trials += 1
                work += n_cols * limit * most
                kept, n_kept = candidates
                is_complete = n_kept > 0 and kept[0, ATOMS] == n_left
                if n_trials == TRIALS or work > WORK or is_complete:
                    return candidates
        if level <= worth_keeping(candidates):  # the next level is lower
            break
    return candidates
