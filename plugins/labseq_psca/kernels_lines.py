"""Kernels of row sorting and column compression, the steps that both variants of PSCA share.

In all kernels ``atoms`` marks the sites that hold an atom, ``fill`` the sites that must hold an atom and
``clear`` the sites that must be empty. They are bool (n_rows, n_cols), or (n_sites,) for a line. ``limit`` is
the maximum number of atoms in a batch, and ``slots`` the number of ejection slots on each side. ``source``
and ``goal`` are as in :mod:`labseq.plugin.plan_kernels`. ``change``, int64 (n_cols,), is an exchange of a
row's atoms, -1 where an atom leaves its column, 1 where a vacancy is filled, otherwise 0. The atoms of the
row keep their order.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq.plugin.plan_kernels import GROWING_PLAN, GrowingPlan, add_line, sites_of

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID: Final = const("bool_", 2)
IMPOSSIBLE: Final = 1 << 60

# Which of equal rows goes first, numbered as the setting row_order lists them.
HALF_FILLED, FULLEST, EMPTIEST = range(3)


@helper_kernel()
def place_in_order(n_atoms: int, n_sites: int, order: int) -> int:
    """Place of a row in an order. The row with the lowest place goes first."""
    if order == FULLEST:
        return -n_atoms
    if order == EMPTIEST:
        return n_atoms
    return abs(2 * n_atoms - n_sites)


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, bool_[:, ::1], int64, int64[::1], int64[::1], int64)")
def sort_row(plan: GrowingPlan, atoms: Bools, row: int, change: Ints, count: Ints, limit: int) -> GrowingPlan:
    """Carry out an exchange in a row. Updates ``atoms`` and ``count``."""
    n_cols = len(change)
    source = sites_of(atoms[row])
    for col in range(n_cols):
        if change[col] != 0:
            atoms[row, col] = change[col] > 0
            count[col] += change[col]
    return add_line(plan, (True, row, n_cols), source, sites_of(atoms[row]), limit, 0)


# Costs of a rearrangement, the worst first.
NOT_CLEARED: Final = 1 << 44
EJECTED: Final = 1 << 32
ATOM_MOVED: Final = 1 << 12  # and 1 for each site of distance


@helper_kernel()
def cost_of_move(source: int, goal: int, clear: Bools, batch: int) -> int:
    """Cost of an atom's move along a line.

    Only one of the atoms ejected on one side leaves per batch, so the n-th costs n - 1 batches more, which
    distributes them over both sides.
    """
    n_sites = len(clear)
    if goal < 0:
        return EJECTED - (goal + 1) * batch + ATOM_MOVED + source + 1
    if goal >= n_sites:
        return EJECTED + (goal - n_sites) * batch + ATOM_MOVED + n_sites - source
    cost = NOT_CLEARED if clear[goal] else 0
    return cost if goal == source else cost + ATOM_MOVED + abs(goal - source)


@helper_kernel()
def reach(fill: Bools, n_atoms: int, beyond: int, places: Ints) -> None:
    """Find the first and the last place of each atom at which all fill sites can be filled.

    The place of atom i is its site minus i, plus ``beyond``. Because the order is kept, it never decreases
    from one atom to the next. On each side of atom i there may be no more fill sites than atoms.

    Args:
        fill: bool (n_sites,), sites that must hold an atom.
        n_atoms: Number of atoms, no fewer than fill sites.
        beyond: Number of sites by which the line is lengthened on each side.
        places: Result, int64 (>= n_atoms, 2), first and last place, last included.
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


@helper_kernel()
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
    """Find the cheapest goals of a line's atoms that fill every fill site.

    A dynamic programme over atoms and places, as in :func:`reach`. The line is lengthened on both sides by as
    many sites as atoms must be ejected.

    Args:
        source: int64 (n_atoms,), sites of the atoms, ascending, at least one.
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        limit: Maximum number of atoms in a batch.
        slots: Ejection slots on each side. With 0 nothing is ejected.
        cost: Scratch, int64 (>= n_atoms, > 2 n_sites).
        step: Scratch, int16, the same shape.
        goal: Result, int64 (n_atoms,), goals of the atoms, ascending.

    Returns:
        True if all fill sites can be filled.
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
                best = IMPOSSIBLE  # an atom before a fill site must not be followed by an atom beyond it
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


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {GRID}, {GRID}, {GRID}, int64, int64)")
def compress_columns(
    plan: GrowingPlan, atoms: Bools, fill: Bools, clear: Bools, limit: int, slots: int
) -> GrowingPlan:
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
            plan = add_line(plan, (False, col, n_rows), starts, ends, limit, slots)
    return plan
