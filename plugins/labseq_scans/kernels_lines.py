"""Kernels that Tetris and MTA1 share: the growing plan, arrangements of a line, atoms for every column.

The atoms of a line keep their order, so a rearrangement is two ascending lists of
sites: where its atoms are (``source``) and where they go (``goal``). Sites below 0
and from ``n_sites`` on lie outside of the grid and stand for ejection.

In all kernels ``atoms`` marks the sites that hold an atom, ``fill`` those that must
hold one and ``clear`` those that must be empty: bool (n_rows, n_cols), or (n_sites,)
for a line. ``limit`` is the maximum number of atoms in a batch, and ``slots`` the
number of ejection slots on each side. ``spare``, int64 (n_cols,), is the number of
atoms that each column can spare; below 0: that it lacks.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Log = NDArray[np.int32]
Growing = tuple[Log, int, int]
"""A plan that grows: log of its atom moves (batch, row, col, to row, to col), how many moves and batches."""

GRID: Final = const("bool_", 2)
LINE: Final = const("bool_", 1)
GROWING: Final = "Tuple((int32[:, ::1], int64, int64))"
IMPOSSIBLE: Final = 1 << 62

# What an arrangement of a line costs, the worst first.
NOT_FILLED: Final = 1 << 52
NOT_CLEARED: Final = 1 << 42
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 18  # and 1 for each site of distance: at most 250,000 in 1000 sites


@helper_kernel(f"{GROWING}(int64)")
def empty_plan(n_sites: int) -> Growing:
    """Make the log of a plan for a grid of ``n_sites``."""
    return np.empty((2 * n_sites, 5), np.int32), 0, 0


@helper_kernel(f"{GROWING}({GROWING}, int64, int64, int64, int64)")
def add_move(plan: Growing, row: int, col: int, to_row: int, to_col: int) -> Growing:
    """Add an atom move to the batch that is being written."""
    log, n, batch = plan
    if n == len(log):
        longer = np.empty((2 * n + 1, 5), np.int32)
        longer[:n] = log
        log = longer
    log[n, 0] = batch
    log[n, 1] = row
    log[n, 2] = col
    log[n, 3] = to_row
    log[n, 4] = to_col
    return log, n + 1, batch


@helper_kernel(f"{GROWING}({GROWING})")
def end_batch(plan: Growing) -> Growing:
    """Go on with the next batch, unless this one has no atom moves."""
    log, n, batch = plan
    return log, n, batch + (n > 0 and log[n - 1, 0] == batch)


@helper_kernel(f"int64[::1]({LINE})")
def sites_of(atoms: Bools) -> Ints:
    """List the sites of a line's atoms, ascending."""
    sites = np.empty(len(atoms), np.int64)
    n = 0
    for site in range(len(atoms)):
        if atoms[site]:
            sites[n] = site
            n += 1
    return sites[:n]


