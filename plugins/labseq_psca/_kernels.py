"""Kernels of the parallel sort-and-compression algorithm: from occupancy to moves.

Everything is written for one way round, row sorting and then column compression;
the other way round is the same on the transposed grid.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq_psca._kernels_lines import compress, fill_batch
from labseq_psca._kernels_rows import choose_row, choose_unlocking, exchange, weigh_columns

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]
Offsets = NDArray[np.int32]
Growing = tuple[Moves, Offsets, int]
"""A plan that grows: its moves, where each batch starts, and how many batches there are."""

GRID: Final = const("bool_", 2)
GROWING: Final = "int16[:, ::1], int32[::1], int64"
PLAN: Final = "Tuple((int16[:, ::1], int32[::1]))"


@kernel(f"{PLAN}(int16[:, ::1], int32[::1], int64, int64)")
def resized(moves: Moves, offsets: Offsets, n_batches: int, n_moves: int) -> tuple[Moves, Offsets]:
    """Copy a plan of ``n_batches`` into arrays for ``n_moves`` atom moves, and no more batches."""
    new_moves = np.empty((n_moves, 4), np.int16)
    new_offsets = np.empty(n_moves + 1, np.int32)
    for i in range(offsets[n_batches]):
        for k in range(4):
            new_moves[i, k] = moves[i, k]
    for i in range(n_batches + 1):
        new_offsets[i] = offsets[i]
    return new_moves, new_offsets


@kernel(f"Tuple(({GROWING}))({GROWING}, int64[::1], int64[::1], int64, int64, int64, boolean, int64, int64)")
def add_line(
    moves: Moves,
    offsets: Offsets,
    n_batches: int,
    source: Ints,
    goal: Ints,
    n_atoms: int,
    n_sites: int,
    line: int,
    is_row: bool,
    limit: int,
    slots: int,
) -> Growing:
    """Add the batches that rearrange one line to a growing plan.

    Args:
        moves: Of the growing plan, as ``offsets`` and ``n_batches``.
        offsets: int32, where each batch starts.
        n_batches: Number of batches so far.
        source: int64 (>= n_atoms,), where the atoms are, ascending; overwritten.
        goal: int64 (>= n_atoms,), where they go, ascending; overwritten.
        n_atoms: Number of atoms in the line.
        n_sites: Number of sites in the line.
        line: Index of the row or column.
        is_row: Whether the line is a row.
        limit: Most atoms in a batch.
        slots: Ejection slots on each side.
    """
    if offsets[n_batches] + n_atoms > len(moves):
        moves, offsets = resized(moves, offsets, n_batches, 2 * len(moves) + n_atoms)
    n_left = 0
    for i in range(n_atoms):  # atoms that stay are in nobody's way, because the order is kept
        if source[i] != goal[i]:
            source[n_left] = source[i]
            goal[n_left] = goal[i]
            n_left += 1
    n_atoms = n_left
    turn = np.zeros(n_atoms, np.int64)
    batch = 0
    while n_left > 0:
        batch += 1
        n_left -= fill_batch(source, goal, n_atoms, n_sites, limit, slots, turn, batch)
        n = offsets[n_batches]
        before, behind = 0, n_sites
        for i in range(n_atoms):
            if turn[i] == batch and goal[i] < 0:
                before -= 1
        for i in range(n_atoms):
            if turn[i] != batch:
                continue
            site = goal[i]
            if site < 0:
                site = before
                before += 1
            elif site >= n_sites:
                site = behind
                behind += 1
            moves[n, 0], moves[n, 2] = (line, line) if is_row else (source[i], site)
            moves[n, 1], moves[n, 3] = (source[i], site) if is_row else (line, line)
            n += 1
        n_batches += 1
        offsets[n_batches] = n
    return moves, offsets, n_batches


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


@kernel(f"{PLAN}(int64)")
def empty_plan(n_sites: int) -> tuple[Moves, Offsets]:
    """Make the arrays of a plan that is about to grow."""
    offsets = np.empty(2 * n_sites + 1, np.int32)
    offsets[0] = 0
    return np.empty((2 * n_sites, 4), np.int16), offsets


@kernel(f"boolean[:, ::1]({GRID})")
def transposed(sites: Bools) -> Bools:
    """Swap rows and columns, into a contiguous array."""
    n_rows, n_cols = sites.shape
    swapped = np.empty((n_cols, n_rows), np.bool_)
    for row in range(n_rows):
        for col in range(n_cols):
            swapped[col, row] = sites[row, col]
    return swapped


@kernel("int64(int16[:, ::1])")
def distance(moves: Moves) -> int:
    """Add up how far the atoms move, in sites."""
    total = 0
    for i in range(len(moves)):
        total += int(abs(moves[i, 2] - moves[i, 0])) + int(abs(moves[i, 3] - moves[i, 1]))
    return total


@kernel(f"{PLAN}({GROWING}, boolean)")
def ended(moves: Moves, offsets: Offsets, n_batches: int, swapped: bool) -> tuple[Moves, Offsets]:
    """Cut a grown plan to its length; with rows and columns swapped back if they were."""
    moves, offsets = resized(moves, offsets, n_batches, offsets[n_batches])
    if swapped:
        for i in range(len(moves)):
            for site in (0, 2):
                row, col = moves[i, site + 1], moves[i, site]
                moves[i, site] = row
                moves[i, site + 1] = col
    return moves, offsets[: n_batches + 1]


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
