"""Kernels of Tetris, which piles up rows from the top, then columns, with names as in ``kernels_lines``."""

from __future__ import annotations

import numpy as np

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.plan_kernels import (
    FINISHED_PLAN,
    FinishedPlan,
    GrowingPlan,
    add_line,
    add_turns,
    column_sums,
    empty_plan,
    finished,
)
from labseq_rivals.kernels_lines import GRID, Bools, Ints, settle, supply_columns


@helper_kernel()
def fill_rows(fill: Bools) -> Ints:
    """List the rows of each column's fill sites, int64 (n_cols, n_rows + 1), then ``n_rows``."""
    n_rows, n_cols = fill.shape
    rows = np.full((n_cols, n_rows + 1), n_rows, np.int64)
    for col in range(n_cols):
        n = 0
        for row in range(n_rows):
            if fill[row, col]:
                rows[col, n] = row
                n += 1
    return rows


@helper_kernel()
def choose_columns(atoms: Bools, rows: Ints, piled: Ints, chosen: Bools) -> None:
    """Choose the columns with the uppermost open target rows for the atoms of a row.

    Among equal columns, columns that already hold an atom of this row come first, then the left columns.

    Args:
        atoms: bool (n_cols,), the row.
        rows: int64 (n_cols, n_rows + 1), see :func:`fill_rows`.
        piled: int64 (n_cols,), number of each column's target rows that have their atom. Updated.
        chosen: Result, bool (n_cols,).
    """
    n_rows = rows.shape[1] - 1
    for col in range(len(atoms)):
        chosen[col] = False
    for _ in range(np.count_nonzero(atoms)):
        best, best_rank = -1, 2 * n_rows
        for col in range(len(atoms)):
            rank = 2 * rows[col, piled[col]] + (0 if atoms[col] else 1)
            if not chosen[col] and rank < best_rank:
                best, best_rank = col, rank
        if best < 0:
            return
        chosen[best] = True
    for col in range(len(atoms)):
        piled[col] += chosen[col]


@helper_kernel()
def pile_up(plan: GrowingPlan, atoms: Bools, fill: Bools, limit: int) -> GrowingPlan:
    """Arrange row after row, from the top, until each target site has its atom in its column."""
    n_rows, n_cols = atoms.shape
    rows = fill_rows(fill)
    piled = np.zeros(n_cols, np.int64)
    chosen = np.empty(n_cols, np.bool_)
    anywhere = np.zeros(n_cols, np.bool_)
    for row in range(n_rows):
        choose_columns(atoms[row], rows, piled, chosen)
        source, goal = settle(atoms[row], chosen, anywhere, False, False)
        for site in source:
            atoms[row, site] = False
        for site in goal:
            atoms[row, site] = True
        plan = add_line(plan, (True, row, n_cols), source, goal, limit, 0)
    return plan


@helper_kernel()
def take_turns_outwards(source: Ints, goal: Ints, n_sites: int, limit: int, slots: int) -> Ints:
    """Distribute the atoms that move in a line over batches, with the arguments and result of ``take_turns``.

    Atoms that move up, to higher sites, go one after the other from the upper end, then atoms that move down
    from the lower end. Each finds its way free, at the latest in the same batch. An ejection waits for a free
    slot, and all atoms behind it also wait.
    """
    n_atoms = len(source)
    turns = np.zeros(n_atoms, np.int64)
    up, down, turn = n_atoms - 1, 0, 0
    while up >= 0 or down < n_atoms:
        turn += 1
        n = n_ejected = 0
        while up >= 0 and n < limit and not (goal[up] >= n_sites and n_ejected == slots):
            n_ejected += goal[up] >= n_sites
            if goal[up] > source[up]:
                turns[up] = turn
                n += 1
            up -= 1
        n_ejected = 0
        while down < n_atoms and n < limit and not (goal[down] < 0 and n_ejected == slots):
            n_ejected += goal[down] < 0
            if goal[down] < source[down]:
                turns[down] = turn
                n += 1
            down += 1
    return turns


@kernel(f"{FINISHED_PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64)")
def plan_tetris(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int
) -> FinishedPlan:
    """Plan the Tetris algorithm.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Maximum number of atoms in a batch that moves along a row.
        column_limit: Maximum number of atoms in a batch that moves along a column.
        slots: Ejection slots on each side.
    """
    n_rows, n_cols = occupied.shape
    atoms = occupied.copy()
    plan = pile_up(empty_plan(2 * atoms.size), atoms, fill, row_limit)
    plan = supply_columns(plan, atoms, column_sums(atoms) - column_sums(fill), row_limit)
    for col in range(n_cols):
        line = atoms[:, col].copy(), fill[:, col].copy(), clear[:, col].copy()
        source, goal = settle(line[0], line[1], line[2], slots > 0, slots > 0)
        turns = take_turns_outwards(source, goal, n_rows, column_limit, slots)
        plan = add_turns(plan, (False, col, n_rows), source, goal, turns)
    return finished(plan)
