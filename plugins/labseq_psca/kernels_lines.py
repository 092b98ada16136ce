"""Kernels that all variants of PSCA share: growing plans, the batches of a line, column compression.

The atoms of a line keep their order, so a rearrangement is two ascending lists of
sites: where its atoms are (``source``) and where they go (``goal``). Sites below 0
and from ``n_sites`` on lie outside of the grid and stand for ejection.

In all kernels ``atoms`` marks the sites that hold an atom, ``fill`` those that must
hold one and ``clear`` those that must be empty: bool (n_rows, n_cols), or (n_sites,)
for a line. ``limit`` is the maximum number of atoms in a batch, and ``slots`` the
number of ejection slots on each side.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]
Offsets = NDArray[np.int32]
Growing = tuple[Moves, Offsets, int]
"""A plan that grows: its moves, where each batch starts, and the number of batches."""
Finished = tuple[Moves, Offsets]
"""moves, int16 (n_moves, 4), and batch offsets, int32 (n_batches + 1,)."""

LINE: Final = const("bool_", 1)
GRID: Final = const("bool_", 2)
GROWING: Final = "Tuple((int16[:, ::1], int32[::1], int64))"
FINISHED: Final = "Tuple((int16[:, ::1], int32[::1]))"
IMPOSSIBLE: Final = 1 << 60


@helper_kernel(f"{GROWING}(int64)")
def empty_plan(n_sites: int) -> Growing:
    """Make the arrays of a plan for a grid of ``n_sites``."""
    offsets = np.empty(2 * n_sites + 1, np.int32)
    offsets[0] = 0
    return np.empty((2 * n_sites, 4), np.int16), offsets, 0


@helper_kernel(f"{FINISHED}({GROWING}, int64)")
def resized(plan: Growing, n_moves: int) -> Finished:
    """Copy a plan into arrays for ``n_moves`` atom moves, and no more batches."""
    moves, offsets, n_batches = plan
    new_moves = np.empty((n_moves, 4), np.int16)
    new_offsets = np.empty(n_moves + 1, np.int32)
    for i in range(offsets[n_batches]):
        for k in range(4):
            new_moves[i, k] = moves[i, k]
    for i in range(n_batches + 1):
        new_offsets[i] = offsets[i]
    return new_moves, new_offsets


@helper_kernel(f"{FINISHED}({GROWING}, boolean)")
def finished(plan: Growing, swapped: bool) -> Finished:
    """Cut a grown plan to its length, and swap rows and columns back if they were swapped."""
    n_batches = plan[2]
    moves, offsets = resized(plan, plan[1][n_batches])
    if swapped:
        for i in range(len(moves)):
            for site in (0, 2):
                row, col = moves[i, site + 1], moves[i, site]
                moves[i, site] = row
                moves[i, site + 1] = col
    return moves, offsets[: n_batches + 1]


@helper_kernel("int64(int64[::1], int64[::1], int64, int64, int64, int64[::1], int64)")
def fill_batch(source: Ints, goal: Ints, n_sites: int, limit: int, slots: int, turn: Ints, batch: int) -> int:
    """Choose the atoms of a line that move in its next batch; return how many.

    An atom can go once its neighbour ahead has cleared the way, at the latest in the
    same batch: atoms that move up go from the upper end on, those that move down from
    the lower end. Ejections come first, because only one per slot fits into a batch.

    Args:
        source: int64 (n_atoms,), where the atoms that move are, ascending.
        goal: int64 (n_atoms,), where they go, ascending.
        n_sites: Number of sites of the line.
        limit: Maximum number of atoms in a batch.
        slots: Ejection slots on each side.
        turn: int64 (n_atoms,), the batch in which each atom moves, from 1, or 0 as long
            as it has none; updated.
        batch: Number of the batch to fill.
    """
    n_atoms = len(source)
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


@helper_kernel(f"{GROWING}({GROWING}, int64[::1], int64[::1], int64, int64, boolean, int64, int64)")
def add_line(
    plan: Growing, source: Ints, goal: Ints, n_sites: int, line: int, is_row: bool, limit: int, slots: int
) -> Growing:
    """Add the batches that rearrange one row or column; ``source`` and ``goal`` are overwritten."""
    moves, offsets, n_batches = plan
    n_atoms = len(source)
    if offsets[n_batches] + n_atoms > len(moves):
        moves, offsets = resized(plan, 2 * len(moves) + n_atoms)
    n_left = 0
    for i in range(n_atoms):  # atoms that stay block none, because the order is kept
        if source[i] != goal[i]:
            source[n_left] = source[i]
            goal[n_left] = goal[i]
            n_left += 1
    n_atoms = n_left
    source, goal = source[:n_atoms], goal[:n_atoms]
    turn = np.zeros(n_atoms, np.int64)
    batch = 0
    while n_left > 0:
        batch += 1
        n_left -= fill_batch(source, goal, n_sites, limit, slots, turn, batch)
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


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], int64, int64, int64, int64)")
def add_move(plan: Growing, atoms: Bools, row: int, col: int, to_row: int, to_col: int) -> Growing:
    """Move one atom along its row or column, in a batch of its own; updates ``atoms``."""
    atoms[row, col] = False
    atoms[to_row, to_col] = True
    is_row = row == to_row
    line, start, end = (row, col, to_col) if is_row else (col, row, to_row)
    n_sites = atoms.shape[1] if is_row else atoms.shape[0]
    return add_line(plan, np.array([start]), np.array([end]), n_sites, line, is_row, 1, 0)


# What a rearrangement costs, the worst first.
NOT_CLEARED: Final = 1 << 44
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 12  # and 1 for each site of distance


@helper_kernel(f"int64(int64, int64, {LINE}, int64)")
def cost_of_move(source: int, goal: int, clear: Bools, batch: int) -> int:
    """Cost of an atom's move along a line.

    Of the atoms ejected on one side only one leaves per batch, so the n-th costs
    n - 1 batches more, which distributes them over both sides.
    """
    n_sites = len(clear)
    if goal < 0:
        return EJECTED - (goal + 1) * batch + ATOM_MOVED + source + 1
    if goal >= n_sites:
        return EJECTED + (goal - n_sites) * batch + ATOM_MOVED + n_sites - source
    cost = NOT_CLEARED if clear[goal] else 0
    return cost if goal == source else cost + ATOM_MOVED + abs(goal - source)


@helper_kernel(f"void({LINE}, int64, int64, int64[:, ::1])")
def reach(fill: Bools, n_atoms: int, beyond: int, places: Ints) -> None:
    """Find the first and the last place of each atom with which all fill sites can be taken.

    The place of atom i is its site minus i, plus ``beyond``: as the order is kept, it
    never decreases from one atom to the next. On the left of atom i there may be no
    more fill sites than atoms, and none more on its right than atoms there.

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


