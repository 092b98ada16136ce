"""Kernels that work on one line: where its atoms go, and in which batches.

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