@helper_kernel(f"void({LINE}, {LINE}, {LINE}, int64[:, ::1], bool_[:, ::1])")
def sum_costs(atoms: Bools, fill: Bools, clear: Bools, cost: Ints, taken: Bools) -> None:
    """Sum up what the cheapest arrangements of a line's first sites cost, for every balance.

    Args:
        atoms: bool (n_sites,), as ``fill`` and ``clear``.
        fill: See the module.
        clear: See there.
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


@helper_kernel(f"UniTuple(int64[::1], 2)({LINE}, {LINE}, {LINE}, boolean, boolean)")
def settle(atoms: Bools, fill: Bools, clear: Bools, low: bool, high: bool) -> tuple[Ints, Ints]:
    """Find the cheapest arrangement of a line: where its atoms are, and where they go.

    A dynamic programme over sites and balances. The balance is the number of atoms
    up to a site minus the number of goals up to there: that many atoms cross from
    the site to the next one. It starts below 0 by the atoms that are ejected at the
    low end, if ``low`` allows that, and ends above 0 by those ejected at the high end.
    What counts, in this order: fill sites left empty, atoms left on clear sites,
    ejections, atoms moved, distance; ejections are distributed over both ends.
    """
    n_sites, source = len(atoms), sites_of(atoms)
    n_wrong = 0
    for site in range(n_sites):
        n_wrong += clear[site] if atoms[site] else fill[site]
    if n_wrong == 0:
        return source, source.copy()
    n_atoms = len(source)
    goal = np.empty(n_atoms, np.int64)
    cost = np.full((n_sites + 1, 2 * n_atoms + 1), IMPOSSIBLE, np.int64)
    taken = np.zeros((n_sites, 2 * n_atoms + 1), np.bool_)
    for n_left in range(n_atoms + 1 if low else 1):
        cost[0, n_atoms - n_left] = n_left * (EJECTED + n_left * ATOM_MOVED + 1)
    sum_costs(atoms, fill, clear, cost, taken)
    n_high = 0
    best = cost[n_sites, n_atoms]
    for n_left in range(1, n_atoms + 1 if high else 1):
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
    return source, goal


@helper_kernel("int64(int64[::1], int64[::1], int64, int64, int64, int64[::1])")
def next_batch(source: Ints, goal: Ints, n_sites: int, limit: int, slots: int, left: Ints) -> int:
    """Choose the atoms of a line that move in its next batch; return how many.

    Those that move up, to higher sites, go one after the other from the upper end,
    then those that move down from the lower end: each finds its way free, at the
    latest in the same batch. One atom per slot and side is ejected in a batch.
    Chosen are the atoms that ``left`` passes and that move in its direction.

    Args:
        source: int64 (n_atoms,), where the atoms are, ascending.
        goal: int64 (n_atoms,), where they go, ascending.
        n_sites: Number of sites of the line.
        limit: Maximum number of atoms in a batch.
        slots: Ejection slots on each side.
        left: int64 (2,), the atoms that are still to be looked at: of those that
            move down from this one on, of those that move up this one and those
            before it; updated.
    """
    n_atoms = len(source)
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


@helper_kernel(f"{GROWING}({GROWING}, int64[::1], int64[::1], int64, int64, boolean, int64, int64)")
def add_line(
    plan: Growing, source: Ints, goal: Ints, n_sites: int, line: int, is_row: bool, limit: int, slots: int
) -> Growing:
    """Add the batches that rearrange one row or column."""
    left = np.array([0, len(source) - 1], np.int64)
    while True:
        first_down, last_up = left[0], left[1]
        if next_batch(source, goal, n_sites, limit, slots, left) == 0:
            return plan
        before, behind = 0, n_sites
        for i in range(first_down, left[0]):
            before -= 1 if goal[i] < 0 else 0
        for i in range(len(source)):
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
                plan = add_move(plan, line, source[i], line, site)
            else:
                plan = add_move(plan, source[i], line, site, line)
        plan = end_batch(plan)


@helper_kernel(f"int64[::1]({GRID})")
def column_sums(sites: Bools) -> Ints:
    """Count the marked sites of each column."""
    total = np.zeros(sites.shape[1], np.int64)
    for row in range(sites.shape[0]):
        for col in range(sites.shape[1]):
            total[col] += sites[row, col]
    return total


@helper_kernel(f"UniTuple(int64, 2)({LINE}, int64[::1])")
def nearest_exchange(atoms: Bools, spare: Ints) -> tuple[int, int]:
    """Find the nearest atom and vacancy of a row of which the one can be spared and the other is lacking.

    Returns:
        The atom's column and the vacancy's; (-1, ``n_cols``) if there are none.
    """
    best_atom, best_vacancy = -1, len(atoms)
    atom = vacancy = -1
    for col in range(len(atoms)):
        if atoms[col] and spare[col] > 0:
            atom = col
        elif not atoms[col] and spare[col] < 0:
            vacancy = col
        else:
            continue
        if min(atom, vacancy) >= 0 and abs(atom - vacancy) < abs(best_atom - best_vacancy):
            best_atom, best_vacancy = atom, vacancy
    return best_atom, best_vacancy


@helper_kernel(f"int64({GRID}, int64[::1])")
def row_of_nearest_exchange(atoms: Bools, spare: Ints) -> int:
    """Find the row with the nearest exchange; -1 if no row has one."""
    best_row, best = -1, len(spare) + 1
    for row in range(len(atoms)):
        atom, vacancy = nearest_exchange(atoms[row], spare)
        if abs(atom - vacancy) < best:
            best_row, best = row, abs(atom - vacancy)
    return best_row


@helper_kernel(f"UniTuple(int64, 3)({GRID}, int64[::1])")
def nearest_unlocking(atoms: Bools, spare: Ints) -> tuple[int, int, int]:
    """Find the shortest move within a column after which a row has an exchange.

    Needed where no row holds both an atom to spare and a vacancy to fill. In the
    rows with such a vacancy the columns with atoms to spare are then empty, so the
    nearest of their atoms has a free path there.

    Returns:
        The column (-1 if there is none), the row of the atom, the row where it goes.
    """
    n_rows, n_cols = atoms.shape
    lacking = np.zeros(n_rows, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            if spare[col] < 0 and not atoms[row, col]:
                lacking[row] = True
    best_col, best_atom, best_goal = -1, 0, n_rows
    for col in range(n_cols):
        atom = goal = -1
        for row in range(n_rows if spare[col] > 0 else 0):
            if atoms[row, col]:
                atom = row
            elif lacking[row]:
                goal = row
            if min(atom, goal) >= 0 and abs(atom - goal) < abs(best_atom - best_goal):
                best_col, best_atom, best_goal = col, atom, goal
    return best_col, best_atom, best_goal


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], int64[::1], int64)")
def supply_columns(plan: Growing, atoms: Bools, spare: Ints, limit: int) -> Growing:
    """Give every column as many atoms as it needs, row by row, the row with the nearest exchange first.

    In a row all exchanges are made that there are, the nearest first. Its atoms
    keep their order: those between go on to the place of the next. There may be no
    fewer atoms than the columns need. Updates ``atoms`` and ``spare``.
    """
    n_cols = len(spare)
    while spare.min() < 0:
        row = row_of_nearest_exchange(atoms, spare)
        if row >= 0:
            source = sites_of(atoms[row])
            col, to_col = nearest_exchange(atoms[row], spare)
            while col >= 0:
                atoms[row, col], atoms[row, to_col] = False, True
                spare[col] -= 1
                spare[to_col] += 1
                col, to_col = nearest_exchange(atoms[row], spare)
            plan = add_line(plan, source, sites_of(atoms[row]), n_cols, row, True, limit, 0)
            continue
        col, row, to_row = nearest_unlocking(atoms, spare)
        if col < 0:
            break
        atoms[row, col], atoms[to_row, col] = False, True
        plan = end_batch(add_move(plan, row, col, to_row, col))
    return plan
