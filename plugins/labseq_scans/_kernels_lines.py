"""Kernels that rearrange one line: where its atoms go, and in which batches.

The atoms of a line keep their order, so a rearrangement is two ascending lists of
sites: where its atoms are and where they go. Sites below 0 and from ``n_sites`` on
lie outside of the grid and stand for ejection.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Log = NDArray[np.int32]
Growing = tuple[Log, int, int]
"""A plan that grows: log of its atom moves (batch, row, col, to row, to col), how many moves and batches."""

GRID: Final = const("bool_", 2)
LINE: Final = const("bool_", 1)
GROWING: Final = "int32[:, ::1], int64, int64"
IMPOSSIBLE: Final = 1 << 62

# What an arrangement of a line costs, the worst first.
NOT_FILLED: Final = 1 << 52
NOT_CLEARED: Final = 1 << 42
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 18  # and 1 for each site of distance: at most 250,000 in 1000 sites


@kernel("int32[:, ::1](int32[:, ::1], int64, int64, int64, int64, int64, int64)")
def record(log: Log, n: int, batch: int, row: int, col: int, to_row: int, to_col: int) -> Log:
    """Write atom move ``n`` into the log of a growing plan, which is lengthened if it is full."""
    if n == len(log):
        longer = np.empty((2 * n + 1, 5), np.int32)
        longer[:n] = log
        log = longer
    log[n, 0] = batch
    log[n, 1] = row
    log[n, 2] = col
    log[n, 3] = to_row
    log[n, 4] = to_col
    return log


@kernel(f"int64({LINE}, int64[::1])")
def sites_of(atoms: Bools, sites: Ints) -> int:
    """List the sites of a line's atoms, ascending; return how many there are."""
    n = 0
    for site in range(len(atoms)):
        if atoms[site]:
            sites[n] = site
            n += 1
    return n


@kernel(f"void({LINE}, {LINE}, {LINE}, int64[:, ::1], bool_[:, ::1])")
def sum_costs(atoms: Bools, fill: Bools, clear: Bools, cost: Ints, taken: Bools) -> None:
    """Sum up what the cheapest arrangements of a line's first sites cost, for every balance.

    Args:
        atoms: bool (n_sites,).
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        cost: int64 (n_sites + 1, 2 n_most + 1), after how many sites, by balance +
            n_most; its first row is given; updated.
        taken: Result, bool (n_sites, 2 n_most + 1), whether the last of these sites
            holds an atom then.
    """
    n_most = cost.shape[1] // 2
    for site in range(len(atoms)):
        for place in range(cost.shape[1]):
            before = cost[site, place]
            if before == IMPOSSIBLE:
                continue
            for taking in range(2):
                after = place - taking
                total = before
                if atoms[site]:
                    after += 1
                    total += 0 if taking and place == n_most else ATOM_MOVED
                if not 0 <= after < cost.shape[1]:
                    continue
                total += abs(after - n_most)
                if taking:
                    total += NOT_CLEARED if clear[site] else 0
                else:
                    total += NOT_FILLED if fill[site] else 0
                if total < cost[site + 1, after]:
                    cost[site + 1, after] = total
                    taken[site, after] = taking == 1


@kernel(f"int64({LINE}, {LINE}, {LINE}, boolean, boolean, int64[::1], int64[::1])")
def settle(
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    may_leave_low: bool,
    may_leave_high: bool,
    source: Ints,
    goal: Ints,
) -> int:
    """Find the cheapest arrangement of a line.

    A dynamic programme over sites and balances. The balance is the number of atoms
    up to a site minus the number of goals up to there: that many atoms cross from
    the site to the next one. It starts below 0 by the atoms that are ejected at the
    low end and ends above 0 by those ejected at the high end. What counts, in this
    order: fill sites left empty, atoms left on clear sites, ejections, atoms moved,
    distance; ejections are shared out to both ends.

    Args:
        atoms: bool (n_sites,).
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        may_leave_low: Whether atoms can be ejected before the first site.
        may_leave_high: Whether atoms can be ejected behind the last site.
        source: Result, int64 (>= n_sites,), where the atoms are, ascending.
        goal: Result, int64 (>= n_sites,), where they go, ascending.

    Returns:
        Number of atoms.
    """
    n_sites, n_atoms = len(atoms), sites_of(atoms, source)
    cost = np.full((n_sites + 1, 2 * n_atoms + 1), IMPOSSIBLE, np.int64)
    taken = np.zeros((n_sites, 2 * n_atoms + 1), np.bool_)
    for n_left in range(n_atoms + 1 if may_leave_low else 1):
        cost[0, n_atoms - n_left] = n_left * (EJECTED + n_left * ATOM_MOVED + 1)
    sum_costs(atoms, fill, clear, cost, taken)
    n_high = 0
    best = cost[n_sites, n_atoms]
    for n_left in range(1, n_atoms + 1 if may_leave_high else 1):
        total = cost[n_sites, n_atoms + n_left]
        if total < IMPOSSIBLE and total + n_left * (EJECTED + n_left * ATOM_MOVED) < best:
            best = total + n_left * (EJECTED + n_left * ATOM_MOVED)
            n_high = n_left
    for n_left in range(n_high):
        goal[n_atoms - 1 - n_left] = n_sites + n_high - 1 - n_left
    n_to_go = n_atoms - n_high
    place = n_atoms + n_high
    for site in range(n_sites - 1, -1, -1):
        if taken[site, place]:
            n_to_go -= 1
            goal[n_to_go] = site
            place += 1
        if atoms[site]:
            place -= 1
    for n_left in range(n_to_go):
        goal[n_left] = n_left - n_to_go
    return n_atoms


