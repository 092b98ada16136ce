"""The kernel of the planner, which takes the best candidate for each batch."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.plan_kernels import GROWING_PLAN, GrowingPlan, add_move, empty_plan, end_batch, finished
from labseq_grid.kernels_columns import (
    COSTS,
    EMPTY,
    SPARE,
    STAYS,
    UNWANTED,
    Bytes,
    Costs,
    Ints,
    Limits,
    View,
    workspace,
)
from labseq_grid.kernels_paths import Bools, Floats, find_paths, max_knots
from labseq_grid.kernels_rows import BAND, Batch, State, best_batch, find_nearest, make_pairs

GRID: Final = const("bool_", 2)

Machine = tuple[tuple[int, int, int], int, bool, float, Costs]
"""Maximum number of tweezers, row tones and column tones, lines beyond the grid that the tones reach on each
side, True if an empty tweezer may be ramped down on an atom, the swing of lanes of
:func:`labseq_grid.kernels_paths.add_travel`, and expected losses."""
MACHINE: Final = f"Tuple((UniTuple(int64, 3), int64, boolean, float64, {COSTS}))"
Sites = tuple[Bytes, Bytes, int]
"""Content of each site (EMPTY, SPARE, STAYS or UNWANTED), and where an atom may be dropped off, both uint8,
and their number of lines outside the grid on each side."""
SITES: Final = "Tuple((uint8[:, ::1], uint8[:, ::1], int64))"
Paths = tuple[NDArray[np.int32], Floats, NDArray[np.int32], int, int]
"""path_shapes, path_positions and path_off of :class:`labseq.plugin.Plan`, and numbers of the last two."""
PATHS: Final = "Tuple((int32[:, ::1], float64[::1], int32[::1], int64, int64))"


@helper_kernel()
def list_moves(batch: Batch) -> Ints:
    """List the atom moves of a batch, int64 (n, 4), as (row, column, to row, to column)."""
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
def paths_of(sites: Sites, machine: Machine, batch: Batch) -> tuple[Floats, Floats, Ints]:
    """Find the paths of a batch's tones by :func:`labseq_grid.kernels_paths.find_paths`."""
    kind, _, n_beside = sites
    _, slots, may_land, weave, _ = machine
    swapped, rows, columns = batch
    n, m = 0, columns.shape[1]
    used = np.empty(rows.shape[1], np.int64)
    for i in range(rows.shape[1]):
        for j in range(m):
            if columns[0, j] >> i & 1:  # a row from which no column takes an atom needs no tone
                used[n] = i
                n += 1
                break
    carried, free = np.empty((n, m), np.bool_), np.empty((n, m), np.bool_)
    row_tones = np.empty(n, np.int64), np.empty(n, np.int64)
    column_tones = np.empty(m, np.int64), np.empty(m, np.int64)
    for i in range(n):
        for j in range(m):
            row, col = rows[1, used[i]], columns[1, j]
            r, c = (col, row) if swapped else (row, col)
            carried[i, j] = columns[0, j] >> used[i] & 1
            free[i, j] = carried[i, j] or kind[r, c] == EMPTY
        row_tones[0][i], row_tones[1][i] = rows[0, used[i]] - n_beside, rows[1, used[i]] - n_beside
    for j in range(m):
        column_tones[0][j], column_tones[1][j] = columns[2, j] - n_beside, columns[1, j] - n_beside
    lines, across = (kind.shape[1], kind.shape[0]) if swapped else kind.shape
    last = slots - 2 * n_beside - 1
    band = -slots, lines + last, -slots, across + last
    return find_paths(row_tones, column_tones, (carried, free), band, not may_land, weave)


@helper_kernel()
def add_axis(paths: Paths, positions: Floats, goes_off: Ints) -> Paths:
    """Add paths of the n tones of an axis, float64 (n_knots, n), and knots at which they end, int64 (n,)."""
    shapes, all_positions, off, n_positions, n_off = paths
    stop, off_stop = n_positions + positions.size, n_off + len(goes_off)
    n_tones = len(goes_off)
    for knot in range(len(positions)):
        for i in range(n_tones):
            all_positions[n_positions + knot * n_tones + i] = positions[knot, i]
    for i in range(n_tones):
        off[n_off + i] = goes_off[i]
    return shapes, all_positions, off, stop, off_stop


@helper_kernel()
def add_batch(
    plan: GrowingPlan, paths: Paths, sites: Sites, machine: Machine, batch: Batch
) -> tuple[GrowingPlan, Paths]:
    """Add the atom moves of a batch and the paths of its tones."""
    row_path, column_path, goes_off = paths_of(sites, machine, batch)
    n_knots = len(row_path)
    stays_on = np.empty(column_path.shape[1], np.int64)
    for j in range(len(stays_on)):  # the columns are ramped down with the last row
        stays_on[j] = n_knots - 1
    shape, n_beside = paths[0][plan[3]], sites[2]
    shape[0] = n_knots
    if batch[0]:
        shape[1], shape[2] = column_path.shape[1], row_path.shape[1]
        paths = add_axis(add_axis(paths, column_path, stays_on), row_path, goes_off)
    else:
        shape[1], shape[2] = row_path.shape[1], column_path.shape[1]
        paths = add_axis(add_axis(paths, row_path, goes_off), column_path, stays_on)
    moves = list_moves(batch)
    for i in range(len(moves)):
        row, col, to_row, to_col = moves[i]
        plan = add_move(plan, row - n_beside, col - n_beside, to_row - n_beside, to_col - n_beside)
    return end_batch(plan, False), paths


