"""Kernels of the repair of few defects: shifts that fill a defect with few atom moves.

A shift is the row and the column of a defect, the step to the side that its atoms come
from (rows, columns), the sites from the defect to the last atom that moves, and the steps
from there to the atom that comes from beside the line, see :func:`nearest_beside`. The
vocabulary is that of :mod:`labseq_psca.kernels_lines`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq_psca.kernels_lines import (
    GRID,
    GROWING,
    Bools,
    Growing,
    Moves,
    Offsets,
    add_line,
    add_move,
    empty_plan,
    finished,
)

Shift = tuple[int, int, int, int, int, int]
SHIFT: Final = "UniTuple(int64, 6)"

# What a shift costs: moving an atom loses 1.8 % of one, and the about 1 ms of a batch 0.7 % of one out of
# 225 atoms of 33 s lifetime (physics of the paper's experiment).
ATOM_MOVE: Final = 3
BATCH: Final = 1


@helper_kernel("int64(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def nearest_beside(atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int) -> int:
    """Find the nearest surplus atom on either side of an empty site, with nothing in its way.

    ``down`` and ``right`` are the step along the line to look in: (1, 0) or (0, 1).

    Returns:
        Steps to the atom, below 0 on the upper or left side; 0 if there is none.
    """
    n_rows, n_cols = atoms.shape
    for n in range(1, max(n_rows, n_cols)):
        for steps in (-n, n):
            r, c = row + steps * down, col + steps * right
            if 0 <= r < n_rows and 0 <= c < n_cols and atoms[r, c] and not fill[r, c]:
                for i in range(1, n):
                    way = i if steps > 0 else -i
                    if atoms[row + way * down, col + way * right]:
                        break
                else:
                    return steps
    return 0


@helper_kernel("UniTuple(int64, 4)(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def shift_to(
    atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int
) -> tuple[int, int, int, int]:
    """Find the cheapest shift that fills the defect at ``row`` and ``col`` from one side.

    The atoms between the defect and the nearest surplus atom, seen from the defect in the
    direction ``down`` and ``right``, move up by one fill site each. Defects on the way are
    filled too if there are as many surplus atoms. A surplus atom may also come from
    beside the line, onto the first free site outside of the target.

    Returns:
        The cost, the number of defects that it fills, sites from the defect to the last
        atom that moves, and steps from there to the atom that comes from beside. No
        defects if there is no surplus atom.
    """
    n_rows, n_cols = atoms.shape
    n_sites = n_atoms = n_spare = n_defects = 0
    best = (0, 0, 0, 0)
    while 0 <= row < n_rows and 0 <= col < n_cols:
        found = (0, 0, 0, 0)
        if atoms[row, col]:
            n_atoms += 1
            n_spare += not fill[row, col]
            if not fill[row, col] and n_spare in (1, n_defects):
                found = (ATOM_MOVE * n_atoms + BATCH, n_spare, n_sites, 0)
        elif fill[row, col]:
            n_defects += 1
        elif n_spare == 0 and best[3] == 0:
            steps = nearest_beside(atoms, fill, row, col, abs(right), abs(down))
            if steps != 0:
                found = (ATOM_MOVE * (n_atoms + 2) + 2 * BATCH, 1, n_sites, steps)
        if found[1] * best[0] > best[1] * found[0] or best[1] == 0:
            best = found
        if n_spare > 0 and n_spare == n_defects:
            break
        n_sites += 1
        row += down
        col += right
    return best


@helper_kernel(f"{SHIFT}(bool_[:, ::1], bool_[:, ::1])")
def cheapest_shift(atoms: Bools, fill: Bools) -> Shift:
    """Find the shift that costs least for each defect that it fills, of equal ones the shortest.

    All six numbers are 0 if there is none.
    """
    n_rows, n_cols = atoms.shape
    best = (0, 0, 0, 0, 0, 0)
    best_cost, best_defects = 1, 0
    for row in range(n_rows):
        for col in range(n_cols):
            if not fill[row, col] or atoms[row, col]:
                continue
            for side in range(4):
                down = (side == 0) - (side == 1)
                right = (side == 2) - (side == 3)
                cost, n_defects, n_sites, steps = shift_to(atoms, fill, row, col, down, right)
                ahead = n_defects * best_cost - best_defects * cost
                if ahead > 0 or (ahead == 0 and n_defects > 0 and n_sites < best[4]):
                    best = (row, col, down, right, n_sites, steps)
                    best_cost, best_defects = cost, n_defects
    return best


@helper_kernel(f"{GROWING}({GROWING}, bool_[:, ::1], bool_[:, ::1], {SHIFT}, int64)")
def add_shift(plan: Growing, atoms: Bools, fill: Bools, shift: Shift, limit: int) -> Growing:
    """Add the batches of a shift, without the atom from beside; updates ``atoms``."""
    row, col, down, right, n_sites, _ = shift
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
    source, goal = source[:n_atoms], goal[first : first + n_atoms]
    for site in goal:
        if down != 0:
            atoms[site, col] = True
        else:
            atoms[row, site] = True
    if down != 0:
        return add_line(plan, source, goal, atoms.shape[0], col, False, limit, 0)
    return add_line(plan, source, goal, atoms.shape[1], row, True, limit, 0)


@kernel(f"Tuple((int16[:, ::1], int32[::1], bool_[:, ::1]))({GRID}, {GRID}, int64, int64)")
def plan_repair(
    occupied: Bools, fill: Bools, row_limit: int, column_limit: int
) -> tuple[Moves, Offsets, Bools]:
    """Fill defects from the side that takes fewest atoms, one shift after another.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row_limit: Maximum number of atoms in a batch that moves along a row.
        column_limit: Maximum number of atoms in a batch that moves along a column.

    Returns:
        moves, int16 (n_moves, 4), batch offsets, int32 (n_batches + 1,), and the
        occupancy after them. Defects that no shift fills are left.
    """
    atoms, sites = occupied.copy(), fill.copy()
    plan = empty_plan(atoms.size)
    shift = cheapest_shift(atoms, sites)
    while shift[4] > 0:
        row, col, down, right, n_sites, steps = shift
        if steps != 0:
            r, c = row + n_sites * down, col + n_sites * right
            plan = add_move(plan, atoms, r + steps * abs(right), c + steps * abs(down), r, c)
        plan = add_shift(plan, atoms, sites, shift, column_limit if down != 0 else row_limit)
        shift = cheapest_shift(atoms, sites)
    moves, offsets = finished(plan, False)
    return moves, offsets, atoms
