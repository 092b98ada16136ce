"""Kernels that carry atoms along paths, and the plan that grows by it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_single._kernels_paths import NO_END, SITES, UNWANTED, cheapest_path

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]
Growing = tuple[Moves, Bools, int]
"""A plan that grows: its batches of one atom move, whether each is linked, and how many there are."""

GROWING: Final = "int16[:, ::1], bool_[::1], int64"


@kernel(f"Tuple(({GROWING}))({GROWING}, int64, int64, int64, boolean)")
def add_batch(
    moves: Moves, linked: Bools, n: int, source: int, goal: int, width: int, goes_on: bool
) -> Growing:
    """Add a straight move of one atom to a growing plan.

    Args:
        moves: Of the growing plan, int16 (>= n, 4), as ``linked`` and ``n``.
        linked: bool (>= n,).
        n: Number of batches so far.
        source: Site where the atom is.
        goal: Site where it goes.
        width: Sites in a row, margins included.
        goes_on: Whether the tweezer holds the atom since the batch before.
    """
    if n == len(moves):
        more_moves = np.empty((2 * n, 4), np.int16)
        more_linked = np.empty(2 * n, np.bool_)
        more_moves[:n] = moves
        more_linked[:n] = linked
        moves, linked = more_moves, more_linked
    moves[n, 0] = source // width - 1
    moves[n, 1] = source % width - 1
    moves[n, 2] = goal // width - 1
    moves[n, 3] = goal % width - 1
    linked[n] = goes_on
    return moves, linked, n + 1


@kernel(f"Tuple(({GROWING}))({GROWING}, {SITES}, {SITES}, int64, int64[::1], int64, int64)")
def carry(
    moves: Moves,
    linked: Bools,
    n: int,
    atoms: Bools,
    inside: Bools,
    width: int,
    path: Ints,
    start: int,
    stop: int,
) -> Growing:
    """Carry the atom at one place of a path to an earlier one, by a batch for each straight piece.

    Args:
        moves: Of the growing plan, as ``linked`` and ``n``.
        linked: bool (>= n,).
        n: Number of batches so far.
        atoms: bool (n_sites,), updated; no atom between the two places.
        inside: bool (n_sites,), sites that are no margin.
        width: Sites in a row, margins included.
        path: int64, neighbouring sites.
        start: Where in the path the atom is.
        stop: Where in the path it goes; before ``start``.
    """
    corner = start
    for at in range(start - 1, stop - 1, -1):
        if at == stop or path[at - 1] - path[at] != path[at] - path[at + 1]:
            moves, linked, n = add_batch(moves, linked, n, path[corner], path[at], width, corner != start)
            corner = at
    atoms[path[start]] = False
    atoms[path[stop]] = inside[path[stop]]
    return moves, linked, n


@kernel(f"Tuple(({GROWING}))({GROWING}, {SITES}, {SITES}, int64, int64[::1])")
def shift(
    moves: Moves, linked: Bools, n: int, atoms: Bools, inside: Bools, width: int, path: Ints
) -> Growing:
    """Move every atom of a path on to the next free place towards the path's first site, which is free.

    Arguments as for :func:`carry`.
    """
    free = 0
    for at in range(1, len(path)):
        if atoms[path[at]]:
            moves, linked, n = carry(moves, linked, n, atoms, inside, width, path, at, free)
            free = at
    return moves, linked, n


@kernel(f"Tuple(({GROWING}))({GROWING}, {SITES}, {SITES}, int64, {SITES}, {SITES}, boolean)")
def clear_surplus(
    moves: Moves,
    linked: Bools,
    n: int,
    atoms: Bools,
    inside: Bools,
    width: int,
    fill: Bools,
    clear: Bools,
    may_eject: bool,
) -> Growing:
    """Bring the atoms on clear sites to free reservoir sites, or off the grid where there is none.

    The atom with the cheapest way goes first. Atoms in its way go on to the next
    place, so that the way costs one move more for each.

    Args:
        moves: Of the growing plan, as ``linked`` and ``n``.
        linked: bool (>= n,).
        n: Number of batches so far.
        atoms: bool (n_sites,), updated.
        inside: bool (n_sites,), sites that are no margin.
        width: Sites in a row, margins included.
        fill: bool (n_sites,), sites that must hold an atom.
        clear: bool (n_sites,), sites that must be empty.
        may_eject: Whether atoms can be ejected.
    """
    surplus = clear & atoms
    end_cost = np.full(len(atoms), NO_END, np.int64)
    for site in range(len(atoms)):
        if not inside[site]:
            end_cost[site] = UNWANTED if may_eject else NO_END
        elif not (atoms[site] or fill[site] or clear[site]):
            end_cost[site] = 0
    while surplus.any():
        path = cheapest_path(atoms, inside, width, surplus, end_cost)
        if len(path) == 0:
            break
        moves, linked, n = shift(moves, linked, n, atoms, inside, width, path)
        surplus[path[-1]] = False
        if inside[path[0]]:
            end_cost[path[0]] = NO_END
    return moves, linked, n
