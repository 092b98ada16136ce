"""Kernels that add atom moves and batches to a plan, for the kernels of planners.

Each kernel takes the plan and returns it, because the arrays are replaced when they are full::

    plan = empty_plan(n_sites)
    plan = end_batch(add_move(plan, row, col, to_row, to_col), False)
    return finished(plan)

The atoms of a line, which is a row or a column, keep their order. Its moves are therefore two ascending lists
of sites, with the atoms before (``source``) and after (``goal``). Sites below 0, and ``n_sites`` or more, are
outside of the grid and mean ejection.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel
from labseq.model import Plan

__all__ = [
    "FINISHED_PLAN",
    "GROWING_PLAN",
    "FinishedPlan",
    "GrowingPlan",
    "Line",
    "add_line",
    "add_move",
    "add_turns",
    "as_plan",
    "column_sums",
    "count_moves",
    "empty_plan",
    "end_batch",
    "finished",
    "move_alone",
    "sites_of",
    "take_turns",
    "unlock_row",
]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]
Offsets = NDArray[np.int32]
GrowingPlan = tuple[Moves, Offsets, Bools, int]
"""Moves, starts of all batches and end of the current batch, linked flags, and number of batches."""
FinishedPlan = tuple[Moves, Offsets, Bools]
"""moves, int16 (n_moves, 4), batch offsets, int32 (n_batches + 1,), and linked, bool (n_batches,)."""
FINISHED_PLAN: Final = "Tuple((int16[:, ::1], int32[::1], bool_[::1]))"
"""Type of a finished plan, for the signature of a kernel that returns it."""
GROWING_PLAN: Final = "Tuple((int16[:, ::1], int32[::1], bool_[::1], int64))"
"""Type of a plan that grows, for the signature of a kernel that takes it."""
Line = tuple[bool, int, int]
"""Whether it is a row, its index, and its number of sites."""

# With signatures, these kernels are compiled once, and not as part of each planner.
LINE: Final = "Tuple((boolean, int64, int64))"
SITES: Final = const("int64", 1)


@helper_kernel(f"{GROWING_PLAN}(int64)")
def empty_plan(n_moves: int) -> GrowingPlan:
    """Make a plan without moves, with room for ``n_moves``. It grows if necessary."""
    offsets = np.empty(n_moves + 2, np.int32)
    offsets[0] = offsets[1] = 0
    return np.empty((n_moves, 4), np.int16), offsets, np.empty(n_moves, np.bool_), 0


@helper_kernel(f"int64({GROWING_PLAN})")
def count_moves(plan: GrowingPlan) -> int:
    """Count the atom moves of a plan, including the current batch."""
    return plan[1][plan[3] + 1]


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, int64)")
def with_room(plan: GrowingPlan, n_more: int) -> GrowingPlan:
    """Lengthen a plan, unless it has room for ``n_more`` moves."""
    moves, offsets, linked, n_batches = plan
    n_moves = count_moves(plan)
    if n_moves + n_more <= len(moves):
        return plan
    longer = empty_plan(2 * len(moves) + n_more)
    # element by element, because numba takes seconds to compile the assignment of slices
    for n in range(n_moves):
        for k in range(4):
            longer[0][n, k] = moves[n, k]
    for n in range(n_batches + 2):
        longer[1][n] = offsets[n]
    for n in range(n_batches):
        longer[2][n] = linked[n]
    return longer[0], longer[1], longer[2], n_batches


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, int64, int64, int64, int64)")
def add_move(plan: GrowingPlan, row: int, col: int, to_row: int, to_col: int) -> GrowingPlan:
    """Add an atom move to the current batch."""
    plan = with_room(plan, 1)
    n = count_moves(plan)
    move = plan[0][n]
    move[0], move[1], move[2], move[3] = row, col, to_row, to_col
    plan[1][plan[3] + 1] = n + 1
    return plan


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, boolean)")
def end_batch(plan: GrowingPlan, is_linked: bool) -> GrowingPlan:
    """End the current batch and begin the next, unless the current batch has no atom moves.

    The ended batch ``is_linked`` if its tweezers hold the same atoms since the batch before.
    """
    moves, offsets, linked, n_batches = plan
    n_moves = count_moves(plan)
    if n_moves == offsets[n_batches]:
        return plan
    linked[n_batches] = is_linked
    offsets[n_batches + 2] = n_moves
    return moves, offsets, linked, n_batches + 1


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, bool_[:, ::1], int64, int64, int64, int64, boolean)")
def move_alone(
    plan: GrowingPlan, atoms: Bools, row: int, col: int, to_row: int, to_col: int, is_linked: bool
) -> GrowingPlan:
    """Move one atom in its own batch, and update ``atoms``, bool (n_rows, n_cols)."""
    atoms[row, col] = False
    atoms[to_row, to_col] = True
    return end_batch(add_move(plan, row, col, to_row, to_col), is_linked)


@helper_kernel(f"{FINISHED_PLAN}({GROWING_PLAN})")
def finished(plan: GrowingPlan) -> FinishedPlan:
    """Cut a plan to its batches."""
    moves, offsets, linked, n_batches = plan
    return moves[: offsets[n_batches]].copy(), offsets[: n_batches + 1].copy(), linked[:n_batches].copy()


def as_plan(arrays: tuple[NDArray[Any], ...]) -> Plan:
    """Make a plan from the arrays of a kernel. Nothing else may hold these arrays."""
    for array in arrays:
        array.flags.writeable = False  # otherwise Plan would copy them
    return Plan(*arrays)


@helper_kernel(f"int64[::1]({const('bool_', 1)})")
def sites_of(atoms: Bools) -> Ints:
    """List the sites of a line's atoms in ascending order."""
    sites = np.empty(len(atoms), np.int64)
    n = 0
    for site in range(len(atoms)):
        sites[n] = site
        n += atoms[site]
    return sites[:n]


