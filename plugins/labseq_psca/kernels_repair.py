"""Kernels of the repair of few defects, which fill each in the way that costs the fewest atoms.

Costs are expected losses of atoms, and ``costs`` holds the cost of an atom that is moved, of the time of a
batch, and of one site of way. A defect is filled by a *chain*, a path over sites from the defect to a surplus
atom, with any turns. Each atom on it moves along it to the place of the atom before, and the first to the
defect. A chain of one atom is a direct move, straight or as an L. Several defects of one line may be filled
by one *shift* along it.

In all kernels ``atoms`` marks the sites that hold an atom, ``fill`` the sites that must hold an atom and
``clear`` the sites that must be empty, bool (n_rows, n_cols). ``limit`` is the maximum number of atoms in a
batch.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    FinishedPlan,
    GrowingPlan,
    add_line,
    empty_plan,
    finished,
    move_alone,
)

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
GRID: Final = const("bool_", 2)
Costs = tuple[float, float, float]
Shift = tuple[int, int, int, int, int]
"""Row and column of a defect, the step towards its atoms, and the number of sites to the last of them."""


@helper_kernel()
def shift_to(
    atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int, costs: Costs
) -> tuple[float, int, int]:
    """Find the cheapest shift that fills the defect at ``row`` and ``col`` from one side.

    The atoms between the defect and the nearest surplus atom, seen from the defect in the direction ``down``
    and ``right``, move up by one fill site each. Defects on the way are also filled if there are as many
    surplus atoms.

    Returns:
        The cost, the number of filled defects, and the number of sites from the defect to the last atom that
        moves. Without a surplus atom the number of defects is 0.
    """
    n_rows, n_cols = atoms.shape
    n_sites = n_atoms = n_spare = n_defects = 0
    best_cost, best_defects, best_sites = 0.0, 0, 0
    while 0 <= row < n_rows and 0 <= col < n_cols:
        if atoms[row, col]:
            n_atoms += 1
            n_spare += not fill[row, col]
            if not fill[row, col] and n_spare in (1, n_defects):
                cost = costs[0] * n_atoms + costs[1] + costs[2] * n_sites
                if best_defects == 0 or cost * best_defects < best_cost * n_spare:
                    best_cost, best_defects, best_sites = cost, n_spare, n_sites
        elif fill[row, col]:
            n_defects += 1
        if n_spare > 0 and n_spare == n_defects:
            break
        n_sites += 1
        row += down
        col += right
    return best_cost, best_defects, best_sites


@helper_kernel()
def cheapest_shift(atoms: Bools, fill: Bools, row: int, col: int, costs: Costs) -> tuple[float, int, Shift]:
    """Find the shift that costs least for each defect that it fills, with 0 defects if there is none."""
    best = (row, col, 0, 0, 0)
    best_cost, best_defects = 0.0, 0
    for side in range(4):
        down = (side == 0) - (side == 1)
        right = (side == 2) - (side == 3)
        cost, n_defects, n_sites = shift_to(atoms, fill, row, col, down, right, costs)
        if n_defects > 0 and (best_defects == 0 or cost * best_defects < best_cost * n_defects):
            best = (row, col, down, right, n_sites)
            best_cost, best_defects = cost, n_defects
    return best_cost, best_defects, best


@helper_kernel()
def dearest_defect(atoms: Bools, fill: Bools, left: Bools, costs: Costs) -> tuple[int, int]:
    """Find the defect in ``left`` whose shift costs most, or that has no shift, as row and column or -1.

    Sites that hold an atom are removed from ``left``.
    """
    row = col = -1
    highest = -1.0
    for r in range(atoms.shape[0]):
        for c in range(atoms.shape[1]):
            left[r, c] &= not atoms[r, c]
            if left[r, c]:
                cost, n_defects, _ = cheapest_shift(atoms, fill, r, c, costs)
                cost = np.inf if n_defects == 0 else cost
                if cost > highest:
                    row, col, highest = r, c, cost
    return row, col


@helper_kernel()
def cheapest_chain(
    atoms: Bools, fill: Bools, clear: Bools, row: int, col: int, costs: Costs
) -> tuple[float, Ints]:
    """Find the cheapest chain to the defect at ``row`` and ``col``, by Dijkstra's algorithm.

    It starts at the defect. A state is a site and the side from which it was reached. An atom that must leave
    its site anyway costs nothing. A turn costs a batch if there is an atom on the chain before it, because
    only a single atom turns with its tweezer on.

    Returns:
        The cost, and the chain's sites, int64 (n, 2), none if no surplus atom can be reached.
    """
    n_rows, n_cols = atoms.shape
    n_states = 4 * n_rows * n_cols
    cost = np.full(n_states, np.inf)
    parent = np.full(n_states, -1, np.int64)
    has_atom = np.zeros(n_states, np.bool_)
    heap = [(0.0, np.int64(-1))]
    end, total = np.int64(-1), 0.0
    while len(heap) > 0:
        so_far, state = heappop(heap)
        r, c, came_from = row, col, np.int64(-1)
        if state >= 0:
            if so_far > cost[state]:
                continue
            came_from = state % 4
            r, c = state // 4 // n_cols, state // 4 % n_cols
            if atoms[r, c] and not fill[r, c]:
                end, total = state, so_far
                break
        for side in range(4):
            down, right = (side == 0) - (side == 1), (side == 2) - (side == 3)
            to_row, to_col = r + down, c + right
            if not (0 <= to_row < n_rows and 0 <= to_col < n_cols):
                continue
            atom = atoms[to_row, to_col]
            new = so_far + costs[2]
            if atom and not clear[to_row, to_col]:
                new += costs[0]
            before = state >= 0 and has_atom[state]
            if state < 0 or (side != came_from and before):
                new += costs[1]
            to = (to_row * n_cols + to_col) * 4 + side
            if new < cost[to]:
                cost[to] = new
                parent[to] = state
                has_atom[to] = atom or before
                heappush(heap, (new, np.int64(to)))
    n_sites = 0
    state = end
    while state >= 0:
        n_sites += 1
        state = parent[state]
    sites = np.empty((n_sites + 1 if n_sites > 0 else 0, 2), np.int64)
    state = end
    for i in range(n_sites, 0, -1):
        sites[i, 0], sites[i, 1] = state // 4 // n_cols, state // 4 % n_cols
        state = parent[state]
    if n_sites > 0:
        sites[0, 0], sites[0, 1] = row, col
    return total, sites


@helper_kernel()
def add_run(
    plan: GrowingPlan, atoms: Bools, source: Ints, goal: Ints, row: int, col: int, is_row: bool, limit: int
) -> GrowingPlan:
    """Move atoms of one line from ``source`` to ``goal``, both ascending. Updates ``atoms``."""
    for i in range(len(source)):
        if is_row:
            atoms[row, source[i]] = False
        else:
            atoms[source[i], col] = False
    for i in range(len(goal)):
        if is_row:
            atoms[row, goal[i]] = True
        else:
            atoms[goal[i], col] = True
    line = (True, row, atoms.shape[1]) if is_row else (False, col, atoms.shape[0])
    return add_line(plan, line, source, goal, limit, 0)


@helper_kernel()
def add_shift(plan: GrowingPlan, atoms: Bools, fill: Bools, shift: Shift, limit: int) -> GrowingPlan:
    """Add the batches of a shift. Updates ``atoms``."""
    row, col, down, right, n_sites = shift
    source, goal = np.empty(n_sites + 1, np.int64), np.empty(n_sites + 1, np.int64)
    n_atoms = n_goals = 0
    forwards = down + right > 0
    for k in range(n_sites + 1):
        i = k if forwards else n_sites - k
        r, c = row + i * down, col + i * right
        site = r if down != 0 else c
        if atoms[r, c]:
            source[n_atoms] = site
            n_atoms += 1
            atoms[r, c] = False
        if fill[r, c]:
            goal[n_goals] = site
            n_goals += 1
    first = 0 if forwards else n_goals - n_atoms  # the fill sites nearest to the defect
    return add_run(plan, atoms, source[:n_atoms], goal[first : first + n_atoms], row, col, down == 0, limit)


@helper_kernel()
def add_bent(plan: GrowingPlan, atoms: Bools, sites: Ints, start: int, stop: int) -> GrowingPlan:
    """Move the atom on ``sites[start]`` along a chain to ``sites[stop]``, tweezer on at each turn."""
    corner = start
    for i in range(start - 1, stop - 1, -1):
        turns = i > stop and sites[i - 1, 0] != sites[i + 1, 0] and sites[i - 1, 1] != sites[i + 1, 1]
        if i == stop or turns:
            goes_on = corner != start
            plan = move_alone(
                plan, atoms, sites[corner, 0], sites[corner, 1], sites[i, 0], sites[i, 1], goes_on
            )
            corner = i
    return plan


@helper_kernel()
def is_straight(sites: Ints, start: int, stop: int) -> bool:
    """True if a part of a chain has no turn."""
    way = abs(sites[stop, 0] - sites[start, 0]) + abs(sites[stop, 1] - sites[start, 1])
    in_line = sites[stop, 0] == sites[start, 0] or sites[stop, 1] == sites[start, 1]
    return in_line and way == stop - start


@helper_kernel()
def add_chain(plan: GrowingPlan, atoms: Bools, sites: Ints, row_limit: int, column_limit: int) -> GrowingPlan:
    """Add the batches of a chain, with the atom next to the defect first. Updates ``atoms``."""
    n_sites = len(sites)
    at = np.empty(n_sites + 1, np.int64)  # where on the chain the defect and the atoms are
    at[0] = 0
    n_atoms = 1
    for i in range(1, n_sites):
        if atoms[sites[i, 0], sites[i, 1]]:
            at[n_atoms] = i
            n_atoms += 1
    first = 0
    while first < n_atoms - 1:
        row, col = sites[at[first], 0], sites[at[first], 1]
        last = first + 1
        while last < n_atoms and sites[at[last], 0] == row and is_straight(sites, at[first], at[last]):
            last += 1
        is_row = last > first + 1
        while (
            not is_row
            and last < n_atoms
            and sites[at[last], 1] == col
            and is_straight(sites, at[first], at[last])
        ):
            last += 1
        if last == first + 1:
            plan = add_bent(plan, atoms, sites, at[last], at[first])
            first = last
            continue
        n = last - first - 1
        source, goal = np.empty(n, np.int64), np.empty(n, np.int64)
        axis = 1 if is_row else 0
        ascends = sites[at[last - 1], axis] > sites[at[first], axis]
        for k in range(n):
            i = first + k if ascends else last - 2 - k
            source[k], goal[k] = sites[at[i + 1], axis], sites[at[i], axis]
        limit = row_limit if is_row else column_limit
        plan = add_run(plan, atoms, source, goal, row, col, is_row, limit)
        first = last - 1
    return plan


@kernel(
    f"Tuple(({FINISHED_PLAN}, bool_[:, ::1]))({GRID}, {GRID}, {GRID}, int64, int64, UniTuple(float64, 3))"
)
def plan_repair(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, costs: Costs
) -> tuple[FinishedPlan, Bools]:
    """Fill defects by chains and shifts, the most expensive first.

    Then a chain may pass through the defects that are nearer to its surplus atom, without the atoms that
    would fill them.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Maximum number of atoms in a batch that moves along a row.
        column_limit: Maximum number of atoms in a batch that moves along a column.
        costs: See the module.

    Returns:
        The plan, and the occupancy after it. Defects that no chain reaches remain.
    """
    atoms = occupied.copy()
    plan = empty_plan(atoms.size)
    left = fill.copy()
    while plan[3] <= 3 * atoms.size:
        row, col = dearest_defect(atoms, fill, left, costs)
        if row < 0:
            break
        cost, n_defects, shift = cheapest_shift(atoms, fill, row, col, costs)
        chain_cost, sites = cheapest_chain(atoms, fill, clear, row, col, costs)
        if n_defects > 1 and cost < chain_cost * n_defects:
            plan = add_shift(plan, atoms, fill, shift, column_limit if shift[2] != 0 else row_limit)
        elif len(sites) > 0:
            plan = add_chain(plan, atoms, sites, row_limit, column_limit)
        left[row, col] = False
    return finished(plan), atoms
