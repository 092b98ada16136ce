"""The kernels of planners that move one atom at a time: assignment, paths, moves.

They work on a grid with a margin of one site on each side, flattened: a site is
a number, its neighbours are 1 and ``width`` away (``width`` is the number of sites in
a row, margins included), and the margin stands for the places where atoms are ejected.
Masks of sites are bool (n_sites,): ``fill`` marks the sites that must hold an atom,
``clear`` those that must be empty. A path is a list of neighbouring sites, its end first.
"""

from __future__ import annotations

import heapq
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRID: Final = const("bool_", 2)
SITES: Final = "bool_[::1]"

# What a path costs, the worst first; each counts less than one of the next worse.
CROSSED: Final = 1 << 40  # an atom in the way, which must move too
UNWANTED: Final = 1 << 39  # an end that is legal but not wanted; only for end costs
STEP: Final = 1 << 16
TURN: Final = 1 << 2  # and up to 3 for the choice of an end, all else equal

Board = tuple[Bools, Bools, int]
"""Where atoms are, the sites that are not a margin, and the width."""
BOARD: Final = f"Tuple(({SITES}, {SITES}, int64))"

NO_END: Final = -1
N_DIRECTIONS: Final = 4


@helper_kernel(f"bool_[::1]({GRID})")
def with_margin(sites: Bools) -> Bools:
    """Flatten a mask, with a margin of one site, False there."""
    n_rows, n_cols = sites.shape
    width = n_cols + 2
    flat = np.zeros((n_rows + 2) * width, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            flat[(row + 1) * width + col + 1] = sites[row, col]
    return flat


@helper_kernel(f"int64[::1]({const('int64', 1)}, int64)")
def sites_with_margin(sites: Ints, n_cols: int) -> Ints:
    """Renumber sites, row * n_cols + col without the margin."""
    return (sites // n_cols + 1) * (n_cols + 2) + sites % n_cols + 1


@helper_kernel(f"{BOARD}({GRID})")
def board_of(occupied: Bools) -> Board:
    """Put the atoms of a grid onto a board."""
    inside = with_margin(np.ones(occupied.shape, np.bool_))
    return with_margin(occupied), inside, occupied.shape[1] + 2


@helper_kernel("int64[::1](int64[::1], int64, int64)")
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


@helper_kernel(f"int64[::1]({BOARD}, {SITES}, int64[::1])")
def cheapest_path(board: Board, starts: Bools, end_cost: Ints) -> Ints:
    """Find the path from a start to an end that crosses the fewest atoms; then the shortest and straightest.

    Dijkstra's algorithm over sites and directions of arrival. Atoms at the start and at
    the end are not crossed; only ends may lie on the margin.

    Args:
        board: The board.
        starts: bool (n_sites,), where the path may start.
        end_cost: int64 (n_sites,), what to add for a path that ends there, or ``NO_END``;
            no start is an end.

    Returns:
        int64 (n,); empty if there is none.
    """
    atoms, inside, width = board
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


Moves = NDArray[np.int16]
Growing = tuple[Moves, Bools, int]
"""A plan that grows: its batches of one atom move, whether each is linked, and how many there are."""

GROWING: Final = "Tuple((int16[:, ::1], bool_[::1], int64))"


@helper_kernel(f"{GROWING}(int64)")
def empty_plan(n_sites: int) -> Growing:
    """Make the arrays of a plan for a grid of ``n_sites``."""
    return np.empty((n_sites, 4), np.int16), np.empty(n_sites, np.bool_), 0


@helper_kernel(f"{GROWING}({GROWING}, int64, int64, int64, boolean)")
def add_batch(plan: Growing, source: int, goal: int, width: int, goes_on: bool) -> Growing:
    """Add a straight move of one atom; ``goes_on`` if the tweezer holds it since the batch before."""
    moves, linked, n = plan
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


@helper_kernel(f"{GROWING}({GROWING}, {BOARD}, int64[::1], int64, int64)")
def carry(plan: Growing, board: Board, path: Ints, start: int, stop: int) -> Growing:
    """Carry the atom at ``path[start]`` to ``path[stop]``, by a batch for each straight piece.

    ``stop`` is before ``start``, and no atom stands between them.
    """
    atoms, inside, width = board
    corner = start
    for at in range(start - 1, stop - 1, -1):
        if at == stop or path[at - 1] - path[at] != path[at] - path[at + 1]:
            plan = add_batch(plan, path[corner], path[at], width, corner != start)
            corner = at
    atoms[path[start]] = False
    atoms[path[stop]] = inside[path[stop]]
    return plan


@helper_kernel(f"{GROWING}({GROWING}, {BOARD}, int64[::1])")
def shift(plan: Growing, board: Board, path: Ints) -> Growing:
    """Move every atom of a path on to the next free place towards the path's first site, which is free."""
    free = 0
    for at in range(1, len(path)):
        if board[0][path[at]]:
            plan = carry(plan, board, path, at, free)
            free = at
    return plan


@helper_kernel(f"{GROWING}({GROWING}, {BOARD}, {GRID}, {GRID}, boolean)")
def clear_surplus(
    plan: Growing, board: Board, fill_sites: Bools, clear_sites: Bools, may_eject: bool
) -> Growing:
    """Move the atoms on clear sites to free reservoir sites, or off the grid where there is none.

    The atom with the cheapest path goes first. Atoms on its path go on to the next
    place, so that the path costs one move more for each.
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


@kernel(f"{GROWING}({GRID}, {GRID}, {GRID}, {const('int64', 1)}, boolean)")
def plan_compression(
    occupied: Bools, fill_sites: Bools, clear_sites: Bools, order: Ints, may_eject: bool
) -> Growing:
    """Fill each site in turn with the nearest atom not placed yet, then clear what must be empty.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        order: int64 (n_fill,), the fill sites, row * n_cols + col, the innermost first.
        may_eject: Whether atoms can be ejected.

    Returns:
        moves, int16 (>= n, 4), and whether each is linked, bool (>= n,); their number n.
    """
    n_cols = occupied.shape[1]
    plan, board = empty_plan(occupied.size), board_of(occupied)
    atoms = board[0]
    fill, clear = with_margin(fill_sites), with_margin(clear_sites)
    end_cost = np.full(len(atoms), NO_END, np.int64)
    for site in range(len(atoms)):
        if atoms[site]:
            end_cost[site] = 2 if fill[site] else (0 if clear[site] else 1)
    hole = np.zeros(len(atoms), np.bool_)
    for site in sites_with_margin(order, n_cols):
        if not atoms[site]:
            hole[site] = True
            path = cheapest_path(board, hole, end_cost)
            hole[site] = False
            end_cost[path[0]] = NO_END
            plan = shift(plan, board, path[::-1].copy())
        end_cost[site] = NO_END
    return clear_surplus(plan, board, fill_sites, clear_sites, may_eject)


@helper_kernel(f"int64[::1]({BOARD}, {SITES})")
def distance_in_the_open(board: Board, starts: Bools) -> Ints:
    """Measure how far free sites are from the nearest start, along free sites; -1 where no path leads."""
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


@helper_kernel(f"int64(int64[::1], {SITES})")
def farthest(distance: Ints, sites: Bools) -> int:
    """Find the marked site that is farthest; -1 if none is reached."""
    found = -1
    for site in range(len(sites)):
        if sites[site] and distance[site] > 0 and (found < 0 or distance[site] > distance[found]):
            found = site
    return found


@helper_kernel(f"int64[::1]({BOARD}, {SITES}, int64[::1])")
def opening(board: Board, holes: Bools, distance: Ints) -> Ints:
    """Find the path of an atom between a closed region and the open into the region's depth, its goal first.

    Of the closed regions the one with the fewest atoms in the way is taken. The
    atom next to it goes to the hole that is farthest, so that the rest stays one
    region, with one atom less in the way.

    Args:
        board: The board.
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


@kernel(f"{GROWING}({GRID}, {GRID}, {GRID}, boolean)")
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
    return clear_surplus(plan, board, fill_sites, clear_sites, may_eject)


@helper_kernel("int64[::1](int64, int64, int64, boolean)")
def l_shaped(source: int, goal: int, width: int, row_first: bool) -> Ints:
    """List the sites of the L from a source to a goal, along the source's row first or last."""
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


@helper_kernel(f"int64({SITES}, int64[::1])")
def n_in_the_way(atoms: Bools, path: Ints) -> int:
    """Count the atoms on a path, including that on its goal, but not that on its source."""
    n = 0
    for at in range(len(path) - 1):
        if atoms[path[at]]:
            n += 1
    return n


@helper_kernel(f"Tuple((int64, boolean))({SITES}, int64, int64, int64)")
def better_l(atoms: Bools, source: int, goal: int, width: int) -> tuple[int, bool]:
    """Atoms in the way on the better of the two L's, and whether it goes along the row first."""
    n_row_first = n_in_the_way(atoms, l_shaped(source, goal, width, True))
    n_column_first = n_in_the_way(atoms, l_shaped(source, goal, width, False))
    return min(n_row_first, n_column_first), n_row_first <= n_column_first


@helper_kernel(f"Tuple(({GROWING}, int64))({GROWING}, {BOARD}, int64[::1], int64[::1])")
def carry_the_free(plan: Growing, board: Board, goal_of: Ints, waiting: Ints) -> tuple[Growing, int]:
    """Move every waiting atom that has a free path to its goal; go through the list once.

    Args:
        plan: The growing plan.
        board: The board; updated.
        goal_of: int64 (n_sites,), where the atom on each site goes, -1 for nowhere; updated.
        waiting: int64 (n_waiting,), sites of the atoms that have not moved; updated.

    Returns:
        The growing plan, and how many atoms are still waiting.
    """
    atoms, _, width = board
    n_left = 0
    for source in waiting:
        goal = int(goal_of[source])
        if goal < 0 or goal == source:
            continue
        n_atoms, row_first = better_l(atoms, source, goal, width)
        if n_atoms > 0:
            waiting[n_left] = source
            n_left += 1
            continue
        path = l_shaped(source, goal, width, row_first)
        plan = carry(plan, board, path, len(path) - 1, 0)
        goal_of[source] = -1
        goal_of[goal] = goal
    return plan, n_left


@helper_kernel(f"{GROWING}({GROWING}, {BOARD}, int64[::1], int64[::1])")
def exchange(plan: Growing, board: Board, goal_of: Ints, waiting: Ints) -> Growing:
    """Let the last atom in the way go on to the goal, and the one that was to go there take its part.

    Of the waiting atoms the one with the fewest atoms in its way is taken, and it
    takes over what that last one was to do: go to its goal, fill its place, or nothing. The
    distance that is left to go does not grow by it, as both parts of the path
    together are no longer than the whole. Arguments as for :func:`carry_the_free`.
    """
    atoms, _, width = board
    least = np.iinfo(np.int64).max
    source, row_first = 0, True
    for site in waiting:
        n_atoms, is_row_first = better_l(atoms, site, int(goal_of[site]), width)
        if n_atoms < least:
            least, source, row_first = n_atoms, site, is_row_first
    path = l_shaped(source, int(goal_of[source]), width, row_first)
    at = 0
    while not atoms[path[at]]:
        at += 1
    takes_over = goal_of[path[at]]
    if at > 0:
        plan = carry(plan, board, path, at, 0)
        goal_of[path[at]] = -1
    goal_of[path[0]] = path[0]
    goal_of[source] = takes_over
    return plan


@kernel(f"{GROWING}({GRID}, {GRID}, {GRID}, {const('int64', 1)}, {const('int64', 1)}, boolean)")
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
    n_cols = occupied.shape[1]
    plan, board = empty_plan(occupied.size), board_of(occupied)
    goal_of = np.full(len(board[0]), -1, np.int64)
    waiting = sites_with_margin(sources, n_cols)
    goal_of[waiting] = sites_with_margin(goals, n_cols)
    while len(waiting) > 0:
        n_before = plan[2]
        plan, n_waiting = carry_the_free(plan, board, goal_of, waiting)
        waiting = waiting[:n_waiting]
        if plan[2] == n_before and n_waiting > 0:
            plan = exchange(plan, board, goal_of, waiting)
    return clear_surplus(plan, board, fill_sites, clear_sites, may_eject)