@helper_kernel(f"int64({SITES}, {SITES}, int64, int64, int64, int64[::1], int64)")
def choose_next(
    source: Ints, goal: Ints, n_sites: int, limit: int, slots: int, turns: Ints, turn: int
) -> int:
    """Choose the atoms of a line that move next, and return their number. See :func:`take_turns`."""
    n_atoms = len(source)
    n = n_low = n_high = 0
    for i in range(n_atoms):
        if goal[i] >= 0 or n == limit or n_low == slots:
            break
        if turns[i] == 0:
            turns[i] = turn
            n += 1
            n_low += 1
    for i in range(n_atoms - 1, -1, -1):
        if goal[i] < n_sites or n == limit or n_high == slots:
            break
        if turns[i] == 0:
            turns[i] = turn
            n += 1
            n_high += 1
    for i in range(n_atoms - 1, -1, -1):
        if n < limit and turns[i] == 0 and source[i] < goal[i] < n_sites:
            way_is_free = i + 1 == n_atoms or goal[i] < source[i + 1] or turns[i + 1] > 0
            turns[i] = turn if way_is_free else 0
            n += way_is_free
    for i in range(n_atoms):
        if n < limit and turns[i] == 0 and 0 <= goal[i] < source[i]:
            way_is_free = i == 0 or goal[i] > source[i - 1] or turns[i - 1] > 0
            turns[i] = turn if way_is_free else 0
            n += way_is_free
    return n


