"""The kernel of the planner: batch after batch, the best of its candidates."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq_grid.kernels_columns import (
    EMPTY,
    NUMBERS,
    SITES,
    SPARE,
    STAYS,
    TABLE,
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
LIMITS: Final = "UniTuple(int64, 3)"
Limits = tuple[int, int, int]
"""Maximum number of tweezers, row tones and column tones."""
Chosen = tuple[int, int, Ints, Ints]
"""Orientation, number of columns, source and goal rows, int64 (2, n), and columns, int64 (3, n_cols)."""
CHOSEN: Final = f"Tuple((int64, int64, {TABLE}, {TABLE}))"


@helper_kernel(f"int64({LIMITS}, int64, int64, int64)")
def column_limit(limits: Limits, n: int, swapped: int, n_lines: int) -> int:
    """Maximum number of columns of a batch of ``n`` rows; a lane needs one line of ``n_lines`` free."""
    tones = limits[1] if swapped else limits[2]
    return min(limits[0] // n, tones, n_lines)


@helper_kernel(f"int64({LIMITS}, int64, int64)")
def row_limit(limits: Limits, swapped: int, n_lines: int) -> int:
    """Maximum number of rows of a batch."""
    tones = limits[2] if swapped else limits[1]
    return min(limits[0], tones, n_lines)


@helper_kernel(f"int64({SITES}, {SITES}, {LIMITS}, int64, int64, {TABLE}, int64)")
def find_candidates(
    source: Bytes, vacant: Bytes, limits: Limits, slots: int, n_left: int, kept: Ints, n_beside: int
) -> int:
    """Find the best candidates of both orientations; ``n_beside``: lines outside of the grid."""
    n_kept = 0
    source_swapped, vacant_swapped = source.T.copy(), vacant.T.copy()
    lines, across = source.shape
    spread = 2 * (slots - n_beside) - 1  # the lanes need a free line among those that the tones reach
    most = min(MAX_ROWS, n_left)
    for n in range(most, 0, -1):
        for swapped in range(2):
            n_rows = (across if swapped else lines) + spread
            n_cols = (lines if swapped else across) + spread
            limit = min(column_limit(limits, n, swapped, n_cols), n_left)
            if limit < 1 or n > row_limit(limits, swapped, n_rows):
                continue
            if swapped:
                n_kept = try_rows(source_swapped, vacant_swapped, n, limit, 1, kept, n_kept, n_left)
            else:
                n_kept = try_rows(source, vacant, n, limit, 0, kept, n_kept, n_left)
    return n_kept


@helper_kernel(f"{CHOSEN}({SITES}, {SITES}, {LIMITS}, int64, {NUMBERS})")
def complete(source: Bytes, vacant: Bytes, limits: Limits, n_lines: int, candidate: Ints) -> Chosen:
    """Choose the columns of a candidate; ``source`` and ``vacant`` are in its orientation."""
    n, swapped, atoms = candidate[N_ROWS], candidate[ORIENTATION], candidate[ATOMS]
    n_cols = source.shape[1]
    rows = np.empty((2, n), np.int64)
    rows[0], rows[1] = candidate[FROM : FROM + n], candidate[TO : TO + n]
    limit = min(column_limit(limits, n, swapped, n_lines), atoms)
    spare = np.empty((1 << n, n_cols + 1), np.int64)
    find_spare(source, rows[0], n, spare)
    chosen = np.empty((3, n_cols), np.int64)
    m = trace_columns(spare, n, vacant, rows[1], limit, atoms, chosen)
    take_nearest(spare, m, chosen, np.empty((m + 1, n_cols + 1), np.int64))
    return swapped, m, rows, chosen


@helper_kernel(f"int64({CHOSEN}, {TABLE})")
def list_moves(chosen: Chosen, moves: Ints) -> int:
    """List the atom moves of a batch as (row, column, to row, to column); return how many."""
    swapped, m, rows, columns = chosen
    count = 0
    for i in range(rows.shape[1]):
        for j in range(m):
            if columns[0, j] >> i & 1:
                at, to = (rows[0, i], columns[2, j]), (rows[1, i], columns[1, j])
                moves[count, 0], moves[count, 1] = (at[1], at[0]) if swapped else at
                moves[count, 2], moves[count, 3] = (to[1], to[0]) if swapped else to
                count += 1
    return count


@helper_kernel(f"float64({SITES})")
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


@helper_kernel(f"float64({SITES}, {TABLE}, int64, boolean, {SITES})")
def worth(kind: Bytes, moves: Ints, n: int, fills: bool, marks: Bytes) -> float:
    """Worth of a batch of ``n`` moves: atoms carried, less ways and the scatter of what is left.

    ``marks`` is changed: the vacancies left if the batch ``fills``, else the unwanted atoms left.
    """
    total = float(n)
    for i in range(n):
        total += kind[moves[i, 0], moves[i, 1]] == UNWANTED
        side = 2 if fills else 0
        marks[moves[i, side], moves[i, side + 1]] = 0
    way = 0
    for i in range(n):
        way += abs(moves[i, 2] - moves[i, 0]) + abs(moves[i, 3] - moves[i, 1])
    return total - SCATTER * scatter(marks) - WAY * way


Growing = tuple[NDArray[np.int16], NDArray[np.int32], NDArray[np.int32], Floats, NDArray[np.int32]]
"""moves, batch offsets, path shapes, path positions, path off of :class:`labseq.plugin.Plan`."""
GROWING: Final = "Tuple((int16[:, ::1], int32[::1], int32[:, ::1], float64[::1], int32[::1]))"
Ends = tuple[int, int, int]
"""Number of batches, of positions and of knots so far."""


@helper_kernel(
    f"UniTuple(int64, 3)({GROWING}, UniTuple(int64, 3), {SITES}, int64, int64, {CHOSEN}, boolean, float64)"
)
def add_batch(
    plan: Growing,
    ends: Ends,
    kind: Bytes,
    n_beside: int,
    slots: int,
    chosen: Chosen,
    may_land: bool,
    weave: float,
) -> Ends:
    """Add a batch to the plan: its atom moves and the paths of its tones.

    ``kind`` begins ``n_beside`` lines outside of the grid.
    """
    moves, offsets, shapes, positions, off = plan
    n_batches, n_positions, n_off = ends
    swapped, m, rows, columns = chosen
    carried = np.empty((rows.shape[1] * m, 4), np.int64)
    n = list_moves(chosen, carried)
    start = offsets[n_batches]
    for i in range(n):
        for k in range(4):
            moves[start + i, k] = carried[i, k] - n_beside
    offsets[n_batches + 1] = start + n
    used = np.zeros(rows.shape[1], np.bool_)
    for i in range(len(used)):
        for j in range(m):
            used[i] = used[i] or columns[0, j] >> i & 1
    row, to_row = rows[0][used], rows[1][used]
    bit = np.flatnonzero(used)
    n_rows = len(row)
    free = np.empty((2 * n_rows, m), np.bool_)
    for i in range(n_rows):
        for j in range(m):
            r, c = (columns[1, j], to_row[i]) if swapped else (to_row[i], columns[1, j])
            free[i, j] = columns[0, j] >> bit[i] & 1
            free[n_rows + i, j] = free[i, j] or kind[r, c] == EMPTY
    lines = kind.shape[1] if swapped else kind.shape[0]
    across = kind.shape[0] if swapped else kind.shape[1]
    most = max_knots(lines + 2 * slots, across + 2 * slots)
    row_path, column_path = np.empty((most, n_rows)), np.empty((most, m))
    goes_off = np.empty(n_rows, np.int64)
    n_knots = find_paths(
        row - n_beside,
        to_row - n_beside,
        columns[2, :m] - n_beside,
        columns[1, :m] - n_beside,
        free,
        lines - 2 * n_beside,
        across - 2 * n_beside,
        slots,
        not may_land,
        weave,
        row_path,
        column_path,
        goes_off,
    )
    shapes[n_batches] = n_knots, m if swapped else n_rows, n_rows if swapped else m
    for part in range(2):
        path = column_path if (part == 1) != (swapped == 1) else row_path
        n_tones = path.shape[1]
        for knot in range(n_knots):
            for tone in range(n_tones):
                positions[n_positions] = path[knot, tone]
                n_positions += 1
        for tone in range(n_tones):
            off[n_off] = n_knots - 1
            if (part == 0) == (swapped == 0):
                off[n_off] = goes_off[tone]
            n_off += 1
    return n_batches + 1, n_positions, n_off


@helper_kernel(f"int64({SITES}, {SITES}, {CHOSEN}, int64)")
def carry_out(kind: Bytes, vacant: Bytes, chosen: Chosen, n_beside: int) -> int:
    """Update the sites after a batch; return how many atoms it carried."""
    moves = np.empty((chosen[2].shape[1] * chosen[1], 4), np.int64)
    n = list_moves(chosen, moves)
    n_rows, n_cols = kind.shape
    for i in range(n):
        row, col = moves[i, 2], moves[i, 3]
        kind[moves[i, 0], moves[i, 1]] = EMPTY
        if n_beside <= row < n_rows - n_beside and n_beside <= col < n_cols - n_beside:
            kind[row, col] = STAYS
            vacant[row, col] = 0
    return n


@helper_kernel(f"void({SITES}, boolean, boolean, {SITES})")
def find_sources(kind: Bytes, fills: bool, only_unwanted: bool, source: Bytes) -> None:
    """Mark atoms that may be carried as SPARE and the others as STAYS."""
    for row in range(kind.shape[0]):
        for col in range(kind.shape[1]):
            atom = kind[row, col]
            spare = atom == UNWANTED or (atom == SPARE and fills and not only_unwanted)
            source[row, col] = EMPTY if atom == EMPTY else SPARE if spare else STAYS


@helper_kernel(
    f"UniTuple(int64, 3)({GROWING}, UniTuple(int64, 3), {SITES}, {SITES}, {LIMITS}, int64, int64, boolean, "
    "boolean, int64, float64)"
)
def add_batches(
    plan: Growing,
    ends: Ends,
    kind: Bytes,
    vacant: Bytes,
    limits: Limits,
    n_beside: int,
    slots: int,
    may_land: bool,
    fills: bool,
    n_left: int,
    weave: float,
) -> Ends:
    """Add batches until ``n_left`` atoms have been carried, or no more can be."""
    source = np.empty_like(kind)
    kept = np.empty((N_KEPT, CANDIDATE), np.int64)
    n_unwanted = np.count_nonzero(kind == UNWANTED)
    n_compared = max(LEAST_COMPARED, N_KEPT * COMPARED_SITES // kind.size)
    while n_left > 0:
        best = -1e300
        chosen = (0, 0, np.empty((2, 0), np.int64), np.empty((3, 0), np.int64))
        for only_unwanted in range(2 if fills and n_unwanted > 0 else 1):
            find_sources(kind, fills, only_unwanted == 1, source)
            n_kept = find_candidates(source, vacant, limits, slots, n_left, kept, n_beside)
            source_swapped, vacant_swapped = source.T.copy(), vacant.T.copy()
            for i in range(n_kept):
                if kept[i, ATOMS] < kept[0, ATOMS] - SLACK or i >= n_compared:
                    break
                swapped = kept[i, ORIENTATION]
                n_lines = kind.shape[0 if swapped else 1] + 2 * (slots - n_beside) - 1
                if swapped:
                    found = complete(source_swapped, vacant_swapped, limits, n_lines, kept[i])
                else:
                    found = complete(source, vacant, limits, n_lines, kept[i])
                moves = np.empty((found[2].shape[1] * found[1], 4), np.int64)
                n = list_moves(found, moves)
                marks = vacant.copy() if fills else (kind == UNWANTED).astype(np.uint8)
                value = worth(kind, moves, n, fills, marks)
                if value > best:
                    best = value
                    chosen = found
        if chosen[1] == 0:
            break
        ends = add_batch(plan, ends, kind, n_beside, slots, chosen, may_land, weave)
        n_left -= carry_out(kind, vacant, chosen, n_beside)
        n_unwanted = np.count_nonzero(kind == UNWANTED)
    return ends


@kernel(f"{GROWING}({GRID}, {GRID}, {GRID}, {GRID}, {LIMITS}, int64, boolean, float64)")
def plan_grid(
    occupied: Bools,
    fill: Bools,
    wanted: Bools,
    clear: Bools,
    limits: Limits,
    slots: int,
    may_land: bool,
    weave: float,
) -> Growing:
    """Plan all batches: fill vacancies, then bring unwanted atoms to the reservoir, then eject the rest.

    Args:
        occupied: bool (n_rows, n_cols).
        fill: The same shape, sites that must hold an atom; no more than there are atoms.
        wanted: The same shape, sites of the whole target.
        clear: The same shape, sites that must be empty.
        limits: Maximum number of tweezers, row tones and column tones.
        slots: Lines beyond the grid that the tones reach on each side.
        may_land: Whether a tweezer without an atom may be ramped down on an atom.
        weave: How far lanes swing, see :func:`labseq_grid.kernels_paths.add_travel`.

    Returns:
        The arrays of a :class:`labseq.plugin.Plan`, without ``linked``.
    """
    n_rows, n_cols = occupied.shape
    n_unwanted = np.count_nonzero(occupied & clear)
    n_beside = slots if n_unwanted > 0 else 0
    shape = (n_rows + 2 * n_beside, n_cols + 2 * n_beside)
    kind, vacant = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    n_vacant = 0
    for row in range(n_rows):
        for col in range(n_cols):
            at = row + n_beside, col + n_beside
            if occupied[row, col]:
                kind[at] = STAYS if fill[row, col] else UNWANTED if clear[row, col] else SPARE
            elif fill[row, col]:
                vacant[at] = 1
                n_vacant += 1
    n_most = n_vacant + n_unwanted
    plan = (
        np.empty((n_most, 4), np.int16),
        np.zeros(n_most + 1, np.int32),
        np.empty((n_most, 3), np.int32),
        np.empty(2 * max_knots(n_rows + 2 * slots, n_cols + 2 * slots) * n_most),
        np.empty(2 * n_most, np.int32),
    )
    ends = add_batches(
        plan, (0, 0, 0), kind, vacant, limits, n_beside, slots, may_land, True, n_vacant, weave
    )
    for outside in range(2 if n_unwanted > 0 else 0):
        vacant[:] = 0
        for row in range(shape[0]):
            for col in range(shape[1]):
                r, c = row - n_beside, col - n_beside
                on_grid = 0 <= r < n_rows and 0 <= c < n_cols
                if outside:
                    vacant[row, col] = not on_grid
                elif on_grid and not (wanted[r, c] or clear[r, c]):
                    vacant[row, col] = kind[row, col] == EMPTY
        n_left = int(np.count_nonzero(kind == UNWANTED))
        ends = add_batches(plan, ends, kind, vacant, limits, n_beside, slots, may_land, False, n_left, weave)
    n_batches, n_positions, n_off = ends
    moves, offsets, shapes, positions, off = plan
    n_moves = offsets[n_batches]
    return (
        moves[:n_moves].copy(),
        offsets[: n_batches + 1].copy(),
        shapes[:n_batches].copy(),
        positions[:n_positions].copy(),
        off[:n_off].copy(),
    )
