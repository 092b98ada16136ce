"""The kernels of Tetris and MTA1: line scans, presorting, columns.

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


@kernel(f"int64[::1]({GRID})")
def column_sums(sites: Bools) -> Ints:
    """Count the marked sites of each column."""
    total = np.zeros(sites.shape[1], np.int64)
    for row in range(sites.shape[0]):
        for col in range(sites.shape[1]):
            total[col] += sites[row, col]
    return total


@kernel(f"UniTuple(int64, 2)({LINE}, int64[::1])")
def nearest_exchange(atoms: Bools, spare: Ints) -> tuple[int, int]:
    """Find the nearest atom and vacancy of a row of which the one can be spared and the other is lacking.

    Args:
        atoms: bool (n_cols,), the row.
        spare: int64 (n_cols,), atoms that the column can spare; below 0: that it lacks.

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


@kernel(f"int64({GRID}, int64[::1])")
def row_of_nearest_exchange(atoms: Bools, spare: Ints) -> int:
    """Find the row with the nearest exchange; -1 if no row has one.

    Args:
        atoms: bool (n_rows, n_cols).
        spare: int64 (n_cols,), see :func:`nearest_exchange`.
    """
    best_row, best = -1, len(spare) + 1
    for row in range(len(atoms)):
        atom, vacancy = nearest_exchange(atoms[row], spare)
        if abs(atom - vacancy) < best:
            best_row, best = row, abs(atom - vacancy)
    return best_row


