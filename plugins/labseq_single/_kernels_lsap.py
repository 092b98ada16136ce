"""Kernels that carry out an assignment of atoms to goals, one L-shaped move after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_single._kernels_moves import GROWING, Growing, carry, clear_surplus
from labseq_single._kernels_paths import GRID, SITES, grid_sites, sites_with_margin, with_margin

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]


@kernel("int64[::1](int64, int64, int64, boolean)")
def l_shaped(source: int, goal: int, width: int, row_first: bool) -> Ints:
    """List the sites of the L from a source to a goal, the goal first.

    Args:
        source: Site where the atom is.
        goal: Site where it goes.
        width: Sites in a row, margins included.
        row_first: Whether it goes along its row first.
    """
    down = goal // width - source // width
    right = goal % width - source % width
    path = np.empty(abs(down) + abs(right) + 1, np.int64)
    path[-1] = source
    at = source
    n = len(path) - 1
    for along_row in (row_first, not row_first):
        step = (1 if right > 0 else -1) if along_row else (width if down > 0 else -width)
        for _ in range(abs(right) if along_row else abs(down)):
            at += step
            n -= 1
            path[n] = at
    return path


@kernel(f"int64({SITES}, int64[::1])")
def n_in_the_way(atoms: Bools, path: Ints) -> int:
    """Count the atoms on a path, that on its goal included, that on its source not."""
    n = 0
    for at in range(len(path) - 1):
        if atoms[path[at]]:
            n += 1
    return n


@kernel(f"Tuple((int64, boolean))({SITES}, int64, int64, int64)")
def better_l(atoms: Bools, source: int, goal: int, width: int) -> tuple[int, bool]:
    """Count the atoms in the way on the better of the two L's; tell whether it goes along the row first."""
    n_row_first = n_in_the_way(atoms, l_shaped(source, goal, width, True))
    n_column_first = n_in_the_way(atoms, l_shaped(source, goal, width, False))
    return min(n_row_first, n_column_first), n_row_first <= n_column_first


@kernel(f"Tuple(({GROWING}, int64))({GROWING}, {SITES}, {SITES}, int64, int64[::1], int64[::1], int64)")
def carry_the_free(
    moves: Moves,
    linked: Bools,
    n: int,
    atoms: Bools,
    inside: Bools,
    width: int,
    goal_of: Ints,
    waiting: Ints,
    n_waiting: int,
) -> tuple[Moves, Bools, int, int]:
    """Move every waiting atom that has a free way to its goal; go through the list once.

    Args:
        moves: Of the growing plan, as ``linked`` and ``n``.
        linked: bool (>= n,).
        n: Number of batches so far.
        atoms: bool (n_sites,), updated.
        inside: bool (n_sites,), sites that are no margin.
        width: Sites in a row, margins included.
        goal_of: int64 (n_sites,), where the atom on each site goes, -1 for nowhere; updated.
        waiting: int64 (>= n_waiting,), sites of the atoms that have not moved; updated.
        n_waiting: Their number.

    Returns:
        The growing plan, and how many atoms are still waiting.
    """
    n_left = 0
    for i in range(n_waiting):
        source = waiting[i]
        goal = int(goal_of[source])
        if goal < 0 or goal == source:
            continue
        n_atoms, row_first = better_l(atoms, source, goal, width)
        if n_atoms > 0:
            waiting[n_left] = source
            n_left += 1
            continue
        path = l_shaped(source, goal, width, row_first)
        moves, linked, n = carry(moves, linked, n, atoms, inside, width, path, len(path) - 1, 0)
        goal_of[source] = -1
        goal_of[goal] = goal
    return moves, linked, n, n_left


@kernel(f"Tuple(({GROWING}))({GROWING}, {SITES}, {SITES}, int64, int64[::1], int64[::1], int64)")
def exchange(
    moves: Moves,
    linked: Bools,
    n: int,
    atoms: Bools,
    inside: Bools,
    width: int,
    goal_of: Ints,
    waiting: Ints,
    n_waiting: int,
) -> Growing:
    """Let the last atom in the way go on to the goal, and the one that was to go there take its part.

    Of the waiting atoms the one with the fewest atoms in its way is taken, and it
    takes over what that last one was to do: go to its goal, fill its place, or nothing. The
    distance that is left to go does not grow by it, as both parts of the way
    together are no longer than the whole.

    Arguments as for :func:`carry_the_free`.
    """
    least = np.iinfo(np.int64).max
    source, row_first = 0, True
    for i in range(n_waiting):
        n_atoms, is_row_first = better_l(atoms, waiting[i], int(goal_of[waiting[i]]), width)
        if n_atoms < least:
            least, source, row_first = n_atoms, waiting[i], is_row_first
    path = l_shaped(source, int(goal_of[source]), width, row_first)
    at = 0
    while not atoms[path[at]]:
        at += 1
    takes_over = goal_of[path[at]]
    if at > 0:
        moves, linked, n = carry(moves, linked, n, atoms, inside, width, path, at, 0)
        goal_of[path[at]] = -1
    goal_of[path[0]] = path[0]
    goal_of[source] = takes_over
    return moves, linked, n


@kernel(f"Tuple(({GROWING}))({GRID}, {GRID}, {GRID}, {const('int64', 1)}, {const('int64', 1)}, boolean)")
def plan_assignment(
    occupied: Bools, fill_sites: Bools, clear_sites: Bools, sources: Ints, goals: Ints, may_eject: bool
) -> Growing:
    """Carry out an assignment, then clear what must be empty.

    Atoms with a free goal and a free L go first, and only where none is left do
    two atoms exchange their parts. Every step takes an atom to its goal for good
    or settles a goal without a move, so it ends.

    Args:
        occupied: bool (n_rows, n_cols).
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        sources: int64 (n_fill,), where the atoms are, row * n_cols + col.
        goals: int64 (n_fill,), where each goes; every fill site once.
        may_eject: Whether atoms can be ejected.

    Returns:
        moves, int16 (>= n, 4), and whether each is linked, bool (>= n,); their number n.
    """
    n_rows, n_cols = occupied.shape
    width = n_cols + 2
    atoms, inside = with_margin(occupied), grid_sites(n_rows, n_cols)
    moves, linked, n = np.empty((occupied.size, 4), np.int16), np.empty(occupied.size, np.bool_), 0
    goal_of = np.full(len(atoms), -1, np.int64)
    waiting = sites_with_margin(sources, n_cols)
    goal_of[waiting] = sites_with_margin(goals, n_cols)
    n_waiting = len(waiting)
    while n_waiting > 0:
        n_before = n
        moves, linked, n, n_waiting = carry_the_free(
            moves, linked, n, atoms, inside, width, goal_of, waiting, n_waiting
        )
        if n == n_before and n_waiting > 0:
            moves, linked, n = exchange(moves, linked, n, atoms, inside, width, goal_of, waiting, n_waiting)
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    return clear_surplus(moves, linked, n, atoms, inside, width, fill, clear, may_eject)