@helper_kernel(f"bool_(int64[::1], {LINE}, {LINE}, int64, int64, int64[:, ::1], int16[:, ::1], int64[::1])")
def compress(
    source: Ints,
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
        source: int64 (n_atoms,), where the atoms are, ascending; at least one.
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        limit: Maximum number of atoms in a batch.
        slots: Ejection slots on each side; with 0 nothing is ejected.
        cost: Work space, int64 (>= n_atoms, > 2 n_sites).
        step: Work space, int16, likewise.
        goal: Result, int64 (n_atoms,): where they go, ascending.

    Returns:
        Whether all fill sites can be taken.
    """
    n_atoms = len(source)
    n_sites = len(fill)
    n_fill = n_room = 0
    for site in range(n_sites):
        n_room += not clear[site]
        if fill[site]:
            if n_fill < n_atoms:
                goal[n_fill] = site
            n_fill += 1
    if n_fill >= n_atoms:  # no choice
        return n_fill == n_atoms
    beyond = max(0, n_atoms - n_room) if slots > 0 else 0
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


@helper_kernel(f"{GROWING}({GROWING}, {GRID}, {GRID}, {GRID}, int64, int64)")
def compress_columns(
    plan: Growing, atoms: Bools, fill: Bools, clear: Bools, limit: int, slots: int
) -> Growing:
    """Move the atoms of every column onto its fill sites, and off the sites that must be empty.

    No column may hold fewer atoms than it has fill sites.
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
        starts, ends = source[:n_atoms], goal[:n_atoms]
        if n_wrong > 0 and compress(starts, column_fill, column_clear, limit, slots, cost, step, ends):
            plan = add_line(plan, starts, ends, n_rows, col, False, limit, slots)
    return plan
