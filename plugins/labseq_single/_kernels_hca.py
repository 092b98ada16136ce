"""Kernels of the heuristic cluster algorithm: closed regions are opened, open regions are filled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import kernel
from labseq_single._kernels_moves import GROWING, Growing, clear_surplus, shift
from labseq_single._kernels_paths import (
    GRID,
    NO_END,
    SITES,
    UNWANTED,
    cheapest_path,
    grid_sites,
    with_margin,
)

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@kernel(f"int64[::1]({SITES}, {SITES}, {SITES}, int64)")
def distance_in_the_open(starts: Bools, atoms: Bools, inside: Bools, width: int) -> Ints:
    """Measure how far free sites are from the nearest start, along free sites.

    Args:
        starts: bool (n_sites,), sites to start from.
        atoms: bool (n_sites,), where atoms are.
        inside: bool (n_sites,), sites that are no margin.
        width: Sites in a row, margins included.

    Returns:
        int64 (n_sites,); -1 where no way leads.
    """
    distance = np.full(len(starts), -1, np.int64)
    queue = np.empty(len(starts), np.int64)
    n_seen = 0
    for site in range(len(starts)):
        if starts[site]:
            distance[site] = 0
            queue[n_seen] = site
            n_seen += 1
    i = 0
    while i < n_seen:
        site = queue[i]
        i += 1
        for step in (-width, -1, 1, width):
            neighbour = site + step
            if inside[neighbour] and not atoms[neighbour] and distance[neighbour] < 0:
                distance[neighbour] = distance[site] + 1
                queue[n_seen] = neighbour
                n_seen += 1
    return distance


@kernel(f"int64(int64[::1], {SITES})")
def farthest(distance: Ints, sites: Bools) -> int:
    """Find the marked site that is farthest; -1 if none is reached."""
    found = -1
    for site in range(len(sites)):
        if sites[site] and distance[site] > 0 and (found < 0 or distance[site] > distance[found]):
            found = site
    return found


@kernel(f"int64[::1]({SITES}, {SITES}, int64, {SITES}, int64[::1])")
def opening(atoms: Bools, inside: Bools, width: int, holes: Bools, distance: Ints) -> Ints:
    """Find how an atom between a closed region and the open moves into the region's depth.

    Of the closed regions the one with the fewest atoms in the way is taken. The
    atom next to it goes to the hole that is farthest, so that the rest stays one
    region, with one atom less in the way.

    Args:
        atoms: bool (n_sites,), where atoms are.
        inside: bool (n_sites,), sites that are no margin.
        width: Sites in a row, margins included.
        holes: bool (n_sites,), empty fill sites.
        distance: int64 (n_sites,), from the nearest atom to spare along free sites, or -1.

    Returns:
        The path of that atom, its goal first.
    """
    closed = holes & (distance < 0)
    way = cheapest_path(atoms, inside, width, closed, np.where(distance < 0, NO_END, 0))
    at = len(way) - 1
    while not atoms[way[at]]:
        at -= 1
    obstacle = np.zeros(len(atoms), np.bool_)
    obstacle[way[at]] = True
    goal = farthest(distance_in_the_open(obstacle, atoms, inside, width), closed)
    end_cost = np.full(len(atoms), NO_END, np.int64)
    end_cost[goal] = 0
    return cheapest_path(atoms, inside, width, obstacle, end_cost)


@kernel(f"Tuple(({GROWING}))({GRID}, {GRID}, {GRID}, boolean)")
def plan_clusters(occupied: Bools, fill_sites: Bools, clear_sites: Bools, may_eject: bool) -> Growing:
    """Open the closed regions, fill the open ones from their depth, then clear what must be empty.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        may_eject: Whether atoms can be ejected.

    Returns:
        moves, int16 (>= n, 4), and whether each is linked, bool (>= n,); their number n.
    """
    n_rows, n_cols = occupied.shape
    width = n_cols + 2
    atoms, inside = with_margin(occupied), grid_sites(n_rows, n_cols)
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    moves, linked, n = np.empty((occupied.size, 4), np.int16), np.empty(occupied.size, np.bool_), 0
    holes = fill & ~atoms
    while holes.any():
        spare = atoms & ~fill
        distance = distance_in_the_open(spare, atoms, inside, width)
        if (holes & (distance < 0)).any():
            path = opening(atoms, inside, width, holes, distance)
            holes[path[-1]] = True
        else:
            hole = np.zeros(len(atoms), np.bool_)
            hole[farthest(distance, holes)] = True
            end_cost = np.where(spare, np.where(clear, 0, UNWANTED), NO_END)
            path = cheapest_path(atoms, inside, width, hole, end_cost)[::-1].copy()
        holes[path[0]] = False
        moves, linked, n = shift(moves, linked, n, atoms, inside, width, path)
    return clear_surplus(moves, linked, n, atoms, inside, width, fill, clear, may_eject)
