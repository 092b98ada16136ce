"""The kernels of PSCA: row sorting, column compression, batches within the degree of parallelism, and repair.

The atoms of a line keep their order, so a rearrangement is two ascending lists of
sites: where its atoms are and where they go. Sites below 0 and from ``n_sites`` on
lie outside of the grid and stand for ejection.

Everything is written for one way round, row sorting and then column compression;
the other way round is the same on the transposed grid.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

LINE: Final = const("bool_", 1)
IMPOSSIBLE: Final = 1 << 60

# What a rearrangement costs, the worst first.
NOT_CLEARED: Final = 1 << 44
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 12  # and 1 for each site of distance


@kernel(f"int64({LINE}, {LINE}, int64, int64)")
def n_to_eject(fill: Bools, clear: Bools, n_atoms: int, slots: int) -> int:
    """Count the atoms of a line that have no place in it."""
    if slots == 0:
        return 0
    room = 0
    for site in range(len(fill)):
        if not clear[site]:
            room += 1
    return max(0, n_atoms - room)


@kernel(f"int64(int64, int64, {LINE}, int64)")
def cost_of_move(source: int, goal: int, clear: Bools, batch: int) -> int:
    """Cost of an atom's move along a line.

    Of the atoms ejected on one side only one leaves per batch, so the n-th costs
    n - 1 batches more: that shares them out to both sides.
    """
    n_sites = len(clear)
    if goal < 0:
        return EJECTED - (goal + 1) * batch + ATOM_MOVED + source + 1
    if goal >= n_sites:
        return EJECTED + (goal - n_sites) * batch + ATOM_MOVED + n_sites - source
    cost = NOT_CLEARED if clear[goal] else 0
    return cost if goal == source else cost + ATOM_MOVED + abs(goal - source)


@kernel(f"void({LINE}, int64, int64, int64[:, ::1])")
def reach(fill: Bools, n_atoms: int, beyond: int, places: Ints) -> None:
    """Find the first and the last place of each atom with which all fill sites can be taken.

    The place of atom i is its site less i, plus ``beyond``: in the order kept it
    never falls from one atom to the next. Atom i needs no more fill sites on its
    left than there are atoms before it, and none more on its right than after it.

    Args:
        fill: bool (n_sites,), sites that must hold an atom.
        n_atoms: Number of atoms, no fewer than fill sites.
        beyond: How many sites the line is lengthened by on each side.
        places: Result, int64 (>= n_atoms, 2): first and last place, last included.
    """
    n_sites = len(fill)
    last = n_sites - n_atoms + 2 * beyond
    n_right = 0
    site = n_sites + beyond - 1
    for i in range(n_atoms - 1, -1, -1):
        while site > i - beyond and n_right + (0 <= site < n_sites and fill[site]) <= n_atoms - 1 - i:
            n_right += 0 <= site < n_sites and fill[site]
            site -= 1
        places[i, 0] = max(site - i + beyond, 0)
    n_left = 0
    site = -beyond
    for i in range(n_atoms):
        while site < i - beyond + last and n_left + (0 <= site < n_sites and fill[site]) <= i:
            n_left += 0 <= site < n_sites and fill[site]
            site += 1
        places[i, 1] = min(site - i + beyond, last)


@kernel(f"bool_(int64[::1], int64, {LINE}, {LINE}, int64, int64, int64[:, ::1], int16[:, ::1], int64[::1])")
def compress(
    source: Ints,
    n_atoms: int,
    fill: Bools,
    clear: Bools,
    limit: int,
    slots: int,
    cost: Ints,
    step: NDArray[np.int16],
    goal: Ints,
) -> bool:
    """Find the cheapest goals of a line's atoms, with every fill site taken.

    A dynamic programme over atoms and places, see :func:`reach`; the line is
    lengthened on both sides by as many sites as atoms must be ejected.

    Args:
        source: int64 (>= n_atoms,), where the atoms are, ascending.
        n_atoms: Number of atoms, at least 1.
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side; with 0 nothing is ejected.
        cost: Work space, int64 (>= n_atoms, > 2 n_sites).
        step: Work space, int16, likewise.
        goal: Result, int64 (>= n_atoms,): where they go, ascending.

    Returns:
        Whether all fill sites can be taken.
    """
    n_sites = len(fill)
    n_fill = 0
    for site in range(n_sites):
        if fill[site]:
            if n_fill < n_atoms:
                goal[n_fill] = site
            n_fill += 1
    if n_fill >= n_atoms:  # no choice
        return n_fill == n_atoms
    beyond = n_to_eject(fill, clear, n_atoms, slots)
    places = np.empty((n_atoms, 2), np.int64)
    reach(fill, n_atoms, beyond, places)
    before, last_before = 0, -1
    for i in range(n_atoms):
        first, last = places[i]
        best = IMPOSSIBLE if i > 0 else 0
        best_place = 0
        for place in range(min(before, first), last + 1):
            if before <= place <= last_before and cost[i - 1, place] < best:
                best = cost[i - 1, place]
                best_place = place
            site = i + place - beyond
            if place >= first:
                cost[i, place] = best + cost_of_move(source[i], site, clear, limit * ATOM_MOVED)
                step[i, place] = best_place
            if 0 <= site < n_sites and fill[site]:
                best = IMPOSSIBLE  # beyond a fill site, no atom may follow one before it
        before, last_before = first, last
    best = IMPOSSIBLE
    place = -1
    for last in range(places[n_atoms - 1, 1], places[n_atoms - 1, 0] - 1, -1):
        if cost[n_atoms - 1, last] < best:
            best = cost[n_atoms - 1, last]
            place = last
    if place < 0:
        return False
    for i in range(n_atoms - 1, -1, -1):
        goal[i] = i + place - beyond
        place = step[i, place]
    return True


@kernel("int64(int64[::1], int64[::1], int64, int64, int64, int64, int64[::1], int64)")
def fill_batch(
    source: Ints, goal: Ints, n_atoms: int, n_sites: int, limit: int, slots: int, turn: Ints, batch: int
) -> int:
    """Choose the atoms of a line that move in its next batch.

    An atom can go when the neighbour ahead has left the way, at the latest in the
    same batch: atoms that move up are freed from the upper end, those that move
    down from the lower end. Ejections come first, because only one per slot fits
    into a batch.

    Args:
        source: int64 (>= n_atoms,), where the atoms that move are, ascending.
        goal: int64 (>= n_atoms,), where they go, ascending.
        n_atoms: Number of atoms that move.
        n_sites: Number of sites of the line.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
        turn: int64 (>= n_atoms,): the batch in which the atom moved, from 1, or 0 if
            it is still to move; updated.
        batch: Number of the batch to fill.

    Returns:
        Number of atoms chosen.
    """
    n = 0
    n_low = n_high = 0
    for i in range(n_atoms):
        if goal[i] >= 0 or n == limit or n_low == slots:
            break
        if turn[i] == 0:
            turn[i] = batch
            n += 1
            n_low += 1
    for i in range(n_atoms - 1, -1, -1):
        if goal[i] < n_sites or n == limit or n_high == slots:
            break
        if turn[i] == 0:
            turn[i] = batch
            n += 1
            n_high += 1
    for i in range(n_atoms - 1, -1, -1):
        if n < limit and turn[i] == 0 and source[i] < goal[i] < n_sites:
            way_is_free = i + 1 == n_atoms or goal[i] < source[i + 1] or turn[i + 1] > 0
            turn[i] = batch if way_is_free else 0
            n += way_is_free
    for i in range(n_atoms):
        if n < limit and turn[i] == 0 and 0 <= goal[i] < source[i]:
            way_is_free = i == 0 or goal[i] > source[i - 1] or turn[i - 1] > 0
            turn[i] = batch if way_is_free else 0
            n += way_is_free
    return n


Moves = NDArray[np.int16]
Offsets = NDArray[np.int32]
Growing = tuple[Moves, Offsets, int]
"""A plan that grows: its moves, where each batch starts, and how many batches there are."""

GRID: Final = const("bool_", 2)
GROWING: Final = "int16[:, ::1], int32[::1], int64"
PLAN: Final = "Tuple((int16[:, ::1], int32[::1]))"


@kernel(f"{PLAN}(int16[:, ::1], int32[::1], int64, int64)")
def resized(moves: Moves, offsets: Offsets, n_batches: int, n_moves: int) -> tuple[Moves, Offsets]:
    """Copy a plan of ``n_batches`` into arrays for ``n_moves`` atom moves, and no more batches."""
    new_moves = np.empty((n_moves, 4), np.int16)
    new_offsets = np.empty(n_moves + 1, np.int32)
    for i in range(offsets[n_batches]):
        for k in range(4):
            new_moves[i, k] = moves[i, k]
    for i in range(n_batches + 1):
        new_offsets[i] = offsets[i]
    return new_moves, new_offsets


@kernel(f"Tuple(({GROWING}))({GROWING}, int64[::1], int64[::1], int64, int64, int64, boolean, int64, int64)")
def add_line(
    moves: Moves,
    offsets: Offsets,
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
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        source: int64 (>= n_atoms,), where the atoms are, ascending; overwritten.
        goal: int64 (>= n_atoms,), where they go, ascending; overwritten.
        n_atoms: Number of atoms in the line.
        n_sites: Number of sites in the line.
        line: Index of the row or column.
        is_row: Whether the line is a row.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
    """
    if offsets[n_batches] + n_atoms > len(moves):
        moves, offsets = resized(moves, offsets, n_batches, 2 * len(moves) + n_atoms)
    n_left = 0
    for i in range(n_atoms):  # atoms that stay are in nobody's way, because the order is kept
        if source[i] != goal[i]:
            source[n_left] = source[i]
            goal[n_left] = goal[i]
            n_left += 1
    n_atoms = n_left
    turn = np.zeros(n_atoms, np.int64)
    batch = 0
    while n_left > 0:
        batch += 1
        n_left -= fill_batch(source, goal, n_atoms, n_sites, limit, slots, turn, batch)
        n = offsets[n_batches]
        before, behind = 0, n_sites
        for i in range(n_atoms):
            if turn[i] == batch and goal[i] < 0:
                before -= 1
        for i in range(n_atoms):
            if turn[i] != batch:
                continue
            site = goal[i]
            if site < 0:
                site = before
                before += 1
            elif site >= n_sites:
                site = behind
                behind += 1
            moves[n, 0], moves[n, 2] = (line, line) if is_row else (source[i], site)
            moves[n, 1], moves[n, 3] = (source[i], site) if is_row else (line, line)
            n += 1
        n_batches += 1
        offsets[n_batches] = n
    return moves, offsets, n_batches


