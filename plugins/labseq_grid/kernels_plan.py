"""The kernel of the planner: batch after batch, the best of its candidates."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.plan_kernels import GROWING_PLAN, GrowingPlan, add_move, empty_plan, end_batch, finished
from labseq_grid.kernels_columns import (
    EMPTY,
    SPARE,
    STAYS,
    Bytes,
    Ints,
    find_spare,
    take_nearest,
    trace_columns,
)
from labseq_grid.kernels_paths import Bools, Floats, find_paths, max_knots
from labseq_grid.kernels_rows import (
    ATOMS,
    CANDIDATE,
    FROM,
    MAX_ROWS,
    N_KEPT,
    N_ROWS,
    ORIENTATION,
    SLACK,
    TO,
    Candidates,
    try_rows,
)

UNWANTED: Final = 3
"""An atom on a site that must be empty; elsewhere an atom is SPARE or STAYS."""
SCATTER: Final = 3.0
"""Weight of the vacancies that are left, against one atom carried."""
WAY: Final = 0.05
"""Weight of one site of an atom's way: on long ways tweezers pass many atoms."""
COMPARED_SITES: Final = 2000
"""Number of sites up to which all candidates that are kept are compared; above, fewer."""
LEAST_COMPARED: Final = 6
GRID: Final = const("bool_", 2)

Limits = tuple[int, int, int]
"""Maximum number of tweezers, row tones and column tones."""
Machine = tuple[Limits, int, bool, float]
"""Limits; lines beyond the grid that the tones reach on each side; whether a tweezer without an atom may be
ramped down on an atom; how far lanes swing, see :func:`labseq_grid.kernels_paths.add_travel`."""
MACHINE: Final = "Tuple((UniTuple(int64, 3), int64, boolean, float64))"
Sites = tuple[Bytes, Bytes, int]
"""What each site holds (EMPTY, SPARE, STAYS or UNWANTED), and where an atom may be dropped off, both uint8;
and how many lines outside of the grid they have on each side."""
SITES: Final = "Tuple((uint8[:, ::1], uint8[:, ::1], int64))"
Batch = tuple[int, Ints, Ints]
"""Orientation; source and goal rows, int64 (2, n); pattern, goal and source of each column, int64 (3, m)."""
Paths = tuple[NDArray[np.int32], Floats, NDArray[np.int32], int, int]
"""path_shapes, path_positions and path_off of :class:`labseq.plugin.Plan`; how many of the last two."""
PATHS: Final = "Tuple((int32[:, ::1], float64[::1], int32[::1], int64, int64))"