@kernel(f"UniTuple(int64, 3)({GRID}, int64[::1])")
def nearest_unlocking(atoms: Bools, spare: Ints) -> tuple[int, int, int]:
    """Find the shortest move within a column after which a row has an exchange.

    Needed where no row holds both an atom to spare and a vacancy to fill. In the
    rows with such a vacancy the columns with atoms to spare are then empty, so the
    nearest of their atoms has a free path there.

    Args:
        atoms: bool (n_rows, n_cols), with no exchange.
        spare: int64 (n_cols,), see :func:`nearest_exchange`.

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


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], int64[::1], int64)")
def supply_columns(log: Log, n_moves: int, n_batches: int, atoms: Bools, spare: Ints, limit: int) -> Growing:
    """Give every column as many atoms as it needs, row by row, the row with the nearest exchange first.

    In a row all exchanges are made that there are, the nearest first. Its atoms
    keep their order: those between go on to the place of the next.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), no fewer than the columns need; updated.
        spare: int64 (n_cols,), see :func:`nearest_exchange`; updated.
        limit: Most atoms in a batch.
    """
    n_cols = len(spare)
    source = np.empty(n_cols, np.int64)
    goal = np.empty(n_cols, np.int64)
    while spare.min() < 0:
        row = row_of_nearest_exchange(atoms, spare)
        if row >= 0:
            n_atoms = sites_of(atoms[row], source)
            col, to_col = nearest_exchange(atoms[row], spare)
            while col >= 0:
                atoms[row, col], atoms[row, to_col] = False, True
                spare[col] -= 1
                spare[to_col] += 1
                col, to_col = nearest_exchange(atoms[row], spare)
            sites_of(atoms[row], goal)
            log, n_moves, n_batches = add_line(
                log, n_moves, n_batches, source, goal, n_atoms, n_cols, row, True, limit, 0
            )
            continue
        col, row, to_row = nearest_unlocking(atoms, spare)
        if col < 0:
            break
        atoms[row, col], atoms[to_row, col] = False, True
        log = record(log, n_moves, n_batches, row, col, to_row, col)
        n_moves += 1
        n_batches += 1
    return log, n_moves, n_batches


Scanned = tuple[Log, int, int, Ints, int]
"""A growing plan (see ``_kernels_lines``), how many lines each of its scans passes, how many scans."""

SCANNED: Final = "int32[:, ::1], int64, int64, int64[::1], int64"


@kernel("int64[::1](int64[::1], int64, int64)")
def count_scan(passed: Ints, n_scans: int, n_lines: int) -> Ints:
    """Note how many lines scan ``n_scans`` passes; the list is lengthened if it is full."""
    if n_scans == len(passed):
        longer = np.empty(2 * n_scans + 1, np.int64)
        longer[:n_scans] = passed
        passed = longer
    passed[n_scans] = n_lines
    return passed


@kernel(f"void({GRID}, int64, int64, int64[::1])")
def look_aside(atoms: Bools, col: int, side: int, distance: Ints) -> None:
    """Measure how far the nearest atom beside each vacancy of a column is.

    Args:
        atoms: bool (n_rows, n_cols).
        col: The column.
        side: Where to look: -1 to the left, 1 to the right.
        distance: Result, int64 (n_rows,), in columns; 0 where there is no vacancy or no atom.
    """
    for row in range(len(atoms)):
        distance[row] = 0
        other = col + side
        while not atoms[row, col] and 0 <= other < atoms.shape[1]:
            if atoms[row, other]:
                distance[row] = abs(other - col)
                break
            other += side


@kernel(f"Tuple(({SCANNED}))({SCANNED}, bool_[:, ::1], int64[::1], int64, int64, int64, int64[::1])")
def fetch(
    log: Log,
    n_moves: int,
    n_batches: int,
    passed: Ints,
    n_scans: int,
    atoms: Bools,
    spare: Ints,
    col: int,
    side: int,
    n_wanted: int,
    distance: Ints,
) -> Scanned:
    """Move the nearest atoms of one side into a column by one horizontal scan.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols); updated.
        spare: int64 (n_cols,), atoms that each column can spare; updated.
        col: The column.
        side: Where the atoms come from: -1 from the left, 1 from the right.
        n_wanted: Most atoms to move.
        distance: int64 (n_rows,), see :func:`look_aside`; 0 afterwards where an atom was moved.
    """
    chosen = np.zeros(len(distance), np.bool_)
    farthest = 0
    for _ in range(n_wanted):
        nearest = -1
        for row in range(len(distance)):
            if distance[row] > 0 and not chosen[row] and (nearest < 0 or distance[row] < distance[nearest]):
                nearest = row
        if nearest < 0:
            break
        chosen[nearest] = True
        farthest = distance[nearest]
    for steps in range(farthest, 0, -1):
        source = col + side * steps
        n_before = n_moves
        for row in range(len(distance)):
            if chosen[row] and distance[row] == steps:
                log = record(log, n_moves, n_batches, row, source, row, col)
                n_moves += 1
                atoms[row, source] = False
                atoms[row, col] = True
                distance[row] = 0
        n_taken = n_moves - n_before
        spare[source] -= n_taken
        spare[col] += n_taken
        n_batches += n_taken > 0
    if farthest > 0:
        passed = count_scan(passed, n_scans, farthest + 1)
        n_scans += 1
    return log, n_moves, n_batches, passed, n_scans


@kernel(f"Tuple(({SCANNED}))({SCANNED}, bool_[:, ::1], int64[::1], int64)")
def presort(
    log: Log, n_moves: int, n_batches: int, passed: Ints, n_scans: int, atoms: Bools, spare: Ints, limit: int
) -> Scanned:
    """Supply the columns that lack atoms, in turns, until none does or nothing helps.

    The side with more atoms to spare in all gives its nearest atoms in the rows
    where the column has a vacancy, as many as it can spare; their columns may lack
    atoms afterwards.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols); updated.
        spare: int64 (n_cols,), atoms that each column can spare, below 0: that it lacks; updated.
        limit: Most atoms on at once.
    """
    n_rows, n_cols = atoms.shape
    distance = np.empty(n_rows, np.int64)
    for _ in range(n_cols):
        n_before = n_moves
        for col in range(n_cols):
            if spare[col] >= 0:
                continue
            left, right = np.sum(spare[:col]), np.sum(spare[col + 1 :])
            side = -1 if left >= right else 1
            n_wanted = min(-spare[col], max(left, right))
            look_aside(atoms, col, side, distance)
            while n_wanted > 0:
                n_start = n_moves
                log, n_moves, n_batches, passed, n_scans = fetch(
                    log,
                    n_moves,
                    n_batches,
                    passed,
                    n_scans,
                    atoms,
                    spare,
                    col,
                    side,
                    min(n_wanted, limit),
                    distance,
                )
                if n_moves == n_start:
                    break
                n_wanted -= n_moves - n_start
        if n_moves == n_before:
            break
    return log, n_moves, n_batches, passed, n_scans


@kernel("int64(int64[:, ::1], int64[:, ::1], int64[::1], int64, int64, int64, int64)")
def end_of_move(place: Ints, goal: Ints, n_atoms: Ints, n_rows: int, col: int, i: int, sense: int) -> int:
    """Row where a scan drops an atom that it has picked up: at its goal, or before the next atom.

    An atom that is to be ejected waits until none is below it.

    Args:
        place: int64 (n_cols, n_rows), rows of each column's atoms, ascending.
        goal: int64 (n_cols, n_rows), where they go, ascending.
        n_atoms: int64 (n_cols,).
        n_rows: Number of rows.
        col: The atom's column.
        i: The atom's index in its column.
        sense: 1 for a downward scan, -1 for an upward one.

    Returns:
        The row; the atom's own if it stays.
    """
    ahead = i + sense
    blocked = 0 <= ahead < n_atoms[col]
    if goal[col, i] >= n_rows:
        return place[col, i] if blocked or sense < 0 else n_rows
    end = goal[col, i] * sense
    if blocked:
        end = min(end, place[col, ahead] * sense - 1)
    return max(end, place[col, i] * sense) * sense


@kernel(f"Tuple(({GROWING}))({GROWING}, int64[:, ::1], int64[:, ::1], int64[::1], int64, int64, int64)")
def scan(
    log: Log,
    n_moves: int,
    n_batches: int,
    place: Ints,
    goal: Ints,
    n_atoms: Ints,
    n_rows: int,
    sense: int,
    limit: int,
) -> Growing:
    """Move a row of tweezers over all rows once; each carries one atom of its column at a time.

    Atoms that are picked up on the same row and dropped on the same row make a batch.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        place: int64 (n_cols, n_rows), rows of each column's atoms, ascending; updated.
        goal: int64 (n_cols, n_rows), where they go, ascending.
        n_atoms: int64 (n_cols,); updated.
        n_rows: Number of rows.
        sense: 1 for a downward scan, -1 for an upward one.
        limit: Most tweezers on at once.
    """
    n_cols = len(n_atoms)
    n_on = 0
    n_dropped = np.zeros(n_rows + 1, np.int64)  # by row; an upward scan reaches none below 0
    following = np.zeros(n_cols, np.int64) if sense > 0 else n_atoms - 1
    picked = np.empty(n_cols, np.int64)
    for step in range(n_rows):
        row = step if sense > 0 else n_rows - 1 - step
        n_on -= n_dropped[row]
        n_picked = 0
        for col in range(n_cols):
            picked[col] = row
            i = following[col]
            if not (0 <= i < n_atoms[col] and place[col, i] == row):
                continue
            following[col] = i + sense
            end = end_of_move(place, goal, n_atoms, n_rows, col, i, sense)
            if end == row or n_on == limit:
                continue
            n_on += 1
            n_picked += 1
            n_dropped[end] += 1
            picked[col] = end
            place[col, i] = end
            if end == n_rows:
                n_atoms[col] -= 1
        end = row
        while n_picked > 0:
            end += sense
            n_before = n_moves
            for col in range(n_cols):
                if picked[col] == end:
                    log = record(log, n_moves, n_batches, row, col, end, col)
                    n_moves += 1
            n_picked -= n_moves - n_before
            n_batches += n_moves > n_before
    return log, n_moves, n_batches


@kernel(f"Tuple(({SCANNED}))({SCANNED}, {GRID}, {GRID}, {GRID}, int64, boolean)")
def sort_columns(
    log: Log,
    n_moves: int,
    n_batches: int,
    passed: Ints,
    n_scans: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    limit: int,
    may_eject: bool,
) -> Scanned:
    """Scan downwards and upwards in turns until every atom is where it goes.

    Args:
        log: Of the growing plan, as ``n_moves``, ``n_batches``, ``passed`` and ``n_scans``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        passed: int64 (>= n_scans,), lines that each scan passes.
        n_scans: Number of scans so far.
        atoms: bool (n_rows, n_cols), in no column fewer than it has fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most tweezers on at once.
        may_eject: Whether atoms can be ejected below the last row.
    """
    n_rows, n_cols = atoms.shape
    place = np.empty((n_cols, n_rows), np.int64)
    goal = np.empty((n_cols, n_rows), np.int64)
    n_atoms = np.empty(n_cols, np.int64)
    for col in range(n_cols):
        n_atoms[col] = settle(
            atoms[:, col].copy(),
            fill[:, col].copy(),
            clear[:, col].copy(),
            False,
            may_eject,
            place[col],
            goal[col],
        )
    n_idle = 0
    sense = 1
    while n_idle < 2:
        n_held, n_before = np.sum(n_atoms), n_moves
        log, n_moves, n_batches = scan(log, n_moves, n_batches, place, goal, n_atoms, n_rows, sense, limit)
        n_idle = 0 if n_moves > n_before else n_idle + 1
        if n_idle == 0:
            ejects = np.sum(n_atoms) < n_held
            passed = count_scan(passed, n_scans, n_rows + 1 if ejects else n_rows)
            n_scans += 1
        sense = -sense
    return log, n_moves, n_batches, passed, n_scans


@kernel(f"Tuple(({SCANNED}))({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_mta1(
    occupied: Bools, fill: Bools, clear: Bools, row_tones: int, column_tones: int, slots: int
) -> Scanned:
    """Plan MTA1.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_tones: Most tweezers on at once in a column.
        column_tones: Most tweezers on at once in a row.
        slots: Ejection slots on each side.

    Returns:
        The log of atom moves, int32 (>= n_moves, 5), ``n_moves``, the number of batches,
        the lines that each scan passes, int64 (>= n_scans,), and ``n_scans``.
    """
    atoms = occupied.copy()
    spare = column_sums(atoms) - column_sums(fill)
    log = np.empty((2 * occupied.size, 5), np.int32)
    passed = np.empty(4 * len(atoms), np.int64)
    log, n_moves, n_batches, passed, n_scans = presort(log, 0, 0, passed, 0, atoms, spare, row_tones)
    n_first, n_presorted = n_moves, n_batches
    log, n_moves, n_batches = supply_columns(log, n_moves, n_batches, atoms, spare, column_tones)
    for batch in range(n_presorted, n_batches):
        low, high = max(atoms.shape), 0
        while n_first < n_moves and log[n_first, 0] == batch:
            along = 2 if log[n_first, 1] == log[n_first, 3] else 1
            for at in (along, along + 2):
                low = min(low, log[n_first, at])
                high = max(high, log[n_first, at])
            n_first += 1
        passed = count_scan(passed, n_scans, high - low + 1)
        n_scans += 1
    return sort_columns(log, n_moves, n_batches, passed, n_scans, atoms, fill, clear, column_tones, slots > 0)


@kernel(f"int64[:, ::1]({GRID})")
def fill_rows(fill: Bools) -> Ints:
    """List the rows of each column's fill sites.

    Args:
        fill: bool (n_rows, n_cols).

    Returns:
        int64 (n_cols, n_rows + 1): rows, ascending; ``n_rows`` after the last.
    """
    n_rows, n_cols = fill.shape
    rows = np.full((n_cols, n_rows + 1), n_rows, np.int64)
    for col in range(n_cols):
        n = 0
        for row in range(n_rows):
            if fill[row, col]:
                rows[col, n] = row
                n += 1
    return rows


@kernel("void(bool_[::1], int64[:, ::1], int64[::1], bool_[::1])")
def choose_columns(atoms: Bools, rows: Ints, piled: Ints, chosen: Bools) -> None:
    """Choose the columns that the atoms of a row go to: those whose next open target row is the uppermost.

    Of equals, columns that hold an atom of this row already come first, then the left ones.

    Args:
        atoms: bool (n_cols,), the row.
        rows: int64 (n_cols, n_rows + 1), see :func:`fill_rows`.
        piled: int64 (n_cols,), how many of each column's target rows have their atom; updated.
        chosen: Result, bool (n_cols,).
    """
    n_rows = rows.shape[1] - 1
    for col in range(len(atoms)):
        chosen[col] = False
    for _ in range(np.count_nonzero(atoms)):
        best, best_rank = -1, 2 * n_rows
        for col in range(len(atoms)):
            rank = 2 * rows[col, piled[col]] + (0 if atoms[col] else 1)
            if not chosen[col] and rank < best_rank:
                best, best_rank = col, rank
        if best < 0:
            return
        chosen[best] = True
    for col in range(len(atoms)):
        piled[col] += chosen[col]


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], {GRID}, int64)")
def pile_up(log: Log, n_moves: int, n_batches: int, atoms: Bools, fill: Bools, limit: int) -> Growing:
    """Arrange row after row, from the top, until each target site has its atom in its column.

    Args:
        log: Of the growing plan, as ``n_moves`` and ``n_batches``.
        n_moves: Number of atom moves so far.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols); updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        limit: Most atoms in a batch.
    """
    n_rows, n_cols = atoms.shape
    rows = fill_rows(fill)
    piled = np.zeros(n_cols, np.int64)
    chosen = np.empty(n_cols, np.bool_)
    anywhere = np.zeros(n_cols, np.bool_)
    source = np.empty(n_cols, np.int64)
    goal = np.empty(n_cols, np.int64)
    for row in range(n_rows):
        choose_columns(atoms[row], rows, piled, chosen)
        n_atoms = settle(atoms[row], chosen, anywhere, False, False, source, goal)
        for i in range(n_atoms):
            atoms[row, source[i]] = False
        for i in range(n_atoms):
            atoms[row, goal[i]] = True
        log, n_moves, n_batches = add_line(
            log, n_moves, n_batches, source, goal, n_atoms, n_cols, row, True, limit, 0
        )
    return log, n_moves, n_batches


@kernel(f"Tuple(({GROWING}))({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_tetris(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int
) -> Growing:
    """Plan the Tetris algorithm.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        slots: Ejection slots on each side.

    Returns:
        The log of atom moves, int32 (>= n_moves, 5), ``n_moves``, and the number of batches.
    """
    n_rows, n_cols = occupied.shape
    atoms = occupied.copy()
    log = np.empty((2 * occupied.size, 5), np.int32)
    log, n_moves, n_batches = pile_up(log, 0, 0, atoms, fill, row_limit)
    spare = column_sums(atoms) - column_sums(fill)
    log, n_moves, n_batches = supply_columns(log, n_moves, n_batches, atoms, spare, row_limit)
    source = np.empty(n_rows, np.int64)
    goal = np.empty(n_rows, np.int64)
    for col in range(n_cols):
        n_atoms = settle(
            atoms[:, col].copy(),
            fill[:, col].copy(),
            clear[:, col].copy(),
            slots > 0,
            slots > 0,
            source,
            goal,
        )
        log, n_moves, n_batches = add_line(
            log, n_moves, n_batches, source, goal, n_atoms, n_rows, col, False, column_limit, slots
        )
    return log, n_moves, n_batches
