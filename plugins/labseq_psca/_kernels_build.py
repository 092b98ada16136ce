"""Kernels that a plan grows by: batch after batch, line after line."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel
from labseq_psca._kernels_lines import fill_batch

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