@helper_kernel()
def distances(source: Bytes) -> Floats:
    """Distance of each site from the nearest atom that may be taken, along rows and columns."""
    n_rows, n_cols = source.shape
    away = np.empty((n_rows, n_cols))
    for row in range(n_rows):
        for col in range(n_cols):
            atom = source[row, col]
            away[row, col] = 0.0 if atom in (SPARE, UNWANTED) else n_rows + n_cols
            if row > 0:
                away[row, col] = min(away[row, col], away[row - 1, col] + 1.0)
            if col > 0:
                away[row, col] = min(away[row, col], away[row, col - 1] + 1.0)
    for row in range(n_rows - 1, -1, -1):
        for col in range(n_cols - 1, -1, -1):
            if row + 1 < n_rows:
                away[row, col] = min(away[row, col], away[row + 1, col] + 1.0)
            if col + 1 < n_cols:
                away[row, col] = min(away[row, col], away[row, col + 1] + 1.0)
    return away


@helper_kernel()
def view_of(kind: Bytes, vacant: Bytes, unavoidable: Floats, limits: Limits, costs: Costs) -> View:
    """One orientation of the grid."""
    return (kind, vacant, unavoidable), limits, costs, workspace(max(kind.shape))


@helper_kernel()
def state_of(sites: Sites, machine: Machine, fills: bool, band: int) -> State:
    """The state before the first batch. Sources are all atoms to spare if batches fill vacancies."""
    kind, vacant, n_beside = sites
    limits, slots, _, _, costs = machine
    spread = 2 * (slots - n_beside) - 1  # a lane needs one line free
    n_rows, n_cols = min(limits[1], kind.shape[0] + spread), min(limits[2], kind.shape[1] + spread)
    source, unavoidable = kind.copy(), distances(kind)
    for row in range(kind.shape[0]):
        for col in range(kind.shape[1]):
            unavoidable[row, col] *= 2.0 * costs[3] if fills else 0.0
            if kind[row, col] == SPARE and not fills:
                source[row, col] = STAYS
    as_is = view_of(source, vacant.copy(), unavoidable, (limits[0], n_rows, n_cols, band), costs)
    swapped_limits = limits[0], n_cols, n_rows, band
    swapped = view_of(source.T.copy(), vacant.T.copy(), unavoidable.T.copy(), swapped_limits, costs)
    return (as_is, make_pairs(as_is)), (swapped, make_pairs(swapped))


@helper_kernel()
def carry_out(sites: Sites, state: State, moves: Ints, number: int) -> None:
    """Update the sites, and the state, after a batch."""
    kind, vacant, n_beside = sites
    n_rows, n_cols = kind.shape
    for i in range(len(moves)):
        from_row, from_col, row, col = moves[i]
        stays = n_beside <= row < n_rows - n_beside and n_beside <= col < n_cols - n_beside
        kind[from_row, from_col] = EMPTY
        if stays:
            kind[row, col], vacant[row, col] = STAYS, 0
        for a in range(2):
            view, pairs = state[a]
            source, goals, _ = view[0]
            at, to = ((from_col, from_row), (col, row)) if a else ((from_row, from_col), (row, col))
            source[at] = EMPTY
            if stays:
                source[to], goals[to] = STAYS, 0
            pairs[3][0, at[0]] = pairs[3][1, to[0]] = number
    for a in range(2):
        view, pairs = state[a]
        for row in range(len(pairs[2])):
            if pairs[3][0, row] == number:
                find_nearest(view[0][0], row, pairs[4])


@helper_kernel(f"Tuple(({GROWING_PLAN}, {PATHS}))({GROWING_PLAN}, {PATHS}, {SITES}, {MACHINE}, boolean)")
def add_batches(
    plan: GrowingPlan, paths: Paths, sites: Sites, machine: Machine, fills: bool
) -> tuple[GrowingPlan, Paths]:
    """Add batches until no more atoms can be carried. Updates ``sites``."""
    widest, number = max(sites[0].shape), -1
    band = min(BAND, widest)
    state = state_of(sites, machine, fills, band)
    while sites[1].any():
        number += 1
        batch = best_batch(state, number)
        if batch[2].shape[1] > 0:
            plan, paths = add_batch(plan, paths, sites, machine, batch)
            carry_out(sites, state, list_moves(batch), number)
        elif band < widest:  # remaining sources may be further away
            band = widest
            state = state_of(sites, machine, fills, band)
        else:
            break
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
    """Let atoms be dropped off on empty sites, except on the sites that are ``kept_free``."""
    kind, vacant, n_beside = sites
    vacant[:] = 0
    for row in range(kept_free.shape[0]):
        for col in range(kept_free.shape[1]):
            at = row + n_beside, col + n_beside
            vacant[at] = not kept_free[row, col] and kind[at] == EMPTY


@helper_kernel()
def open_outside(sites: Sites) -> None:
    """Let atoms be dropped off outside the grid, and nowhere else."""
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
    """Plan all batches, to fill vacancies, then bring unwanted atoms to the reservoir, then eject the rest.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: The same shape, sites that must hold an atom, no more than there are atoms.
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
    plan, paths = add_batches(plan, paths, sites, machine, True)
    if n_unwanted > 0:
        open_reservoir(sites, wanted | clear)
        plan, paths = add_batches(plan, paths, sites, machine, False)
        open_outside(sites)
        plan, paths = add_batches(plan, paths, sites, machine, False)
    moves, offsets, linked = finished(plan)
    shapes, positions, off, n_positions, n_off = paths
    path_arrays = shapes[: plan[3]].copy(), positions[:n_positions].copy(), off[:n_off].copy()
    return moves, offsets, linked, path_arrays[0], path_arrays[1], path_arrays[2]
