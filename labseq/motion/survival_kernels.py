"""Kernel of the losses that line batches cause. Python code follows plans with paths of tones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Moves = NDArray[np.int16]


@helper_kernel(f"int64({const('int16', 2)}, int64, int64[::1])")
def n_tones(batch: Moves, axis: int, seen: NDArray[np.int64]) -> int:
    """Count the tones of an axis that a batch has on, rows (0) or columns (1). ``seen`` is scratch."""
    most = 0
    for end in (axis, axis + 2):
        n = 0
        for i in range(len(batch)):
            site = batch[i, end]
            is_new = True
            for k in range(n):
                is_new = is_new and seen[k] != site
            if is_new:
                seen[n] = site
                n += 1
        most = max(most, n)
    return most


@kernel(
    f"float64[:, ::1]({const('int16', 2)}, {const('int32', 1)}, {const('bool_', 1)}, int64, int64,"
    f" UniTuple(float64, 3), {const('float64', 2)})"
)
def line_hazards(
    moves: Moves,
    offsets: NDArray[np.int32],
    linked: Bools,
    n_rows: int,
    n_cols: int,
    losses: tuple[float, float, float],
    axes: Floats,
) -> Floats:
    """Hazard of the atom that ends on each site, by a plan of line batches that was checked.

    Args:
        moves: int16 (n_moves, 4).
        offsets: int32 (n_batches + 1,).
        linked: bool (n_batches,).
        n_rows: Rows of the grid.
        n_cols: Columns of the grid.
        losses: Loss of a move, its part for each tone beyond one per axis, and per metre of way.
        axes: float64 (2, 2), the way by one column and by one row, in metres.

    Returns:
        float64 (n_rows, n_cols).
    """
    hazards = np.zeros((n_rows, n_cols))
    most = 1
    for number in range(len(linked)):
        most = max(most, offsets[number + 1] - offsets[number])
    carried = np.empty(most)
    seen = np.empty(most, np.int64)
    for number in range(len(linked)):
        batch = moves[offsets[number] : offsets[number + 1]]
        ramps = 0.0  # a chain counts its ramps at its start
        if not linked[number]:
            ramps = losses[0] + losses[1] * (n_tones(batch, 0, seen) + n_tones(batch, 1, seen) - 2)
        for i in range(len(batch)):
            down, right = batch[i, 2] - batch[i, 0], batch[i, 3] - batch[i, 1]
            way_m = math.hypot(right * axes[0, 0] + down * axes[1, 0], right * axes[0, 1] + down * axes[1, 1])
            loss = min(ramps + losses[2] * way_m, 1.0 - 1e-9)
            row, col = batch[i, 0], batch[i, 1]
            carried[i] = hazards[row, col] - math.log1p(-loss)
        for i in range(len(batch)):
            hazards[batch[i, 0], batch[i, 1]] = 0.0
        for i in range(len(batch)):
            row, col = batch[i, 2], batch[i, 3]
            if 0 <= row < n_rows and 0 <= col < n_cols:
                hazards[row, col] = carried[i]
    return hazards
