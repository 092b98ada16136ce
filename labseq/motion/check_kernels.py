"""Kernels of the plan check.

They take any int16 moves, because no index is used before it has been tested. A goal off the grid ejects the
atom. In all of them ``batch`` holds the moves of one batch, int16 (n, 4), ``atoms``, bool (n_rows, n_cols),
is the occupancy, and ``stamp`` is the number of the batch, from 1. ``lifted`` and ``goals``, int32 (n_rows,
n_cols), are the stamps of the last batches that lifted an atom from each site and brought an atom to it.
``row_goal`` and ``column_goal``, int64, are where the tone of each row and column goes, or NO_TONE.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel
from labseq.motion.path_kernels import (
    KNOTS,
    PATH_SHAPE,
    PATHS,
    POSITIONS,
    Floats,
    Paths,
    Shape,
    check_axis,
    check_ends,
    check_motion,
    fill_stands_from,
    leg_ways,
    paths_of,
    tracks_of,
)

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = NDArray[np.int16]
Stamps = NDArray[np.int32]
Fault = tuple[int, int, int, int]
"""Number of the fault, atom move in the batch (-1 if none in particular), two numbers for the message."""

RIGHT: Final = 0
EMPTY_BATCH: Final = 1
SOURCE_OUTSIDE: Final = 2
GOAL_OUTSIDE: Final = 3
DIAGONAL: Final = 4
NO_LENGTH: Final = 5
TWO_AXES: Final = 6
LINKED_FIRST: Final = 7
LINKED_AFTER_EJECTION: Final = 8
LINKED_NUMBER: Final = 9
LINKED_ELSEWHERE: Final = 10
NO_ATOM: Final = 11
SOURCE_TWICE: Final = 12
GOAL_TAKEN: Final = 13
GOAL_TWICE: Final = 14
ROW_TONE_SPLIT: Final = 15
COLUMN_TONE_SPLIT: Final = 16
ROW_TONES: Final = 17
COLUMN_TONES: Final = 18
ROW_ORDER: Final = 19
COLUMN_ORDER: Final = 20
TWEEZERS: Final = 21
INNER_EJECTION: Final = 22
CROSSING_ON_ATOM: Final = 23
PATH_OVER_ATOM: Final = 24
LINKED_AFTER_PATHS: Final = 35

NO_TONE: Final = 1 << 20  # no int16
FAULT: Final = "UniTuple(int64, 4)"
MOVES: Final = const("int16", 2)
ATOMS: Final = const("bool_", 2)
STAMPS: Final = "int32[:, ::1]"


@helper_kernel(f"{FAULT}({MOVES}, int64, int64, int64, boolean)")
def check_shapes(batch: Moves, n_rows: int, n_cols: int, slots: int, chained: bool) -> Fault:
    """Test that each move of a batch stays on the grid and all run along one axis.

    In a ``chained`` batch, which is linked to the batch before or after it, an atom may wait.
    """
    first_along_row = first_along_column = -1
    for i in range(len(batch)):
        row, col, to_row, to_col = batch[i, 0], batch[i, 1], batch[i, 2], batch[i, 3]
        if not (0 <= row < n_rows and 0 <= col < n_cols):
            return SOURCE_OUTSIDE, i, row, col
        if row != to_row and col != to_col:
            return DIAGONAL, i, to_row, to_col
        if not (-slots <= to_row < n_rows + slots and -slots <= to_col < n_cols + slots):
            return GOAL_OUTSIDE, i, to_row, to_col
        if col != to_col:
            first_along_row = i
        elif row != to_row:
            first_along_column = i
        elif not chained:
            return NO_LENGTH, i, row, col
        if first_along_row >= 0 and first_along_column >= 0:
            return TWO_AXES, i, first_along_row, first_along_column
    return RIGHT, -1, 0, 0


@helper_kernel(f"{FAULT}({MOVES}, int64, {ATOMS}, {STAMPS}, {STAMPS}, int64, boolean)")
def check_sites(
    batch: Moves, n_before: int, atoms: Bools, lifted: Stamps, goals: Stamps, stamp: int, linked: bool
) -> Fault:
    """Test that a batch's sources hold atoms and its goals are free once these are lifted.

    ``n_before`` is the number of moves of the batch before, which it may be linked to.
    """
    n_rows, n_cols = atoms.shape
    if linked and len(batch) != n_before:
        return LINKED_NUMBER, -1, len(batch), n_before
    for i in range(len(batch)):
        row, col = batch[i, 0], batch[i, 1]
        if linked and goals[row, col] != stamp - 1:
            return LINKED_ELSEWHERE, i, row, col
        if not atoms[row, col]:
            return NO_ATOM, i, row, col
        if lifted[row, col] == stamp:
            return SOURCE_TWICE, i, row, col
        lifted[row, col] = stamp
    for i in range(len(batch)):
        row, col = batch[i, 2], batch[i, 3]
        if 0 <= row < n_rows and 0 <= col < n_cols:
            if atoms[row, col] and lifted[row, col] != stamp:
                return GOAL_TAKEN, i, row, col
            if goals[row, col] == stamp:
                return GOAL_TWICE, i, row, col
            goals[row, col] = stamp
    return RIGHT, -1, 0, 0


@helper_kernel("UniTuple(int64, 3)(int64[::1])")
def tones_in_order(tone_goal: Ints) -> tuple[int, int, int]:
    """Count the tones of an axis, and find the first two closer than one site, or -1, -1."""
    n = 0
    before = -1
    meet, with_ = -1, -1
    for site in range(len(tone_goal)):
        if tone_goal[site] != NO_TONE:
            n += 1
            if before >= 0 and tone_goal[site] <= tone_goal[before] and meet < 0:
                meet, with_ = before, site
            before = site
    return n, meet, with_


@helper_kernel(f"{FAULT}({MOVES}, int64[::1], int64[::1], int64, int64, int64)")
def check_tones(
    batch: Moves,
    row_goal: Ints,
    column_goal: Ints,
    max_tweezers: int,
    max_row_tones: int,
    max_column_tones: int,
) -> Fault:
    """Test that a batch needs one trajectory per tone, in order, and not too many tones.

    Fills in ``row_goal`` and ``column_goal``. Without a fault, its last number is the number of tweezers.
    """
    for row in range(len(row_goal)):
        row_goal[row] = NO_TONE
    for col in range(len(column_goal)):
        column_goal[col] = NO_TONE
    for i in range(len(batch)):
        row, col, to_row, to_col = batch[i, 0], batch[i, 1], batch[i, 2], batch[i, 3]
        if row_goal[row] != NO_TONE and row_goal[row] != to_row:
            return ROW_TONE_SPLIT, i, row, int(row_goal[row])
        if column_goal[col] != NO_TONE and column_goal[col] != to_col:
            return COLUMN_TONE_SPLIT, i, col, int(column_goal[col])
        row_goal[row] = to_row
        column_goal[col] = to_col
    n_row_tones, meet, with_ = tones_in_order(row_goal)
    if n_row_tones > max_row_tones:
        return ROW_TONES, -1, n_row_tones, max_row_tones
    if meet >= 0:
        return ROW_ORDER, -1, meet, with_
    n_column_tones, meet, with_ = tones_in_order(column_goal)
    if n_column_tones > max_column_tones:
        return COLUMN_TONES, -1, n_column_tones, max_column_tones
    if meet >= 0:
        return COLUMN_ORDER, -1, meet, with_
    n_tweezers = n_row_tones * n_column_tones
    if n_tweezers > max_tweezers:
        return TWEEZERS, -1, n_row_tones, n_column_tones
    return RIGHT, -1, 0, n_tweezers


@helper_kernel(f"{FAULT}({ATOMS}, {STAMPS}, int64, int64[::1], int64[::1])")
def check_line_moves(atoms: Bools, lifted: Stamps, stamp: int, row_goal: Ints, column_goal: Ints) -> Fault:
    """Test that no crossing of two tones, named or not, meets an atom at rest.

    All tones that move do so along one axis, so a crossing goes straight.
    """
    n_rows, n_cols = atoms.shape
    for row in range(n_rows):
        if row_goal[row] == NO_TONE:
            continue
        for col in range(n_cols):
            if column_goal[col] == NO_TONE:
                continue
            if atoms[row, col] and lifted[row, col] != stamp:
                return CROSSING_ON_ATOM, -1, row, col
            to_row, to_col = row_goal[row], column_goal[col]
            off_grid = not (0 <= to_row < n_rows and 0 <= to_col < n_cols)
            down, right = min(max(to_row - row, -1), 1), min(max(to_col - col, -1), 1)
            r, c = row, col
            while r != to_row or c != to_col:
                r += down
                c += right
                if not (0 <= r < n_rows and 0 <= c < n_cols):
                    break
                if atoms[r, c] and lifted[r, c] != stamp:
                    ejects = off_grid and lifted[row, col] == stamp
                    return INNER_EJECTION if ejects else PATH_OVER_ATOM, -1, r, c
    return RIGHT, -1, 0, 0


GRID: Final = "bool_[:, ::1]"


@helper_kernel(f"boolean({MOVES}, {GRID})")
def move_atoms(batch: Moves, atoms: Bools) -> bool:
    """Carry out a batch, and return True if it ejects an atom."""
    n_rows, n_cols = atoms.shape
    ejects = False
    for i in range(len(batch)):
        atoms[batch[i, 0], batch[i, 1]] = False
    for i in range(len(batch)):
        row, col = batch[i, 2], batch[i, 3]
        if 0 <= row < n_rows and 0 <= col < n_cols:
            atoms[row, col] = True
        else:
            ejects = True
    return ejects


@helper_kernel(f"int64({MOVES})")
def longest_move(batch: Moves) -> int:
    """Length of the longest straight move of a batch, in sites."""
    longest = 0
    for i in range(len(batch)):
        down = abs(int(batch[i, 2]) - int(batch[i, 0]))
        right = abs(int(batch[i, 3]) - int(batch[i, 1]))
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


@helper_kernel(f"{FAULT}(UniTuple(int64, 3), int64, int64, int64)")
def count_tones(shape: Shape, max_tweezers: int, max_row_tones: int, max_column_tones: int) -> Fault:
    """Test how many tones the paths of a batch have. Without a fault the last number counts the tweezers."""
    if shape[0] < 2 or shape[1] < 1 or shape[2] < 1:
        return PATH_SHAPE, -1, 0, 0
    if shape[1] > max_row_tones:
        return ROW_TONES, -1, shape[1], max_row_tones
    if shape[2] > max_column_tones:
        return COLUMN_TONES, -1, shape[2], max_column_tones
    if shape[1] * shape[2] > max_tweezers:
        return TWEEZERS, -1, shape[1], shape[2]
    return RIGHT, -1, 0, shape[1] * shape[2]


@helper_kernel(f"{FAULT}({MOVES}, int64, int64)")
def check_sources(batch: Moves, n_rows: int, n_cols: int) -> Fault:
    """Test that the sources of a batch with paths lie on the grid."""
    for i in range(len(batch)):
        row, col = batch[i, 0], batch[i, 1]
        if not (0 <= row < n_rows and 0 <= col < n_cols):
            return SOURCE_OUTSIDE, i, row, col
    return RIGHT, -1, 0, 0


@helper_kernel(
    f"Tuple(({FAULT}, float64))({MOVES}, {POSITIONS}, {KNOTS}, UniTuple(int64, 3), {ATOMS}, {STAMPS},"
    f" {STAMPS}, {STAMPS}, int64, int64, int64, int64, int64, {POSITIONS})"
)
def check_path_batch(
    batch: Moves,
    positions: Floats,
    off: Stamps,
    shape: Shape,
    atoms: Bools,
    lifted: Stamps,
    goals: Stamps,
    stands_from: Stamps,
    stamp: int,
    max_tweezers: int,
    max_row_tones: int,
    max_column_tones: int,
    slots: int,
    geometry: Floats,
) -> tuple[Fault, float]:
    """Test a batch with paths of tones. Without a fault the last number counts the tweezers.

    The second result is the sum of the longest ways of all legs, in sites.
    """
    counted = count_tones(shape, max_tweezers, max_row_tones, max_column_tones)
    if counted[0] != RIGHT:
        return counted, 0.0
    tracks = tracks_of(positions, shape)
    fault = check_axis(tracks[0], off[: shape[1]], 0, atoms.shape[0], slots, geometry[2])
    if fault[0] == RIGHT:
        fault = check_axis(tracks[1], off[shape[1] :], 1, atoms.shape[1], slots, geometry[2])
    if fault[0] == RIGHT:
        fault = check_sources(batch, atoms.shape[0], atoms.shape[1])
    if fault[0] == RIGHT:
        fault = check_sites(batch, 0, atoms, lifted, goals, stamp, False)
    if fault[0] == RIGHT:
        fill_stands_from(atoms, lifted, stamp, stands_from)
        fault = check_ends(batch, tracks, off, stands_from)
    if fault[0] == RIGHT:
        clearance, cosine, may_land = geometry[0], geometry[1], geometry[3] > 0.0
        fault = check_motion(tracks, off, lifted, stands_from, stamp, clearance, cosine, may_land)
    if fault[0] != RIGHT:
        return fault, 0.0
    return counted, leg_ways(tracks, off, geometry[1]).sum()


@helper_kernel(
    f"{FAULT}({MOVES}, int64, {ATOMS}, {STAMPS}, {STAMPS}, int64[::1], int64[::1], int64, boolean, boolean,"
    " int64, int64, int64, int64)"
)
def check_lines_of_batch(
    batch: Moves,
    n_before: int,
    atoms: Bools,
    lifted: Stamps,
    goals: Stamps,
    row_goal: Ints,
    column_goal: Ints,
    stamp: int,
    follows: bool,
    leads: bool,
    max_tweezers: int,
    max_row_tones: int,
    max_column_tones: int,
    slots: int,
) -> Fault:
    """Test a batch along lines. Without a fault the last number counts the tweezers.

    A batch that ``follows`` is linked to the batch before, and the next batch is linked to a batch that
    ``leads``.
    """
    fault = check_shapes(batch, atoms.shape[0], atoms.shape[1], slots, follows or leads)
    if fault[0] == RIGHT:
        fault = check_sites(batch, n_before, atoms, lifted, goals, stamp, follows)
    if fault[0] != RIGHT:
        return fault
    counted = check_tones(batch, row_goal, column_goal, max_tweezers, max_row_tones, max_column_tones)
    if counted[0] != RIGHT:
        return counted
    fault = check_line_moves(atoms, lifted, stamp, row_goal, column_goal)
    return fault if fault[0] != RIGHT else counted


@helper_kernel(f"float64({KNOTS})")
def count_drops(off: Stamps) -> float:
    """Number of knots at which tones go off."""
    drops = 0.0
    for tone in range(len(off)):
        is_first = True
        for before in range(tone):
            is_first = is_first and off[before] != off[tone]
        drops += is_first
    return drops


@kernel(
    f"UniTuple(int64, 5)({MOVES}, {const('int32', 1)}, {const('bool_', 1)}, {PATHS}, {GRID}, int64, int64,"
    f" int64, int64, {POSITIONS}, float64[::1], float64[::1], int32[::1])"
)
def check(
    moves: Moves,
    offsets: Stamps,
    linked: Bools,
    paths: Paths,
    atoms: Bools,
    max_tweezers: int,
    max_row_tones: int,
    max_column_tones: int,
    slots: int,
    geometry: Floats,
    times_s: NDArray[np.float64],
    end_s: NDArray[np.float64],
    n_tweezers: Stamps,
) -> tuple[int, int, int, int, int]:
    """Play a plan.

    Args:
        moves: int16 (n_moves, 4).
        offsets: int32 (n_batches + 1,), from 0 to n_moves, not decreasing.
        linked: bool (n_batches,).
        paths: ``path_shapes``, ``path_positions`` and ``path_off`` of :class:`labseq.model.Plan`, whose
            lengths fit together.
        atoms: bool (n_rows, n_cols), before the plan. Updated to the occupancy after it.
        max_tweezers: Maximum number of tweezers on at once.
        max_row_tones: Maximum number of row tones on at once.
        max_column_tones: Maximum number of column tones on at once.
        slots: Ejection slots on each side.
        geometry: float64 (4,) with the clearance in sites, the cosine of the angle between rows and columns,
            the least distance of two tones of an axis with paths, in sites, and 1 if empty tweezers may land.
        times_s: float64 (5,), times before the first batch, before each batch that is not linked, and of
            pick-up ramp, move by one site, drop-off ramp.
        end_s: Result, float64 (n_batches,), end of each batch.
        n_tweezers: Result, int32 (n_batches,), tweezers on in each batch.

    Returns:
        The first fault, its batch and atom move (-1 if none in particular), and two numbers that belong to
        it.
    """
    n_batches, n_before = len(linked), 0
    lifted = np.zeros(atoms.shape, np.int32)
    goals = np.zeros(atoms.shape, np.int32)
    stands_from = np.zeros(atoms.shape if len(paths[0]) else (0, 0), np.int32)
    row_goal = np.empty(atoms.shape[0], np.int64)
    column_goal = np.empty(atoms.shape[1], np.int64)
    ejected = had_paths = False
    time_s = times_s[0]
    start = off_start = 0
    for number in range(n_batches):
        batch = moves[offsets[number] : offsets[number + 1]]
        follows = linked[number]
        leads = number + 1 < n_batches and linked[number + 1]
        if len(batch) == 0:
            return EMPTY_BATCH, number, -1, 0, 0
        if follows and number == 0:
            return LINKED_FIRST, number, -1, 0, 0
        if follows and ejected:
            return LINKED_AFTER_EJECTION, number, -1, 0, 0
        stamp = number + 1
        positions, off, shape = paths_of(paths, number, start, off_start)
        if follows and (had_paths or shape[0] > 0):
            return LINKED_AFTER_PATHS, number, -1, 0, 0
        had_paths = shape[0] + shape[1] + shape[2] > 0
        if had_paths:
            start, off_start = start + len(positions), off_start + len(off)
            fault, way = check_path_batch(
                batch, positions, off, shape, atoms, lifted, goals, stands_from, stamp,
                max_tweezers, max_row_tones, max_column_tones, slots, geometry,
            )  # fmt: skip
        else:
            fault = check_lines_of_batch(
                batch, n_before, atoms, lifted, goals, row_goal, column_goal, stamp, follows, leads,
                max_tweezers, max_row_tones, max_column_tones, slots,
            )  # fmt: skip
            way = float(longest_move(batch))
        n_tweezers[number] = fault[3]
        if fault[0] != RIGHT:
            return fault[0], number, fault[1], fault[2], fault[3]
        ejected = move_atoms(batch, atoms)
        n_before = len(batch)
        drops = count_drops(off) if had_paths else 0.0 if leads else 1.0
        time_s += 0.0 if follows else times_s[1] + times_s[2]
        time_s += way * times_s[3] + drops * times_s[4]
        end_s[number] = time_s
    return RIGHT, -1, -1, 0, 0