@helper_kernel(f"int64[::1]({SITES}, {SITES}, int64, int64, int64)")
def take_turns(source: Ints, goal: Ints, n_sites: int, limit: int, slots: int) -> Ints:
    """Distribute the atoms that move in a line over batches.

    An atom can move if its neighbour ahead clears the way before, or in the same batch. Atoms that move up
    are taken from the upper end, atoms that move down from the lower end. Ejections come first, because only
    one per slot fits into a batch. Atoms that stay block no others, because the order is kept.

    Args:
        source: int64 (n_atoms,), sites of the atoms before, ascending.
        goal: int64 (n_atoms,), sites of the atoms after, ascending.
        n_sites: Number of sites of the line.
        limit: Maximum number of atoms in a batch.
        slots: Ejection slots on each side, at least 1 if an atom is ejected.

    Returns:
        int64 (n_atoms,), the batch in which each atom moves, from 1, or 0 if it stays.
    """
    turns = np.zeros(len(source), np.int64)
    n_left = 0
    for i in range(len(source)):
        n_left += source[i] != goal[i]
    turn = 0
    while n_left > 0:
        turn += 1
        n_left -= choose_next(source, goal, n_sites, limit, slots, turns, turn)
    return turns


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {LINE}, {SITES}, {SITES}, {SITES})")
def add_turns(plan: GrowingPlan, line: Line, source: Ints, goal: Ints, turns: Ints) -> GrowingPlan:
    """Add batches in which the atoms of a line move in their turns (see :func:`take_turns`).

    Atoms that leave the grid in the same batch go to the sites next to it.
    """
    moves, offsets, linked, n_batches = with_room(plan, len(source))
    is_row, index, n_sites = line
    n = offsets[n_batches]
    for turn in range(1, turns.max() + 1 if len(turns) > 0 else 1):
        before, behind = 0, n_sites
        for i in range(len(source)):
            before -= turns[i] == turn and goal[i] < 0
        for i in range(len(source)):
            if turns[i] != turn:
                continue
            site = goal[i]
            if site < 0:
                site = before
                before += 1
            elif site >= n_sites:
                site = behind
                behind += 1
            moves[n, 0], moves[n, 2] = (index, index) if is_row else (source[i], site)
            moves[n, 1], moves[n, 3] = (source[i], site) if is_row else (index, index)
            n += 1
        linked[n_batches] = False
        n_batches += 1
        offsets[n_batches] = offsets[n_batches + 1] = n
    return moves, offsets, linked, n_batches


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, {LINE}, {SITES}, {SITES}, int64, int64)")
def add_line(plan: GrowingPlan, line: Line, source: Ints, goal: Ints, limit: int, slots: int) -> GrowingPlan:
    """Add the fewest batches that rearrange a line within ``limit`` and ``slots`` (:func:`take_turns`)."""
    return add_turns(plan, line, source, goal, take_turns(source, goal, line[2], limit, slots))


@helper_kernel(f"int64[::1]({const('bool_', 2)})")
def column_sums(sites: Bools) -> Ints:
    """Count the marked sites of each column."""
    total = np.zeros(sites.shape[1], np.int64)
    for row in range(sites.shape[0]):
        for col in range(sites.shape[1]):
            total[col] += sites[row, col]
    return total


@helper_kernel(f"{GROWING_PLAN}({GROWING_PLAN}, bool_[:, ::1], {SITES})")
def unlock_row(plan: GrowingPlan, atoms: Bools, spare: Ints) -> GrowingPlan:
    """Move an atom the shortest way within its column so that a row can then fill a column's vacancy.

    This is needed if columns lack atoms, but no row has both a spare atom and a vacancy to fill. In rows with
    such a vacancy the columns with spare atoms are then empty too, and the nearest of their atoms has a free
    path there. If there is no such move the plan stays the same.

    Args:
        plan: The plan.
        atoms: bool (n_rows, n_cols), updated.
        spare: int64 (n_cols,), number of spare atoms of each column. Negative for missing atoms.
    """
    n_rows, n_cols = atoms.shape
    lacking = np.zeros(n_rows, np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            if spare[col] < 0 and not atoms[row, col]:
                lacking[row] = True
    column, start, end = -1, 0, n_rows
    for col in range(n_cols):
        atom = goal = -1
        for row in range(n_rows if spare[col] > 0 else 0):
            if atoms[row, col]:
                atom = row
            elif lacking[row]:
                goal = row
            if min(atom, goal) >= 0 and abs(atom - goal) < abs(start - end):
                column, start, end = col, atom, goal
    return plan if column < 0 else move_alone(plan, atoms, start, column, end, column, False)
