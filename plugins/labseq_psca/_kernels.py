"""Kernels of the parallel sort-and-compression algorithm: from occupancy to moves.

Everything is written for one way round, row sorting and then column compression;
the other way round is the same on the transposed grid.
"""

from __future__ import annotations

import numpy as np

from labseq.plugin import kernel
from labseq_psca._kernels_build import (
    GRID,
    GROWING,
    PLAN,
    Bools,
    Growing,
    Ints,
    Moves,
    Offsets,
    add_line,
    distance,
    empty_plan,
    ended,
    transposed,
)
from labseq_psca._kernels_lines import compress
from labseq_psca._kernels_rows import choose_row, choose_unlocking, exchange, weigh_columns


@kernel(f"UniTuple(int64[::1], 3)({GRID}, {GRID}, {GRID})")
def count_columns(atoms: Bools, fill: Bools, clear: Bools) -> tuple[Ints, Ints, Ints]:
    """Count the fill sites of each column, its sites that may hold an atom, and its atoms."""
    n_rows, n_cols = atoms.shape
    need = np.zeros(n_cols, np.int64)
    room = np.zeros(n_cols, np.int64)
    count = np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            need[col] += fill[row, col]
            room[col] += not clear[row, col]
            count[col] += atoms[row, col]
    return need, room, count


@kernel(f"Tuple(({GROWING}))({GROWING}, bool_[:, ::1], {GRID}, {GRID}, int64, int64, int64)")
def sort_rows(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    row_limit: int,
    column_limit: int,
    order: int,
) -> Growing:
    """Sort rows until every column holds at least as many atoms as it has fill sites.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), no fewer than there are fill sites; updated.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.
    """
    n_rows, n_cols = atoms.shape
    need, room, count = count_columns(atoms, fill, clear)
    weight = np.empty(n_cols, np.int64)
    leave = np.empty(n_cols, np.int64)
    change = np.empty(n_cols, np.int64)
    worth = np.empty(n_cols + 1, np.int64)
    step = np.empty((n_cols, n_cols + 1), np.int8)
    source = np.empty(max(n_rows, n_cols), np.int64)
    goal = np.empty(max(n_rows, n_cols), np.int64)
    while weigh_columns(need, room, count, weight, leave) > 0:
        row = choose_row(atoms, fill, weight, leave, row_limit, order, worth, step, change)
        if row >= 0:
            n_atoms = exchange(atoms[row], change, source, goal)
            for col in range(n_cols):
                count[col] += change[col]
            moves, offsets, n_batches = add_line(
                moves, offsets, n_batches, source, goal, n_atoms, n_cols, row, True, row_limit, 0
            )
            continue
        col, source[0], goal[0] = choose_unlocking(atoms, weight, leave)
        if col < 0:
            break
        atoms[source[0], col] = False
        atoms[goal[0], col] = True
        moves, offsets, n_batches = add_line(
            moves, offsets, n_batches, source, goal, 1, n_rows, col, False, column_limit, 0
        )
    return moves, offsets, n_batches


@kernel(f"Tuple(({GROWING}))({GROWING}, {GRID}, {GRID}, {GRID}, int64, int64)")
def compress_columns(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    atoms: Bools,
    fill: Bools,
    clear: Bools,
    limit: int,
    slots: int,
) -> Growing:
    """Bring the atoms of every column onto its fill sites, and off the sites that must be empty.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        atoms: bool (n_rows, n_cols), in no column fewer than it has fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
    """
    n_rows, n_cols = atoms.shape
    cost = np.empty((n_rows, 2 * n_rows + 1), np.int64)
    step = np.empty((n_rows, 2 * n_rows + 1), np.int16)
    source = np.empty(n_rows, np.int64)
    goal = np.empty(n_rows, np.int64)
    column_fill = np.empty(n_rows, np.bool_)
    column_clear = np.empty(n_rows, np.bool_)
    for col in range(n_cols):
        n_atoms = 0
        n_wrong = 0
        for row in range(n_rows):
            column_fill[row] = fill[row, col]
            column_clear[row] = clear[row, col]
            if atoms[row, col]:
                source[n_atoms] = row
                n_atoms += 1
                n_wrong += clear[row, col]
            else:
                n_wrong += fill[row, col]
        if n_wrong > 0 and compress(
            source, n_atoms, column_fill, column_clear, limit, slots, cost, step, goal
        ):
            moves, offsets, n_batches = add_line(
                moves, offsets, n_batches, source, goal, n_atoms, n_rows, col, False, limit, slots
            )
    return moves, offsets, n_batches


