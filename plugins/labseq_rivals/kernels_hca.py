"""Kernels of the heuristic cluster algorithm of Sheng et al., with boards as in ``kernels_board``."""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.plan_kernels import FINISHED_PLAN, FinishedPlan, empty_plan, finished
from labseq_rivals.kernels_board import (
    GRID,
    NO_END,
    UNWANTED,
    Board,
    Bools,
    Ints,
    board_of,
    cheapest_path,
    clear_surplus,
    shift,
    with_margin,
)


@helper_kernel()
def distance_in_the_open(board: Board, starts: Bools) -> Ints:
    """Measure how far free sites are from the nearest start along free sites, or -1 without a path."""
    atoms, inside, width = board
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


@helper_kernel()
def farthest(distance: Ints, sites: Bools) -> int:
    """Find the farthest marked site, or -1 if none is reached."""
    found = -1
    for site in range(len(sites)):
        if sites[site] and distance[site] > 0 and (found < 0 or distance[site] > distance[found]):
            found = site
    return found


@helper_kernel()
def opening(board: Board, holes: Bools, distance: Ints) -> Ints:
    """Find the path, goal first, of an atom between a closed region and the open into the region's depth.

    The closed region with the fewest atoms in the way is taken. The atom next to it goes to the farthest
    hole, so that the rest stays one region, with one atom less in the way.

    Args:
        holes: bool (n_sites,), empty fill sites.
        distance: int64 (n_sites,), from the nearest atom to spare along free sites, or -1.
    """
    atoms = board[0]
    closed = holes & (distance < 0)
    way = cheapest_path(board, closed, np.where(distance < 0, NO_END, 0))
    at = len(way) - 1
    while not atoms[way[at]]:
        at -= 1
    obstacle = np.zeros(len(atoms), np.bool_)
    obstacle[way[at]] = True
    goal = farthest(distance_in_the_open(board, obstacle), closed)
    end_cost = np.full(len(atoms), NO_END, np.int64)
    end_cost[goal] = 0
    return cheapest_path(board, obstacle, end_cost)


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, boolean)")
def plan_clusters(occupied: Bools, fill_sites: Bools, clear_sites: Bools, may_eject: bool) -> FinishedPlan:
    """Open the closed regions, fill the open ones from their depth, then clear what must be empty.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        may_eject: True if atoms can be ejected.
    """
    plan, board = empty_plan(occupied.size), board_of(occupied)
    atoms, fill, clear = board[0], with_margin(fill_sites), with_margin(clear_sites)
    holes = fill & ~atoms
    while holes.any():
        spare = atoms & ~fill
        distance = distance_in_the_open(board, spare)
        if (holes & (distance < 0)).any():
            path = opening(board, holes, distance)
            holes[path[-1]] = True
        else:
            hole = np.zeros(len(atoms), np.bool_)
            hole[farthest(distance, holes)] = True
            end_cost = np.where(spare, np.where(clear, 0, UNWANTED), NO_END)
            path = cheapest_path(board, hole, end_cost)[::-1].copy()
        holes[path[0]] = False
        plan = shift(plan, board, path)
    return finished(clear_surplus(plan, board, fill_sites, clear_sites, may_eject))
