"""Kernels that find ways over the grid and carry atoms along them.

They work on a grid with a margin of one site on each side, flattened: a site is
a number, its neighbours are 1 and ``width`` away, and the margin stands for the
places where atoms are ejected. A path is a list of neighbouring sites.
"""

from __future__ import annotations

import heapq
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID: Final = const("bool_", 2)
SITES: Final = "bool_[::1]"

# What a path costs, the worst first; each counts less than one of the next worse.
CROSSED: Final = 1 << 40  # an atom in the way, which must move too
UNWANTED: Final = 1 << 39  # an end that is legal but not wanted; only for end costs
STEP: Final = 1 << 16
TURN: Final = 1 << 2  # and up to 3 for the choice of an end, all else equal

NO_END: Final = -1
N_DIRECTIONS: Final = 4


@kernel(f"bool_[::1]({GRID})")
def with_margin(sites: Bools) -> Bools:
    """Flatten a mask, with a margin of one site, False there."""
    n_rows, n_cols = sites.shape
    width = n_cols + 2
    flat = np.zeros((n_rows + 2) * width, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            flat[(row + 1) * width + col + 1] = sites[row, col]
    return flat


@kernel(f"int64[::1]({const('int64', 1)}, int64)")
def sites_with_margin(sites: Ints, n_cols: int) -> Ints:
    """Renumber sites, row * n_cols + col without the margin."""
    return (sites // n_cols + 1) * (n_cols + 2) + sites % n_cols + 1


@kernel("bool_[::1](int64, int64)")
def grid_sites(n_rows: int, n_cols: int) -> Bools:
    """Mark the sites that are no margin."""
    width = n_cols + 2
    inside = np.zeros((n_rows + 2) * width, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            inside[(row + 1) * width + col + 1] = True
    return inside


@kernel("int64[::1](int64[::1], int64, int64)")
def trace(came_from: Ints, state: int, n_sites: int) -> Ints:
    """List the sites of the states that led to a state, beginning with its own."""
    n = 0
    at = state
    while at >= 0:
        n += 1
        at = came_from[at]
    path = np.empty(n, np.int64)
    at = state
    for i in range(n):
        path[i] = at % n_sites
        at = came_from[at]
    return path


@kernel(f"int64[::1]({SITES}, {SITES}, int64, {SITES}, int64[::1])")
def cheapest_path(atoms: Bools, inside: Bools, width: int, starts: Bools, end_cost: Ints) -> Ints:
    """Find the path from a start to an end that crosses the fewest atoms; then the shortest and straightest.

    Dijkstra's algorithm over sites and directions of arrival.

    Args:
        atoms: bool (n_sites,), where atoms are. Those at the start and the end are not crossed.
        inside: bool (n_sites,), sites that are no margin; only ends may lie on the margin.
        width: Sites in a row, margins included.
        starts: bool (n_sites,), where the path may start.
        end_cost: int64 (n_sites,), what to add for a path that ends there, or ``NO_END``;
            no start is an end.

    Returns:
        int64 (n,): the path's sites, its end first; empty if there is none.
    """
    n_sites = len(atoms)
    steps = (-width, -1, 1, width)
    finish = N_DIRECTIONS * n_sites  # states from here on: the path ends at this site
    cost = np.full(finish + n_sites, np.iinfo(np.int64).max)
    came_from = np.full(finish + n_sites, -1, np.int64)
    queue = [(np.int64(0), np.int64(0)) for _ in range(0)]
    for direction in range(N_DIRECTIONS):
        for site in range(n_sites):
            if starts[site]:
                state = np.int64(direction * n_sites + site)
                cost[state] = 0
                queue.append((np.int64(0), state))  # in ascending order: a heap
    while len(queue) > 0:
        so_far, state = heapq.heappop(queue)
        if so_far > cost[state]:
            continue
        if state >= finish:
            return trace(came_from, int(state), n_sites)
        site = state % n_sites
        for direction in range(N_DIRECTIONS):
            neighbour = site + steps[direction]
            here = so_far + STEP + (TURN if direction != state // n_sites else 0)
            if end_cost[neighbour] != NO_END:
                new = np.int64(finish + neighbour)
                if here + end_cost[neighbour] < cost[new]:
                    cost[new] = here + end_cost[neighbour]
                    came_from[new] = state
                    heapq.heappush(queue, (cost[new], new))
            if inside[neighbour]:
                new = np.int64(direction * n_sites + neighbour)
                here += CROSSED if atoms[neighbour] else 0
                if here < cost[new]:
                    cost[new] = here
                    came_from[new] = state
                    heapq.heappush(queue, (cost[new], new))
    return np.empty(0, np.int64)
