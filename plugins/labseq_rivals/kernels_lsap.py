"""Kernels that carry out an assignment like Schymik et al., with boards and paths as in ``kernels_board``."""

from __future__ import annotations

import numpy as np

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    FinishedPlan,
    GrowingPlan,
    count_moves,
    empty_plan,
    finished,
)
from labseq_rivals.kernels_board import (
    GRID,
    Board,
    Bools,
    Ints,
    board_of,
    carry,
    clear_surplus,
    sites_with_margin,
)


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


@helper_kernel()
def n_in_the_way(atoms: Bools, path: Ints) -> int:
    """Count the atoms on a path, including its goal but not its source."""
    n = 0
    for at in range(len(path) - 1):
        if atoms[path[at]]:
            n += 1
    return n


@helper_kernel()
def better_l(atoms: Bools, source: int, goal: int, width: int) -> tuple[int, bool]:
    """Atoms in the way on the better of the two L's, and whether it goes along the row first."""
    n_row_first = n_in_the_way(atoms, l_shaped(source, goal, width, True))
    n_column_first = n_in_the_way(atoms, l_shaped(source, goal, width, False))
    return min(n_row_first, n_column_first), n_row_first <= n_column_first


@helper_kernel()
def carry_the_free(plan: GrowingPlan, board: Board, goal_of: Ints, waiting: Ints) -> tuple[GrowingPlan, int]:
    """Go once through the waiting atoms, and move each atom that has a free path to its goal.

    Args:
        board: The board. Updated.
        goal_of: int64 (n_sites,), goal of the atom on each site, or -1. Updated.
        waiting: int64 (n_waiting,), sites of the atoms that have not moved. Updated.

    Returns:
        The growing plan, and the number of atoms still waiting.
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


@helper_kernel()
def exchange(plan: GrowingPlan, board: Board, goal_of: Ints, waiting: Ints) -> GrowingPlan:
    """Let the last atom in the way go on to the goal, and exchange its part with the atom meant to go there.

    The waiting atom with the fewest atoms in its way is taken. It takes over the task of the last atom in its
    way, which is to go to its goal, fill its place, or nothing. The remaining distance does not grow, because
    both parts of the path together are no longer than the whole. Arguments as for :func:`carry_the_free`.
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


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, {const('int64', 1)}, {const('int64', 1)}, boolean)")
def plan_assignment(
    occupied: Bools, fill_sites: Bools, clear_sites: Bools, sources: Ints, goals: Ints, may_eject: bool
) -> FinishedPlan:
    """Carry out an assignment, then clear what must be empty.

    Atoms with a free goal and a free L go first. Only when none is left, two atoms exchange their parts.
    Every step takes an atom to its goal for good or settles a goal without a move, so it ends.

    Args:
        occupied: bool (n_rows, n_cols).
        fill_sites: bool (n_rows, n_cols), sites that must hold an atom.
        clear_sites: bool (n_rows, n_cols), sites that must be empty.
        sources: int64 (n_fill,), sites of the atoms, row * n_cols + col.
        goals: int64 (n_fill,), goal of each atom, every fill site once.
        may_eject: True if atoms can be ejected.
    """
    n_cols = occupied.shape[1]
    plan, board = empty_plan(occupied.size), board_of(occupied)
    goal_of = np.full(len(board[0]), -1, np.int64)
    waiting = sites_with_margin(sources, n_cols)
    goal_of[waiting] = sites_with_margin(goals, n_cols)
    while len(waiting) > 0:
        n_before = count_moves(plan)
        plan, n_waiting = carry_the_free(plan, board, goal_of, waiting)
        waiting = waiting[:n_waiting]
        if count_moves(plan) == n_before and n_waiting > 0:
            plan = exchange(plan, board, goal_of, waiting)
    return finished(clear_surplus(plan, board, fill_sites, clear_sites, may_eject))