@kernel(f"{PLAN}(int64)")
def empty_plan(n_sites: int) -> tuple[Moves, Offsets]:
    """Make the arrays of a plan that is about to grow."""
    offsets = np.empty(2 * n_sites + 1, np.int32)
    offsets[0] = 0
    return np.empty((2 * n_sites, 4), np.int16), offsets


@kernel(f"boolean[:, ::1]({GRID})")
def transposed(sites: Bools) -> Bools:
    """Swap rows and columns, into a contiguous array."""
    n_rows, n_cols = sites.shape
    swapped = np.empty((n_cols, n_rows), np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            swapped[col, row] = sites[row, col]
    return swapped


@kernel("int64(int16[:, ::1])")
def distance(moves: Moves) -> int:
    """Add up how far the atoms move, in sites."""
    total = 0
    for i in range(len(moves)):
        total += int(abs(moves[i, 2] - moves[i, 0])) + int(abs(moves[i, 3] - moves[i, 1]))
    return total


@kernel(f"{PLAN}({GROWING}, boolean)")
def ended(moves: Moves, offsets: Offsets, n_batches: int, swapped: bool) -> tuple[Moves, Offsets]:
    """Cut a grown plan to its length; with rows and columns swapped back if they were."""
    moves, offsets = resized(moves, offsets, n_batches, offsets[n_batches])
    if swapped:
        for i in range(len(moves)):
            for site in (0, 2):
                row, col = moves[i, site + 1], moves[i, site]
                moves[i, site] = row
                moves[i, site + 1] = col
    return moves, offsets[: n_batches + 1]


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


@kernel(f"UniTuple(int64[::1], 3)({GRID}, {GRID}, {GRID})")
def count_columns(atoms: Bools, fill: Bools, clear: Bools) -> tuple[Ints, Ints, Ints]:
    """Count the fill sites of each column, its sites that may hold an atom, and its atoms."""
    n_rows, n_cols = atoms.shape
    need = np.zeros(n_cols, np.int64)
    room = np.zeros(n_cols, np.int64)
    count = np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            need[col] += fill[row, col]
            room[col] += not clear[row, col]
            count[col] += atoms[row, col]
    return need, room, count


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], {GRID}, {GRID}, int64, int64, int64)")
def sort_rows(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    row_limit: int,
    column_limit: int,
    order: int,
) -> Growing:
    """Sort rows until every column holds at least as many atoms as it has fill sites.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), no fewer than there are fill sites; updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.
    """
    n_rows, n_cols = atoms.shape
    need, room, count = count_columns(atoms, fill, clear)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    worth = np.empty(n_cols + 1, np.int64)
    step = np.empty((n_cols, n_cols + 1), np.int8)
    source = np.empty(max(n_rows, n_cols), np.int64)
    goal = np.empty(max(n_rows, n_cols), np.int64)
    while weigh_columns(need, room, count, weight, leave) > 0:
        row = choose_row(atoms, fill, weight, leave, row_limit, order, worth, step, change)
        if row >= 0:
            n_atoms = exchange(atoms[row], change, source, goal)
            for col in range(n_cols):
                count[col] += change[col]
            moves, offsets, n_batches = add_line(
                moves, offsets, n_batches, source, goal, n_atoms, n_cols, row, True, row_limit, 0
            )
            continue
        col, source[0], goal[0] = choose_unlocking(atoms, weight, leave)
        if col < 0:
            break
        atoms[source[0], col] = False
        atoms[goal[0], col] = True
        moves, offsets, n_batches = add_line(
            moves, offsets, n_batches, source, goal, 1, n_rows, col, False, column_limit, 0
        )
    return moves, offsets, n_batches