@helper_kernel()
def column_limit(limits: Limits, n: int, swapped: int, n_lines: int) -> int:
    """Maximum number of columns of a batch of ``n`` rows; a lane needs one line of ``n_lines`` free."""
    tones = limits[1] if swapped else limits[2]
    return min(limits[0] // n, tones, n_lines)


@helper_kernel()
def row_limit(limits: Limits, swapped: int, n_lines: int) -> int:
    """Maximum number of rows of a batch."""
    tones = limits[2] if swapped else limits[1]
    return min(limits[0], tones, n_lines)


@helper_kernel()
def find_candidates(source: Bytes, vacant: Bytes, limits: Limits, spread: int, n_left: int) -> Candidates:
    """Find the best candidates of both orientations.

    ``spread`` is the number of lines that tones reach outside of ``source``, less one, for lanes.
    """
    candidates = np.empty((N_KEPT, CANDIDATE), np.int64), 0
    source_swapped, vacant_swapped = source.T.copy(), vacant.T.copy()
    lines, across = source.shape
    for n in range(min(MAX_ROWS, n_left), 0, -1):
        for swapped in range(2):
            n_rows = (across if swapped else lines) + spread
            n_cols = (lines if swapped else across) + spread
            limit = min(column_limit(limits, n, swapped, n_cols), n_left)
            if limit < 1 or n > row_limit(limits, swapped, n_rows):
                continue
            if swapped:
                candidates = try_rows(candidates, source_swapped, vacant_swapped, n, limit, 1, n_left)
            else:
                candidates = try_rows(candidates, source, vacant, n, limit, 0, n_left)
    return candidates


@helper_kernel()
def complete(source: Bytes, vacant: Bytes, limits: Limits, n_lines: int, candidate: Ints) -> Batch:
    """Choose the columns of a candidate; ``source`` and ``vacant`` are in its orientation."""
    n, swapped, atoms = candidate[N_ROWS], candidate[ORIENTATION], candidate[ATOMS]
    n_cols = source.shape[1]
    rows = np.empty((2, n), np.int64)
    rows[0], rows[1] = candidate[FROM : FROM + n], candidate[TO : TO + n]
    limit = min(column_limit(limits, n, swapped, n_lines), atoms)
    spare = np.empty((1 << n, n_cols + 1), np.int64)
    find_spare(source, rows[0], n, spare)
    columns = np.empty((3, n_cols), np.int64)
    m = trace_columns(spare, n, vacant, rows[1], limit, atoms, columns)
    take_nearest(spare, m, columns, np.empty((m + 1, n_cols + 1), np.int64))
    return swapped, rows, columns[:, :m].copy()


@helper_kernel()
def list_moves(batch: Batch) -> Ints:
    """List the atom moves of a batch, int64 (n, 4): (row, column, to row, to column)."""
    swapped, rows, columns = batch
    moves = np.empty((rows.shape[1] * columns.shape[1], 4), np.int64)
    n = 0
    for i in range(rows.shape[1]):
        for j in range(columns.shape[1]):
            if columns[0, j] >> i & 1:
                at, to = (rows[0, i], columns[2, j]), (rows[1, i], columns[1, j])
                moves[n, 0], moves[n, 1] = (at[1], at[0]) if swapped else at
                moves[n, 2], moves[n, 3] = (to[1], to[0]) if swapped else to
                n += 1
    return moves[:n]


@helper_kernel()
def scatter(marks: Bytes) -> float:
    """How scattered marked sites are: each counts one over the number of them in its row or column."""
    n_rows, n_cols = marks.shape
    in_row, in_column = np.zeros(n_rows, np.int64), np.zeros(n_cols, np.int64)
    for row in range(n_rows):
        for col in range(n_cols):
            in_row[row] += marks[row, col]
            in_column[col] += marks[row, col]
    total = 0.0
    for row in range(n_rows):
        for col in range(n_cols):
            if marks[row, col]:
                total += 1.0 / max(in_row[row], in_column[col])
    return total


@helper_kernel()
def worth(sites: Sites, moves: Ints, fills: bool) -> float:
    """Worth of a batch: atoms carried, less their ways and the scatter of what it leaves.

    It leaves vacancies if the batch ``fills``, else unwanted atoms.
    """
    kind, vacant, _ = sites
    marks = vacant.copy() if fills else (kind == UNWANTED).astype(np.uint8)
    side = 2 if fills else 0
    way, total = 0, float(len(moves))
    for i in range(len(moves)):
        total += kind[moves[i, 0], moves[i, 1]] == UNWANTED
        marks[moves[i, side], moves[i, side + 1]] = 0
        way += abs(moves[i, 2] - moves[i, 0]) + abs(moves[i, 3] - moves[i, 1])
    return total - SCATTER * scatter(marks) - WAY * way


@helper_kernel()
def find_sources(kind: Bytes, fills: bool, only_unwanted: bool, source: Bytes) -> None:
    """Mark atoms that may be carried as SPARE and the others as STAYS."""
    for row in range(kind.shape[0]):
        for col in range(kind.shape[1]):
            atom = kind[row, col]
            spare = atom == UNWANTED or (atom == SPARE and fills and not only_unwanted)
            source[row, col] = EMPTY if atom == EMPTY else SPARE if spare else STAYS


@helper_kernel()
def best_batch(sites: Sites, machine: Machine, fills: bool, n_left: int) -> Batch:
    """Compare the candidates that carry most atoms, at most ``n_left``; no columns if none carries any."""
    kind, vacant, n_beside = sites
    limits, slots, _, _ = machine
    source = np.empty_like(kind)
    spread = 2 * (slots - n_beside) - 1
    n_compared = max(LEAST_COMPARED, N_KEPT * COMPARED_SITES // kind.size)
    best, most = (0, np.empty((2, 0), np.int64), np.empty((3, 0), np.int64)), -1e300
    for only_unwanted in range(2 if fills and (kind == UNWANTED).any() else 1):
        find_sources(kind, fills, only_unwanted == 1, source)
        kept, n_kept = find_candidates(source, vacant, limits, spread, n_left)
        source_swapped, vacant_swapped = source.T.copy(), vacant.T.copy()
        for i in range(min(n_kept, n_compared)):
            if kept[i, ATOMS] < kept[0, ATOMS] - SLACK:
                break
            if kept[i, ORIENTATION]:
                batch = complete(source_swapped, vacant_swapped, limits, kind.shape[0] + spread, kept[i])
            else:
                batch = complete(source, vacant, limits, kind.shape[1] + spread, kept[i])
            value = worth(sites, list_moves(batch), fills)
            if value > most:
                best, most = batch, value
    return best


@helper_kernel()
def paths_of(sites: Sites, machine: Machine, batch: Batch) -> tuple[Floats, Floats, Ints]:
    """Find the paths of a batch's tones, see :func:`labseq_grid.kernels_paths.find_paths`."""
    kind, _, n_beside = sites
    _, slots, may_land, weave = machine
    swapped, rows, columns = batch
    used = np.zeros(rows.shape[1], np.bool_)  # a row of which no column takes an atom needs no tone
    for i in range(len(used)):
        used[i] = (columns[0] >> i & 1).any()
    bits = np.flatnonzero(used)
    n, m = len(bits), columns.shape[1]
    carried, free = np.empty((n, m), np.bool_), np.empty((n, m), np.bool_)
    for i in range(n):
        for j in range(m):
            row, col = rows[1, bits[i]], columns[1, j]
            r, c = (col, row) if swapped else (row, col)
            carried[i, j] = columns[0, j] >> bits[i] & 1
            free[i, j] = carried[i, j] or kind[r, c] == EMPTY
    lines, across = (kind.shape[1], kind.shape[0]) if swapped else kind.shape
    last = slots - 2 * n_beside - 1
    row, to_row = rows[0][used] - n_beside, rows[1][used] - n_beside
    column, to_column = columns[2] - n_beside, columns[1] - n_beside
    band = (-slots, lines + last, -slots, across + last)
    return find_paths((row, to_row), (column, to_column), (carried, free), band, not may_land, weave)


@helper_kernel()
def add_axis(paths: Paths, positions: Floats, goes_off: Ints) -> Paths:
    """Add paths of the n tones of an axis, float64 (n_knots, n), and where each goes off, int64 (n,)."""
    shapes, all_positions, off, n_positions, n_off = paths
    stop, off_stop = n_positions + positions.size, n_off + len(goes_off)
    all_positions[n_positions:stop] = positions.reshape(-1)
    off[n_off:off_stop] = goes_off
    return shapes, all_positions, off, stop, off_stop


@helper_kernel()
def add_batch(
    plan: GrowingPlan, paths: Paths, sites: Sites, machine: Machine, batch: Batch
) -> tuple[GrowingPlan, Paths]:
    """Add a batch: its atom moves and the paths of its tones."""
    row_path, column_path, goes_off = paths_of(sites, machine, batch)
    n_knots = len(row_path)
    stays_on = np.full(column_path.shape[1], n_knots - 1)  # the columns are ramped down with the last row
    if batch[0]:
        paths[0][plan[3]] = n_knots, column_path.shape[1], row_path.shape[1]
        paths = add_axis(add_axis(paths, column_path, stays_on), row_path, goes_off)
    else:
        paths[0][plan[3]] = n_knots, row_path.shape[1], column_path.shape[1]
        paths = add_axis(add_axis(paths, row_path, goes_off), column_path, stays_on)
    moves = list_moves(batch) - sites[2]
    for i in range(len(moves)):
        plan = add_move(plan, moves[i, 0], moves[i, 1], moves[i, 2], moves[i, 3])
    return end_batch(plan, False), paths


@helper_kernel()
def carry_out(sites: Sites, moves: Ints) -> None:
    """Update the sites after a batch."""
    kind, vacant, n_beside = sites
    n_rows, n_cols = kind.shape
    for i in range(len(moves)):
        row, col = moves[i, 2], moves[i, 3]
        kind[moves[i, 0], moves[i, 1]] = EMPTY
        if n_beside <= row < n_rows - n_beside and n_beside <= col < n_cols - n_beside:
            kind[row, col] = STAYS
            vacant[row, col] = 0


@helper_kernel(
    f"Tuple(({GROWING_PLAN}, {PATHS}))({GROWING_PLAN}, {PATHS}, {SITES}, {MACHINE}, boolean, int64)"
)
def add_batches(
    plan: GrowingPlan, paths: Paths, sites: Sites, machine: Machine, fills: bool, n_left: int
) -> tuple[GrowingPlan, Paths]:
    """Add batches until ``n_left`` atoms have been carried, or no more can be; updates ``sites``."""
    while n_left > 0:
        batch = best_batch(sites, machine, fills, n_left)
        if batch[2].shape[1] == 0:
            break
        plan, paths = add_batch(plan, paths, sites, machine, batch)
        moves = list_moves(batch)
        carry_out(sites, moves)
        n_left -= len(moves)
    return plan, paths


@helper_kernel()
def read_sites(occupied: Bools, fill: Bools, clear: Bools, n_beside: int) -> Sites:
    """Sort atoms and vacancies, with ``n_beside`` lines around the grid."""
    n_rows, n_cols = occupied.shape
    shape = (n_rows + 2 * n_beside, n_cols + 2 * n_beside)
    kind, vacant = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for row in range(n_rows):
        for col in range(n_cols):
            at = row + n_beside, col + n_beside
            if occupied[row, col]:
                kind[at] = STAYS if fill[row, col] else UNWANTED if clear[row, col] else SPARE
            elif fill[row, col]:
                vacant[at] = 1
    return kind, vacant, n_beside


@helper_kernel()
def open_reservoir(sites: Sites, kept_free: Bools) -> None:
    """Let atoms be dropped off where there are none, except on the sites that are ``kept_free``."""
    kind, vacant, n_beside = sites
    vacant[:] = 0
    for row in range(kept_free.shape[0]):
        for col in range(kept_free.shape[1]):
            at = row + n_beside, col + n_beside
            vacant[at] = not kept_free[row, col] and kind[at] == EMPTY


@helper_kernel()
def open_outside(sites: Sites) -> None:
    """Let atoms be dropped off outside of the grid, and nowhere else."""
    _, vacant, n_beside = sites
    n_rows, n_cols = vacant.shape
    vacant[:] = 1
    vacant[n_beside : n_rows - n_beside, n_beside : n_cols - n_beside] = 0


@kernel(
    "Tuple((int16[:, ::1], int32[::1], bool_[::1], int32[:, ::1], float64[::1], int32[::1]))"
    f"({GRID}, {GRID}, {GRID}, {GRID}, {MACHINE})"
)
def plan_grid(
    occupied: Bools, fill: Bools, wanted: Bools, clear: Bools, machine: Machine
) -> tuple[NDArray[np.generic], ...]:
    """Plan all batches: fill vacancies, then bring unwanted atoms to the reservoir, then eject the rest.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: The same shape, sites that must hold an atom; no more than there are atoms.
        wanted: The same shape, sites of the whole target.
        clear: The same shape, sites that must be empty.
        machine: See :data:`Machine`.

    Returns:
        The arrays of a :class:`labseq.plugin.Plan`.
    """
    n_rows, n_cols = occupied.shape
    slots = machine[1]
    n_unwanted = int(np.count_nonzero(occupied & clear))
    n_vacant = int(np.count_nonzero(fill & ~occupied))
    sites = read_sites(occupied, fill, clear, slots if n_unwanted > 0 else 0)
    n_most = n_vacant + n_unwanted
    plan = empty_plan(n_most)
    paths = (
        np.empty((n_most, 3), np.int32),
        np.empty(2 * max_knots(n_rows + 2 * slots, n_cols + 2 * slots) * n_most),
        np.empty(2 * n_most, np.int32),
        0,
        0,
    )
    plan, paths = add_batches(plan, paths, sites, machine, True, n_vacant)
    if n_unwanted > 0:
        open_reservoir(sites, wanted | clear)
        n_left = int(np.count_nonzero(sites[0] == UNWANTED))
        plan, paths = add_batches(plan, paths, sites, machine, False, n_left)
        open_outside(sites)
        n_left = int(np.count_nonzero(sites[0] == UNWANTED))
        plan, paths = add_batches(plan, paths, sites, machine, False, n_left)
    moves, offsets, linked = finished(plan)
    shapes, positions, off, n_positions, n_off = paths
    path_arrays = shapes[: plan[3]].copy(), positions[:n_positions].copy(), off[:n_off].copy()
    return moves, offsets, linked, path_arrays[0], path_arrays[1], path_arrays[2]