@kernel(f"int64({GRID}, {GRID}, {GRID}, int64)")
def least_batches(atoms: Bools, fill: Bools, clear: Bools, limit: int) -> int:
    """Count the batches that the compression of all columns takes at least.

    Args:
        atoms: bool (n_rows, n_cols), after row sorting.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        limit: Most atoms in a batch.
    """
    n_rows, n_cols = atoms.shape
    vacant = np.zeros(n_cols, np.int64)
    surplus = np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            vacant[col] += fill[row, col] and not atoms[row, col]
            surplus[col] += clear[row, col] and atoms[row, col]
    n = 0
    for col in range(n_cols):
        n += (max(vacant[col], surplus[col]) + limit - 1) // limit
    return n


@kernel(f"{PLAN}({GRID}, {GRID}, {GRID}, int64, int64, int64, int64)")
def plan_best_way(
    occupied: Bools, fill: Bools, clear: Bools, row_limit: int, column_limit: int, slots: int, order: int
) -> tuple[Moves, Offsets]:
    """Plan both ways round and keep the plan of fewer batches, then atom moves, then distance.

    The way that promises fewer batches after sorting is ended first; the other
    one only if it can still be as good.

    Args:
        occupied: bool (n_rows, n_cols), no fewer atoms than fill sites.
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty.
        row_limit: Most atoms in a batch that moves along a row.
        column_limit: Most atoms in a batch that moves along a column.
        slots: Ejection slots on each side.
        order: Which of equal rows goes first: HALF_FILLED, FULLEST or EMPTIEST.

    Returns:
        moves, int16 (n_moves, 4), and batch offsets, int32 (n_batches + 1,).
    """
    atoms, other_atoms = occupied.copy(), transposed(occupied)
    other_fill, other_clear = transposed(fill), transposed(clear)
    moves, offsets = empty_plan(atoms.size)
    moves, offsets, n = sort_rows(moves, offsets, 0, atoms, fill, clear, row_limit, column_limit, order)
    other_moves, other_offsets = empty_plan(atoms.size)
    other_moves, other_offsets, other_n = sort_rows(
        other_moves, other_offsets, 0, other_atoms, other_fill, other_clear, column_limit, row_limit, order
    )
    least = n + least_batches(atoms, fill, clear, column_limit)
    other_least = other_n + least_batches(other_atoms, other_fill, other_clear, row_limit)
    if least <= other_least:
        moves, offsets, n = compress_columns(moves, offsets, n, atoms, fill, clear, column_limit, slots)
        if n < other_least:
            return ended(moves, offsets, n, False)
    other_moves, other_offsets, other_n = compress_columns(
        other_moves, other_offsets, other_n, other_atoms, other_fill, other_clear, row_limit, slots
    )
    if least > other_least:
        if other_n < least:
            return ended(other_moves, other_offsets, other_n, True)
        moves, offsets, n = compress_columns(moves, offsets, n, atoms, fill, clear, column_limit, slots)
    n_moves, other_n_moves = offsets[n], other_offsets[other_n]
    if (n, n_moves, distance(moves[:n_moves])) <= (
        other_n,
        other_n_moves,
        distance(other_moves[:other_n_moves]),
    ):
        return ended(moves, offsets, n, False)
    return ended(other_moves, other_offsets, other_n, True)