@kernel(f"Tuple(({GROWING}))({GROWING}, {GRID}, {GRID}, {GRID}, int64, int64)")
def compress_columns(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    limit: int,
    slots: int,
) -> Growing:
    """Bring the atoms of every column onto its fill sites, and off the sites that must be empty.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), in no column fewer than it has fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
    """
    n_rows, n_cols = atoms.shape
    cost = np.empty((n_rows, 2 * n_rows + 1), np.int64)
    step = np.empty((n_rows, 2 * n_rows + 1), np.int16)
    source = np.empty(n_rows, np.int64)
    goal = np.empty(n_rows, np.int64)
    column_fill = np.empty(n_rows, np.bool_)
    column_clear = np.empty(n_rows, np.bool_)
    for col in range(n_cols):
        n_atoms = 0
        n_wrong = 0
        for row in range(n_rows):
            column_fill[row] = fill[row, col]
            column_clear[row] = clear[row, col]
            if atoms[row, col]:
                source[n_atoms] = row
                n_atoms += 1
                n_wrong += clear[row, col]
            else:
                n_wrong += fill[row, col]
        if n_wrong > 0 and compress(
            source, n_atoms, column_fill, column_clear, limit, slots, cost, step, goal
        ):
            moves, offsets, n_batches = add_line(
                moves, offsets, n_batches, source, goal, n_atoms, n_rows, col, False, limit, slots
            )
    return moves, offsets, n_batches


