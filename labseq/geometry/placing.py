"""Put a pattern onto the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError


def check_size(shape: tuple[int, int], grid_shape: tuple[int, int]) -> None:
    """Refuse a target that is larger than the grid, before anything of its size is made.

    Args:
        shape: (rows, cols) of the target's block.
        grid_shape: (n_rows, n_cols) of the grid.

    Raises:
        LimitError: The block has more rows or more columns than the grid.
    """
    rows, cols = shape
    n_rows, n_cols = grid_shape
    if rows > n_rows or cols > n_cols:
        raise LimitError(
            "the size of the target",
            f"{rows} rows x {cols} columns",
            f"the grid of {n_rows} rows x {n_cols} columns",
            "choose a smaller target, or a profile with a larger grid",
        )


def block(rows: int, cols: int, grid_shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of every site of a block: what the rule of a pattern is written in.

    Args:
        rows: Rows of the block.
        cols: Columns of the block.
        grid_shape: (n_rows, n_cols) of the grid, which must be able to hold it.

    Returns:
        int64 (rows, cols) each, from 0 at the block's top left site.

    Raises:
        LimitError: The block is larger than the grid.

    Example:
        >>> row, col = block(2, 3, (20, 20))
        >>> ((row + col) % 2).tolist()
        [[0, 1, 0], [1, 0, 1]]
    """
    check_size((rows, cols), grid_shape)
    row, col = np.indices((rows, cols), np.int64)
    return row, col


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
    check_size(mask.shape, grid_shape)
    rows, cols = mask.shape
    n_rows, n_cols = grid_shape
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