@kernel("int64(int64[::1], int64[::1], int64, int64, int64, int64, int64[::1])")
def next_batch(
    source: Ints, goal: Ints, n_atoms: int, n_sites: int, limit: int, slots: int, left: Ints
) -> int:
    """Choose the atoms of a line that move in its next batch.

    Those that move up, to higher sites, go one after the other from the upper end,
    then those that move down from the lower end: each finds its way free, at the
    latest in the same batch. One atom per slot and side is ejected in a batch.

    Args:
        source: int64 (>= n_atoms,), where the atoms are, ascending.
        goal: int64 (>= n_atoms,), where they go, ascending.
        n_atoms: Number of atoms.
        n_sites: Number of sites of the line.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
        left: int64 (2,), the atoms that are still to be looked at: of those that
            move down from this one on, of those that move up this one and those
            before it; updated.

    Returns:
        Number of atoms chosen: those that ``left`` has passed and that move its way.
    """
    n = 0
    n_ejected = 0
    while left[1] >= 0 and n < limit:
        i = left[1]
        if goal[i] >= n_sites:
            if n_ejected == slots:
                break
            n_ejected += 1
        n += 1 if goal[i] > source[i] else 0
        left[1] -= 1
    n_ejected = 0
    while left[0] < n_atoms and n < limit:
        i = left[0]
        if goal[i] < 0:
            if n_ejected == slots:
                break
            n_ejected += 1
        n += 1 if goal[i] < source[i] else 0
        left[0] += 1
    return n


@kernel(f"Tuple(({GROWING}))({GROWING}, int64[::1], int64[::1], int64, int64, int64, boolean, int64, int64)")
def add_line(
    log: Log,
    n_moves: int,
    n_batches: int,
    source: Ints,
    goal: Ints,
    n_atoms: int,
    n_sites: int,
    line: int,
    is_row: bool,
    limit: int,
    slots: int,
) -> Growing:
    """Add the batches that rearrange one line to a growing plan.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        source: int64 (>= n_atoms,), where the atoms are, ascending.
        goal: int64 (>= n_atoms,), where they go, ascending.
        n_atoms: Number of atoms in the line.
        n_sites: Number of sites in the line.
        line: Index of the row or column.
        is_row: Whether the line is a row.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
    """
    left = np.array([0, n_atoms - 1], np.int64)
    while True:
        first_down, last_up = left[0], left[1]
        if next_batch(source, goal, n_atoms, n_sites, limit, slots, left) == 0:
            return log, n_moves, n_batches
        before, behind = 0, n_sites
        for i in range(first_down, left[0]):
            before -= 1 if goal[i] < 0 else 0
        for i in range(n_atoms):
            moves_down = first_down <= i < left[0] and goal[i] < source[i]
            moves_up = left[1] < i <= last_up and goal[i] > source[i]
            if not (moves_down or moves_up):
                continue
            site = goal[i]
            if site < 0:
                site = before
                before += 1
            elif site >= n_sites:
                site = behind
                behind += 1
            if is_row:
                log = record(log, n_moves, n_batches, line, source[i], line, site)
            else:
                log = record(log, n_moves, n_batches, source[i], line, site, line)
            n_moves += 1
        n_batches += 1