@kernel(f"int64({GRID}, {GRID}, {GRID}, int64)")
def least_batches(atoms: Bools, fill: Bools, clear: Bools, limit: int) -> int:
    """Count the batches that the compression of all columns takes at least.

    Args:
        atoms: bool (n_rows, n_cols), after row sorting.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most atoms in a batch.
    """
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


@kernel(f"{PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_best_way(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> tuple[Moves, Offsets]:
    """Plan both ways round and keep the plan of fewer batches, then atom moves, then distance.

    The way that promises fewer batches after sorting is ended first; the other
    one only if it can still be as good.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        slots: Ejection slots on each side.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.

    Returns:
        moves, int16 (n_moves, 4), and batch offsets, int32 (n_batches + 1,).
    """
    atoms, other_atoms = occupied.copy(), transposed(occupied)
    other_fill, other_clear = transposed(fill), transposed(clear)
    moves, offsets = empty_plan(atoms.size)
    moves, offsets, n = sort_rows(moves, offsets, 0, atoms, fill, clear, row_limit, column_limit, order)
    other_moves, other_offsets = empty_plan(atoms.size)
    other_moves, other_offsets, other_n = sort_rows(
        other_moves, other_offsets, 0, other_atoms, other_fill, other_clear, column_limit, row_limit, order
    )
    least = n + least_batches(atoms, fill, clear, column_limit)
    other_least = other_n + least_batches(other_atoms, other_fill, other_clear, row_limit)
    if least <= other_least:
        moves, offsets, n = compress_columns(moves, offsets, n, atoms, fill, clear, column_limit, slots)
        if n < other_least:
            return ended(moves, offsets, n, False)
    other_moves, other_offsets, other_n = compress_columns(
        other_moves, other_offsets, other_n, other_atoms, other_fill, other_clear, row_limit, slots
    )
    if least > other_least:
        if other_n < least:
            return ended(other_moves, other_offsets, other_n, True)
        moves, offsets, n = compress_columns(moves, offsets, n, atoms, fill, clear, column_limit, slots)
    n_moves, other_n_moves = offsets[n], other_offsets[other_n]
    if (n, n_moves, distance(moves[:n_moves])) <= (
        other_n,
        other_n_moves,
        distance(other_moves[:other_n_moves]),
    ):
        return ended(moves, offsets, n, False)
    return ended(other_moves, other_offsets, other_n, True)


# What a shift costs: moving an atom loses 1.8 % of one, and the about 1 ms of a batch 0.7 % of one out of
# 225 atoms of 33 s lifetime (physics of the paper's experiment).
ATOM_MOVE: Final = 3
BATCH: Final = 1


@kernel("int64(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def nearest_beside(atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int) -> int:
    """Find the nearest atom to spare on either side of a site, with nothing in its way.

    Args:
        atoms: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the site, which is empty.
        col: Its column.
        down: Step along the line to look in, in rows; 1, or 0 for a row.
        right: Likewise, in columns.

    Returns:
        Steps to the atom, below 0 on the upper or left side; 0 if there is none.
    """
    n_rows, n_cols = atoms.shape
    for n in range(1, max(n_rows, n_cols)):
        for steps in (-n, n):
            r, c = row + steps * down, col + steps * right
            if 0 <= r < n_rows and 0 <= c < n_cols and atoms[r, c] and not fill[r, c]:
                for i in range(1, n):
                    way = i if steps > 0 else -i
                    if atoms[row + way * down, col + way * right]:
                        break
                else:
                    return steps
    return 0


@kernel("UniTuple(int64, 4)(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def shift_to(
    atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int
) -> tuple[int, int, int, int]:
    """Find the cheapest shift along one line, from one side, that fills a defect.

    The atoms between the defect and the nearest atom to spare, seen from it in the
    given direction, move up by one fill site each. Defects on the way are filled
    too if there are as many atoms to spare. An atom to spare may also come from
    beside the line, onto the first free site outside of the target.

    Args:
        atoms: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the defect.
        col: Its column.
        down: Step to the side that atoms come from, in rows.
        right: Likewise, in columns.

    Returns:
        The cost, defects that are filled, sites from the defect to the last atom
        that moves, and steps from there to the atom that comes from beside, see
        :func:`nearest_beside`. No defects if there is no atom to spare.
    """
    n_rows, n_cols = atoms.shape
    n_sites = n_atoms = n_spare = n_defects = 0
    best = (0, 0, 0, 0)
    while 0 <= row < n_rows and 0 <= col < n_cols:
        found = (0, 0, 0, 0)
        if atoms[row, col]:
            n_atoms += 1
            n_spare += not fill[row, col]
            if not fill[row, col] and n_spare in (1, n_defects):
                found = (ATOM_MOVE * n_atoms + BATCH, n_spare, n_sites, 0)
        elif fill[row, col]:
            n_defects += 1
        elif n_spare == 0 and best[3] == 0:
            steps = nearest_beside(atoms, fill, row, col, abs(right), abs(down))
            if steps != 0:
                found = (ATOM_MOVE * (n_atoms + 2) + 2 * BATCH, 1, n_sites, steps)
        if found[1] * best[0] > best[1] * found[0] or best[1] == 0:
            best = found
        if n_spare > 0 and n_spare == n_defects:
            break
        n_sites += 1
        row += down
        col += right
    return best


@kernel("UniTuple(int64, 6)(bool_[:, ::1], bool_[:, ::1])")
def cheapest_shift(atoms: Bools, fill: Bools) -> tuple[int, int, int, int, int, int]:
    """Find the shift that costs least for each defect that it fills; of equals the shortest.

    Returns:
        Row and column of the defect, the step to the side that atoms come from (rows,
        columns), the sites to the last atom that moves, and the steps to the atom
        that comes from beside; all 0 if there is none.
    """
    n_rows, n_cols = atoms.shape
    best = (0, 0, 0, 0, 0, 0)
    best_cost, best_defects = 1, 0
    for row in range(n_rows):
        for col in range(n_cols):
            if not fill[row, col] or atoms[row, col]:
                continue
            for side in range(4):
                down = (side == 0) - (side == 1)
                right = (side == 2) - (side == 3)
                cost, n_defects, n_sites, steps = shift_to(atoms, fill, row, col, down, right)
                ahead = n_defects * best_cost - best_defects * cost
                if ahead > 0 or (ahead == 0 and n_defects > 0 and n_sites < best[4]):
                    best = (row, col, down, right, n_sites, steps)
                    best_cost, best_defects = cost, n_defects
    return best


@kernel("int64(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64, int64, int64[::1], int64[::1])")
def carry_out(
    atoms: Bools,
    fill: Bools,
    row: int,
    col: int,
    down: int,
    right: int,
    n_sites: int,
    source: Ints,
    goal: Ints,
) -> int:
    """Carry out a shift.

    Args:
        atoms: bool (n_rows, n_cols); updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the defect.
        col: Its column.
        down: Step to the side that atoms come from, in rows.
        right: Likewise, in columns.
        n_sites: Sites from the defect to the last atom that moves.
        source: Result, where the atoms are, ascending.
        goal: Result, where they go, ascending.

    Returns:
        Number of atoms that move.
    """
    n_atoms = n_goals = 0
    for i in range(n_sites + 1):
        r, c = row + i * down, col + i * right
        site = r if down != 0 else c
        if atoms[r, c]:
            source[n_atoms] = site
            n_atoms += 1
            atoms[r, c] = False
        if fill[r, c]:
            goal[n_goals] = site
            n_goals += 1
    for i in range(n_atoms):
        if down != 0:
            atoms[goal[i], col] = True
        else:
            atoms[row, goal[i]] = True
    if down + right < 0:
        source[:n_atoms] = source[:n_atoms][::-1].copy()
        goal[:n_atoms] = goal[:n_atoms][::-1].copy()
    return n_atoms


@kernel(f"Tuple((int16[:, ::1], int32[::1], bool_[:, ::1]))({GRID}, {GRID}, int64, int64)")
def plan_repair(
    occupied: Bools, fill: Bools, row_limit: int, column_limit: int
) -> tuple[Moves, Offsets, Bools]:
    """Fill defects from the side that takes fewest atoms, one shift after another.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.

    Returns:
        moves, int16 (n_moves, 4), batch offsets, int32 (n_batches + 1,), and the
        occupancy after them. Defects that no shift fills are left.
    """
    atoms = occupied.copy()
    sites = fill.copy()
    n_rows, n_cols = atoms.shape
    source = np.empty(max(n_rows, n_cols), np.int64)
    goal = np.empty(max(n_rows, n_cols), np.int64)
    moves, offsets = empty_plan(atoms.size)
    n = 0
    row, col, down, right, n_sites, steps = cheapest_shift(atoms, sites)
    while n_sites > 0:
        along_row = right != 0
        if steps != 0:
            r, c = row + n_sites * down, col + n_sites * right
            end, line = (r, c) if along_row else (c, r)
            source[0], goal[0] = end + steps, end
            atoms[r, c] = True
            if along_row:
                atoms[r + steps, c] = False
                moves, offsets, n = add_line(
                    moves, offsets, n, source, goal, 1, n_rows, line, False, column_limit, 0
                )
            else:
                atoms[r, c + steps] = False
                moves, offsets, n = add_line(
                    moves, offsets, n, source, goal, 1, n_cols, line, True, row_limit, 0
                )
        n_atoms = carry_out(atoms, sites, row, col, down, right, n_sites, source, goal)
        length, line, limit = (n_cols, row, row_limit) if along_row else (n_rows, col, column_limit)
        moves, offsets, n = add_line(
            moves, offsets, n, source, goal, n_atoms, length, line, along_row, limit, 0
        )
        row, col, down, right, n_sites, steps = cheapest_shift(atoms, sites)
    moves, offsets = ended(moves, offsets, n, False)
    return moves, offsets, atoms
