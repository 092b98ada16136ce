"""Kernels that choose the columns of a batch whose rows are given.

A batch takes the atoms of ``n`` source rows to as many goal rows, in order, and those of its source
columns to as many goal columns, in order. What a column holds in these rows is a *pattern*: bit i stands
for row i. An atom is *carried* if its column is chosen; so a source column with pattern a can go to a goal
column with the vacancies b if a is part of b.

In all kernels ``source``, uint8 (n_rows, n_cols), is EMPTY, SPARE or STAYS; ``vacant``, uint8 of the same
shape, is 1 where an atom may be dropped off. ``spare``, int64 (2**n, n_cols + 1), is for each pattern and
column the first column from there on that has exactly this pattern, or NOWHERE.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

EMPTY: Final = 0
SPARE: Final = 1
STAYS: Final = 2
NOWHERE: Final = 1 << 20


@helper_kernel()
def n_bits(pattern: int) -> int:
    """Count the bits of a pattern of at most 8 rows."""
    twos = pattern - ((pattern >> 1) & 0x55)
    fours = (twos & 0x33) + ((twos >> 2) & 0x33)
    return (fours + (fours >> 4)) & 0xF


@helper_kernel()
def pattern_of(vacant: Bytes, rows: Ints, n: int, col: int) -> int:
    """The pattern of a column of sites that are 0 or 1."""
    pattern = 0
    for i in range(n):
        pattern |= int(vacant[rows[i], col]) << i
    return pattern


@helper_kernel("void(uint8[:, ::1], int64[::1], int64, int64[:, ::1])")
def find_spare(source: Bytes, rows: Ints, n: int, spare: Ints) -> None:
    """Fill ``spare`` for some source rows; a column with an atom that stays has no pattern."""
    n_cols = source.shape[1]
    for pattern in range(1, 1 << n):
        spare[pattern, n_cols] = NOWHERE
    for col in range(n_cols - 1, -1, -1):
        found = 0
        for i in range(n):
            atom = int(source[rows[i], col])
            found |= (atom & 1) << i | (atom >> 1) << 16
        for pattern in range(1, 1 << n):
            spare[pattern, col] = spare[pattern, col + 1]
        if 0 < found < 1 << 16:
            spare[found, col] = col


@helper_kernel("int64(int64[:, ::1], int64, uint8[:, ::1], int64[::1], int64, int64, int64[:, ::1])")
def most_carried(spare: Ints, n: int, vacant: Bytes, goals: Ints, limit: int, most: int, end: Ints) -> int:
    """Find how many vacancies of the goal rows a batch can fill at most.

    For each number of columns and of atoms so far, ``end`` keeps the least column after the last that is
    taken: what is carried by then is worth no more if it ends later.

    Args:
        spare: See the module.
        n: Number of rows.
        vacant: See the module.
        goals: int64 (n,), the goal rows.
        limit: Maximum number of columns.
        most: An upper bound of the result.
        end: Work space, int64 (> limit, > most).
    """
    n_cols = vacant.shape[1]
    n_wanted = 0
    for col in range(n_cols):
        n_wanted += pattern_of(vacant, goals, n, col) != 0
    step = 1 if n_wanted > limit else 0  # otherwise columns need not be counted
    for atoms in range(most + 1):
        end[0, atoms] = NOWHERE
    end[0, 0] = 0
    columns = best = 0
    for col in range(n_cols):
        wanted = pattern_of(vacant, goals, n, col)
        if wanted == 0:
            continue
        if columns < limit and step == 1:
            columns += 1
            for atoms in range(most + 1):
                end[columns, atoms] = NOWHERE
        before = best
        for taken in range(columns - step, -1, -1):
            for atoms in range(before, -1, -1):
                start = end[taken, atoms]
                if start >= n_cols:
                    continue
                part = wanted
                while part > 0:
                    total = atoms + n_bits(part)
                    if total <= most:
                        end[taken + step, total] = min(end[taken + step, total], spare[part, start] + 1)
                        if total > best and end[taken + step, total] <= n_cols:
                            best = total
                    part = (part - 1) & wanted
        if best == most:
            break
    return best


AFTER_ALL: Final = 1 << 14
Ends = NDArray[np.int16]


@helper_kernel()
def trace_back(
    spare: Ints, wanted: Ints, n_wanted: int, n_chosen: int, atoms: int, ends: Ends, chosen: Ints
) -> None:
    """Read the choice of columns from the finished programme of :func:`trace_columns`, backwards."""
    k = n_wanted
    for taken in range(n_chosen, 0, -1):
        while ends[k - 1, taken, atoms] == ends[k, taken, atoms]:
            k -= 1
        k -= 1
        part = wanted[0, k]
        while True:
            before = atoms - n_bits(part)
            start = ends[k, taken - 1, before] if before >= 0 else AFTER_ALL
            if start < AFTER_ALL and spare[part, start] + 1 == ends[k + 1, taken, atoms]:
                break
            part = (part - 1) & wanted[0, k]
        atoms = before
        chosen[0, taken - 1], chosen[1, taken - 1] = part, wanted[1, k]


@helper_kernel("int64(int64[:, ::1], int64, uint8[:, ::1], int64[::1], int64, int64, int64[:, ::1])")
def trace_columns(
    spare: Ints, n: int, vacant: Bytes, goals: Ints, limit: int, gain: int, chosen: Ints
) -> int:
    """Find a choice of columns that carries ``gain`` atoms, by the programme of :func:`most_carried`.

    Args:
        spare: See the module.
        n: Number of rows.
        vacant: See the module.
        goals: int64 (n,), the goal rows.
        limit: Maximum number of columns.
        gain: What :func:`most_carried` returned.
        chosen: Result, int64 (>= 2, n_cols): pattern and goal of each column.

    Returns:
        Number of columns, the fewest that carry as many.
    """
    n_cols = vacant.shape[1]
    wanted = np.empty((2, n_cols), np.int64)
    n_wanted = 0
    for col in range(n_cols):
        wanted[0, n_wanted], wanted[1, n_wanted] = pattern_of(vacant, goals, n, col), col
        n_wanted += wanted[0, n_wanted] != 0
    ends = np.empty((n_wanted + 1, limit + 1, gain + 1), np.int16)
    ends[0] = AFTER_ALL
    ends[0, 0, 0] = 0
    for k in range(n_wanted):
        ends[k + 1] = ends[k]
        for taken in range(min(limit, k + 1)):
            for atoms in range(min(gain, n * taken) + 1):
                start = ends[k, taken, atoms]
                part = wanted[0, k] if start < n_cols else 0
                while part > 0:
                    total = atoms + n_bits(part)
                    if total <= gain and spare[part, start] + 1 < ends[k + 1, taken + 1, total]:
                        ends[k + 1, taken + 1, total] = spare[part, start] + 1
                    part = (part - 1) & wanted[0, k]
    n_chosen = 0
    while ends[n_wanted, n_chosen, gain] == AFTER_ALL:
        n_chosen += 1
    trace_back(spare, wanted, n_wanted, n_chosen, gain, ends, chosen)
    return n_chosen


@helper_kernel("void(int64[:, ::1], int64, int64[:, ::1], int64[:, ::1])")
def take_nearest(spare: Ints, n_chosen: int, chosen: Ints, cost: Ints) -> None:
    """Choose source columns near their goals: of least sum of the squares of the ways.

    Args:
        spare: See the module.
        n_chosen: Number of columns.
        chosen: int64 (3, n_cols): pattern and goal of each column; its source is added.
        cost: Work space, int64 (> n_chosen, > n_cols): of the columns so far, with sources before a column.
    """
    n_cols = spare.shape[1] - 1
    for col in range(n_cols + 1):
        cost[0, col] = 0
    for k in range(n_chosen):
        cost[k + 1, 0] = NOWHERE
        for col in range(n_cols):
            cost[k + 1, col + 1] = cost[k + 1, col]
            if spare[chosen[0, k], col] == col:
                way = col - chosen[1, k]
                cost[k + 1, col + 1] = min(cost[k + 1, col + 1], cost[k, col] + way * way)
    col = n_cols
    for k in range(n_chosen - 1, -1, -1):
        while cost[k + 1, col] == cost[k + 1, col - 1]:
            col -= 1
        col -= 1
        chosen[2, k] = col
