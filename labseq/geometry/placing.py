"""Put a pattern onto the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError


def place(
    mask: NDArray[np.bool_], grid_shape: tuple[int, int], origin: tuple[int, int] | None = None
) -> NDArray[np.bool_]:
    """Put a small mask onto the grid.

    Args:
        mask: bool (rows, cols).
        grid_shape: (n_rows, n_cols) of the grid.
        origin: (row, col) of the mask's top left site; None centres it. If the
            free rows or columns cannot be shared evenly, the mask sits one site
            nearer to the top and to the left.

    Returns:
        bool (n_rows, n_cols), False outside of the mask.

    Raises:
        LimitError: The mask is larger than the grid or sticks out of it.

    Example:
        >>> place(np.ones((1, 2), np.bool_), (1, 5)).astype(int).tolist()
        [[0, 1, 1, 0, 0]]
        >>> place(np.ones((1, 2), np.bool_), (1, 5), origin=(0, 3)).astype(int).tolist()
        [[0, 0, 0, 1, 1]]
    """
    rows, cols = mask.shape
    n_rows, n_cols = grid_shape
    if rows > n_rows or cols > n_cols:
        raise LimitError(
            "the size of the target",
            f"{rows} rows x {cols} columns",
            f"the grid of {n_rows} rows x {n_cols} columns",
            "choose a smaller target, or a profile with a larger grid",
        )
    last_row, last_col = n_rows - rows, n_cols - cols
    row, col = (last_row // 2, last_col // 2) if origin is None else origin
    if not (0 <= row <= last_row and 0 <= col <= last_col):
        raise LimitError(
            f"the origin of a target of {rows} rows x {cols} columns",
            f"row {row}, column {col}",
            f"rows 0 to {last_row} and columns 0 to {last_col} on a grid of {n_rows} x {n_cols}",
            "move the origin, or leave it out to centre the target",
        )
    placed = np.zeros(grid_shape, np.bool_)
    placed[row : row + rows, col : col + cols] = mask
    return placed
