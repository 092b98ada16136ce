"""Kernels of the plan checker: they play a plan batch by batch up to its first fault."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.plan_rules import (
    EMPTY_BATCH,
    LINKED_AFTER_EJECTION,
    LINKED_FIRST,
    RIGHT,
    check_paths,
    check_shapes,
    check_sites,
    check_tones,
)

Bools = NDArray[np.bool_]
Moves = NDArray[np.int16]
Stamps = NDArray[np.int32]

MOVES: Final = const("int16", 2)
ATOMS: Final = const("bool_", 2)
GRID: Final = "bool_[:, ::1]"


@kernel(f"boolean({MOVES}, int64, int64, {GRID})")
def move_atoms(moves: Moves, start: int, stop: int, atoms: Bools) -> bool:
    """Carry out a batch; return whether it ejects an atom."""
    n_rows, n_cols = atoms.shape
    ejects = False
    for i in range(start, stop):
        atoms[moves[i, 0], moves[i, 1]] = False
    for i in range(start, stop):
        row, col = moves[i, 2], moves[i, 3]
        if 0 <= row < n_rows and 0 <= col < n_cols:
            atoms[row, col] = True
        else:
            ejects = True
    return ejects


@kernel(f"int64({MOVES}, int64, int64)")
def longest_move(moves: Moves, start: int, stop: int) -> int:
    """Length of the longest straight move of a batch, in sites."""
    longest = 0
    for i in range(start, stop):
        down = abs(int(moves[i, 2]) - int(moves[i, 0]))
        right = abs(int(moves[i, 3]) - int(moves[i, 1]))
        longest = max(longest, down + right)
    return longest


@kernel(f"UniTuple(int64, 2)({ATOMS}, {ATOMS}, {ATOMS})")
def count_wrong(atoms: Bools, fill: Bools, clear: Bools) -> tuple[int, int]:
    """Count the fill sites that are empty and the atoms on sites that must be empty."""
    n_defects = n_surplus = 0
    for row in range(atoms.shape[0]):
        for col in range(atoms.shape[1]):
            n_defects += fill[row, col] and not atoms[row, col]
            n_surplus += clear[row, col] and atoms[row, col]
    return n_defects, n_surplus


@kernel(
    f"UniTuple(int64, 5)({MOVES}, {const('int32', 1)}, {const('bool_', 1)}, {GRID}, int64, int64, int64,"
    " int64, float64, float64, float64, float64, float64, float64[::1], int32[::1])"
)
def check(
    moves: Moves,
    offsets: Stamps,
    linked: Bools,
    atoms: Bools,
    max_tweezers: int,
    max_row_tones: int,
    max_column_tones: int,
    slots: int,
    pick_up_s: float,
    drop_off_s: float,
    site_s: float,
    batch_overhead_s: float,
    cycle_overhead_s: float,
    end_s: NDArray[np.float64],
    n_tweezers: Stamps,
) -> tuple[int, int, int, int, int]:
    """Play a plan.

    Args:
        moves: int16 (n_moves, 4).
        offsets: int32 (n_batches + 1,), from 0 to n_moves, not decreasing.
        linked: bool (n_batches,).
        atoms: bool (n_rows, n_cols), before the plan; holds the occupancy after it.
        max_tweezers: Most tweezers on at once.
        max_row_tones: Most row tones on at once.
        max_column_tones: Most column tones on at once.
        slots: Ejection slots on each side.
        pick_up_s: Pick-up ramp, in seconds.
        drop_off_s: Drop-off ramp, in seconds.
        site_s: Time to move by one site, in seconds.
        batch_overhead_s: Time before each batch that is not linked, in seconds.
        cycle_overhead_s: Time before the first batch, in seconds.
        end_s: Result, float64 (n_batches,), end of each batch.
        n_tweezers: Result, int32 (n_batches,), tweezers on in each batch.

    Returns:
        The first fault, its batch and atom move (-1: none in particular), and two
        numbers that belong to it.
    """
    n_batches = len(linked)
    lifted = np.zeros(atoms.shape, np.int32)
    goals = np.zeros(atoms.shape, np.int32)
    row_goal = np.empty(atoms.shape[0], np.int64)
    column_goal = np.empty(atoms.shape[1], np.int64)
    ejected = False
    time_s = cycle_overhead_s
    for batch in range(n_batches):
        start, stop = offsets[batch], offsets[batch + 1]
        follows = linked[batch]
        leads = batch + 1 < n_batches and linked[batch + 1]
        if start == stop:
            return EMPTY_BATCH, batch, -1, 0, 0
        if follows and batch == 0:
            return LINKED_FIRST, batch, -1, 0, 0
        if follows and ejected:
            return LINKED_AFTER_EJECTION, batch, -1, 0, 0
        stamp = batch + 1
        fault = check_shapes(moves, start, stop, atoms.shape[0], atoms.shape[1], slots, follows or leads)
        if fault[0] == RIGHT:
            start_before = offsets[max(batch - 1, 0)]
            fault = check_sites(moves, start, stop, start_before, atoms, lifted, goals, stamp, follows)
        if fault[0] == RIGHT:
            fault = check_tones(
                moves, start, stop, row_goal, column_goal, max_tweezers, max_row_tones, max_column_tones
            )
            n_tweezers[batch] = fault[3]
        if fault[0] == RIGHT:
            fault = check_paths(atoms, lifted, stamp, row_goal, column_goal)
        if fault[0] != RIGHT:
            return fault[0], batch, fault[1], fault[2], fault[3]
        ejected = move_atoms(moves, start, stop, atoms)
        time_s += 0.0 if follows else batch_overhead_s + pick_up_s
        time_s += longest_move(moves, start, stop) * site_s + (0.0 if leads else drop_off_s)
        end_s[batch] = time_s
    return RIGHT, -1, -1, 0, 0
