"""Kernels that repair an array of few defects, with as few atom moves as they can."""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq.plugin import kernel
from labseq_psca._kernels_build import GRID, Bools, Ints, Moves, Offsets, add_line, empty_plan, ended

# What a shift costs: moving an atom loses 1.8 % of one, and the about 1 ms of a batch 0.7 % of one out of
# 225 atoms of 33 s lifetime (physics of the paper's experiment).
ATOM_MOVE: Final = 3
BATCH: Final = 1


@kernel("int64(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def nearest_beside(atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int) -> int:
    """Find the nearest atom to spare on either side of a site, with nothing in its way.

    Args:
        atoms: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the site, which is empty.
        col: Its column.
        down: Step along the line to look in, in rows; 1, or 0 for a row.
        right: Likewise, in columns.

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


@kernel("UniTuple(int64, 4)(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64)")
def shift_to(
    atoms: Bools, fill: Bools, row: int, col: int, down: int, right: int
) -> tuple[int, int, int, int]:
    """Find the cheapest shift along one line, from one side, that fills a defect.

    The atoms between the defect and the nearest atom to spare, seen from it in the
    given direction, move up by one fill site each. Defects on the way are filled
    too if there are as many atoms to spare. An atom to spare may also come from
    beside the line, onto the first free site outside of the target.

    Args:
        atoms: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the defect.
        col: Its column.
        down: Step to the side that atoms come from, in rows.
        right: Likewise, in columns.

    Returns:
        The cost, defects that are filled, sites from the defect to the last atom
        that moves, and steps from there to the atom that comes from beside, see
        :func:`nearest_beside`. No defects if there is no atom to spare.
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


@kernel("UniTuple(int64, 6)(bool_[:, ::1], bool_[:, ::1])")
def cheapest_shift(atoms: Bools, fill: Bools) -> tuple[int, int, int, int, int, int]:
    """Find the shift that costs least for each defect that it fills; of equals the shortest.

    Returns:
        Row and column of the defect, the step to the side that atoms come from (rows,
        columns), the sites to the last atom that moves, and the steps to the atom
        that comes from beside; all 0 if there is none.
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


@kernel("int64(bool_[:, ::1], bool_[:, ::1], int64, int64, int64, int64, int64, int64[::1], int64[::1])")
def carry_out(
    atoms: Bools,
    fill: Bools,
    row: int,
    col: int,
    down: int,
    right: int,
    n_sites: int,
    source: Ints,
    goal: Ints,
) -> int:
    """Carry out a shift.

    Args:
        atoms: bool (n_rows, n_cols); updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row: Row of the defect.
        col: Its column.
        down: Step to the side that atoms come from, in rows.
        right: Likewise, in columns.
        n_sites: Sites from the defect to the last atom that moves.
        source: Result, where the atoms are, ascending.
        goal: Result, where they go, ascending.

    Returns:
        Number of atoms that move.
    """
    n_atoms = n_goals = 0
    for i in range(n_sites + 1):
        r, c = row + i * down, col + i * right
        site = r if down != 0 else c
        if atoms[r, c]:
            source[n_atoms] = site
            n_atoms += 1
            atoms[r, c] = False
        if fill[r, c]:
            goal[n_goals] = site
            n_goals += 1
    for i in range(n_atoms):
        if down != 0:
            atoms[goal[i], col] = True
        else:
            atoms[row, goal[i]] = True
    if down + right < 0:
        source[:n_atoms] = source[:n_atoms][::-1].copy()
        goal[:n_atoms] = goal[:n_atoms][::-1].copy()
    return n_atoms


@kernel(f"Tuple((int16[:, ::1], int32[::1], bool_[:, ::1]))({GRID}, {GRID}, int64, int64)")
def plan_repair(
    occupied: Bools, fill: Bools, row_limit: int, column_limit: int
) -> tuple[Moves, Offsets, Bools]:
    """Fill defects from the side that takes fewest atoms, one shift after another.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.

    Returns:
        moves, int16 (n_moves, 4), batch offsets, int32 (n_batches + 1,), and the
        occupancy after them. Defects that no shift fills are left.
    """
    atoms = occupied.copy()
    sites = fill.copy()
    n_rows, n_cols = atoms.shape
    source = np.empty(max(n_rows, n_cols), np.int64)
    goal = np.empty(max(n_rows, n_cols), np.int64)
    moves, offsets = empty_plan(atoms.size)
    n = 0
    row, col, down, right, n_sites, steps = cheapest_shift(atoms, sites)
    while n_sites > 0:
        along_row = right != 0
        if steps != 0:
            r, c = row + n_sites * down, col + n_sites * right
            end, line = (r, c) if along_row else (c, r)
            source[0], goal[0] = end + steps, end
            atoms[r, c] = True
            if along_row:
                atoms[r + steps, c] = False
                moves, offsets, n = add_line(
                    moves, offsets, n, source, goal, 1, n_rows, line, False, column_limit, 0
                )
            else:
                atoms[r, c + steps] = False
                moves, offsets, n = add_line(
                    moves, offsets, n, source, goal, 1, n_cols, line, True, row_limit, 0
                )
        n_atoms = carry_out(atoms, sites, row, col, down, right, n_sites, source, goal)
        length, line, limit = (n_cols, row, row_limit) if along_row else (n_rows, col, column_limit)
        moves, offsets, n = add_line(
            moves, offsets, n, source, goal, n_atoms, length, line, along_row, limit, 0
        )
        row, col, down, right, n_sites, steps = cheapest_shift(atoms, sites)
    moves, offsets = ended(moves, offsets, n, False)
    return moves, offsets, atoms
