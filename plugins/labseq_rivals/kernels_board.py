"""Kernels for boards, paths and surplus atoms that the planners with a single tweezer share.

They work on a flattened grid with a margin of one site on each side. A site is a number, and its neighbours
are 1 and ``width`` away. ``width`` is the number of sites in a row, margins included. The margin represents
the places where atoms are ejected. Masks of sites are bool (n_sites,). ``fill`` marks the sites that must
hold an atom, and ``clear`` the sites that must be empty. A path is a list of neighbouring sites, its end
first.
"""

from __future__ import annotations

import heapq
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel
from labseq.plugin.plan_kernels import GROWING_PLAN, GrowingPlan, add_move, end_batch

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID: Final = const("bool_", 2)

# Costs of a path, the worst first. Each counts less than one of the next worse.
CROSSED: Final = 1 << 40  # an atom in the way, which must also move
UNWANTED: Final = 1 << 39  # an end that is legal but not wanted, only for end costs
STEP: Final = 1 << 16
TURN: Final = 1 << 2  # and up to 3 for the choice of an end if all else is equal

Board = tuple[Bools, Bools, int]
"""Sites of atoms, sites that are not in the margin, and the width."""
BOARD: Final = "Tuple((bool_[::1], bool_[::1], int64))"

NO_END: Final = -1
N_DIRECTIONS: Final = 4


@helper_kernel(f"bool_[::1]({GRID})")
def with_margin(sites: Bools) -> Bools:
    """Flatten a mask, with a margin of one site that is False."""
    n_rows, n_cols = sites.shape
    width = n_cols + 2
    flat = np.zeros((n_rows + 2) * width, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            flat[(row + 1) * width + col + 1] = sites[row, col]
    return flat


@helper_kernel()
def sites_with_margin(sites: Ints, n_cols: int) -> Ints:
    """Renumber sites, row * n_cols + col without the margin."""
    return (sites // n_cols + 1) * (n_cols + 2) + sites % n_cols + 1


@helper_kernel()
def board_of(occupied: Bools) -> Board:
    """Put the atoms of a grid on a board."""
    inside = with_margin(np.ones(occupied.shape, np.bool_))
    return with_margin(occupied), inside, occupied.shape[1] + 2


@helper_kernel()
def trace(came_from: Ints, state: int, n_sites: int) -> Ints:
    """List the sites of the states that led to a state, starting with its own."""
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


@helper_kernel(f"int64[::1]({BOARD}, bool_[::1], int64[::1])")
def cheapest_path(board: Board, starts: Bools, end_cost: Ints) -> Ints:
    """Find the path from a start to an end that crosses the fewest atoms, then the shortest and straightest.

    Dijkstra's algorithm over sites and directions of arrival. Atoms at the start and at the end are not
    crossed. Only ends may be in the margin.

    Args:
        starts: bool (n_sites,), where the path may start.
        end_cost: int64 (n_sites,), cost to add for a path that ends there, or ``NO_END``. No start is an end.

    Returns:
        int64 (n,), empty if there is none.
    """
    atoms, inside, width = board
    n_sites = len(atoms)
    steps = (-width, -1, 1, width)
    finish = N_DIRECTIONS * n_sites  # from here on, the path of a state ends at this site
    cost = np.full(finish + n_sites, np.iinfo(np.int64).max)
    came_from = np.full(finish + n_sites, -1, np.int64)
    queue = [(np.int64(0), np.int64(0)) for _ in range(0)]
    for direction in range(N_DIRECTIONS):
        for site in range(n_sites):
            if starts[site]:
                state = np.int64(direction * n_sites + site)
                cost[state] = 0
                queue.append((np.int64(0), state))  # ascending, so it is a heap
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


@helper_kernel()
def add_segment(plan: GrowingPlan, source: int, goal: int, width: int, goes_on: bool) -> GrowingPlan:
    """Add a straight move of one atom, with ``goes_on`` if the tweezer has held it since the batch before."""
    row, col, to_row, to_col = source // width - 1, source % width - 1, goal // width - 1, goal % width - 1
    return end_batch(add_move(plan, row, col, to_row, to_col), goes_on)


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {BOARD}, int64[::1], int64, int64)")
def carry(plan: GrowingPlan, board: Board, path: Ints, start: int, stop: int) -> GrowingPlan:
    """Carry the atom at ``path[start]`` to ``path[stop]``, by a batch for each straight piece.

    ``stop`` is before ``start``, and no atom is between them.
    """
    atoms, inside, width = board
    corner = start
    for at in range(start - 1, stop - 1, -1):
        if at == stop or path[at - 1] - path[at] != path[at] - path[at + 1]:
            plan = add_segment(plan, path[corner], path[at], width, corner != start)
            corner = at
    atoms[path[start]] = False
    atoms[path[stop]] = inside[path[stop]]
    return plan


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {BOARD}, int64[::1])")
def shift(plan: GrowingPlan, board: Board, path: Ints) -> GrowingPlan:
    """Move every atom of a path on to the next free place towards the path's first site, which is free."""
    free = 0
    for at in range(1, len(path)):
        if board[0][path[at]]:
            plan = carry(plan, board, path, at, free)
            free = at
    return plan


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {BOARD}, {GRID}, {GRID}, boolean)")
def clear_surplus(
    plan: GrowingPlan, board: Board, fill_sites: Bools, clear_sites: Bools, may_eject: bool
) -> GrowingPlan:
    """Move the atoms on clear sites to free reservoir sites, or off the grid if there is none.

    The atom with the cheapest path goes first. Each atom on its path goes on to the next place, so that the
    path costs one move more.
    """
    atoms, inside, _ = board
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    surplus = clear & atoms
    end_cost = np.full(len(atoms), NO_END, np.int64)
    for site in range(len(atoms)):
        if not inside[site]:
            end_cost[site] = UNWANTED if may_eject else NO_END
        elif not (atoms[site] or fill[site] or clear[site]):
            end_cost[site] = 0
    while surplus.any():
        path = cheapest_path(board, surplus, end_cost)
        if len(path) == 0:
            break
        plan = shift(plan, board, path)
        surplus[path[-1]] = False
        if inside[path[0]]:
            end_cost[path[0]] = NO_END
    return plan
