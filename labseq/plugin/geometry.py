"""Blocks of sites of a grid, patterns, and the order of sites from the centre."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import SiteGrid, TargetPattern

__all__ = [
    "block",
    "check_size",
    "from_the_centre",
    "nearest_to_centre",
    "pattern",
]


def from_the_centre(fill: NDArray[np.bool_], grid: SiteGrid) -> NDArray[np.intp]:
    """List fill sites, beginning with the sites nearest to their common centre.

    Distances are measured on the lattice. Among equally distant sites, the order is by row from the top, then
    by column from the left.

    Args:
        fill: bool (n_rows, n_cols).
        grid: The grid, for its lattice.

    Returns:
        int (n_fill,), row * n_cols + column of each, as indices of ``fill.reshape(-1)``.

    Example:
        >>> from_the_centre(np.ones((1, 5), np.bool_), SiteGrid()).tolist()
        [2, 1, 3, 0, 4]
    """
    rows, cols = np.nonzero(fill)
    down = len(rows) * rows - rows.sum()  # from the centre, times the number of sites, exact in integers
    right = len(cols) * cols - cols.sum()
    shear = grid.shear if grid.lattice == "triangular" else 0
    distance = down**2 + right**2 + shear * down * right  # |right a1 + down a2|^2 / a^2
    nearest_first: NDArray[np.intp] = (rows * fill.shape[1] + cols)[np.lexsort((cols, rows, distance))]
    return nearest_first


def nearest_to_centre(fill: NDArray[np.bool_], n_sites: int, grid: SiteGrid) -> NDArray[np.bool_]:
    """Keep the fill sites nearest to their common centre (see :func:`from_the_centre`).

    A planner with only ``n_sites`` atoms fills these sites.

    Args:
        fill: bool (n_rows, n_cols).
        n_sites: Maximum number of sites to keep.
        grid: The grid, for its lattice.

    Returns:
        bool (n_rows, n_cols), ``fill`` itself if it has no more sites.

    Example:
        >>> nearest_to_centre(np.ones((1, 5), np.bool_), 2, SiteGrid()).tolist()
        [[False, True, True, False, False]]
    """
    if np.count_nonzero(fill) <= n_sites:
        return fill
    nearest = np.zeros(fill.shape, np.bool_)
    nearest.reshape(-1)[from_the_centre(fill, grid)[:n_sites]] = True
    return nearest


def check_size(shape: tuple[int, int], grid_shape: tuple[int, int]) -> None:
    """Refuse a target that is larger than the grid, before arrays of its size are made.

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
    """Row and column of every site of a block, for the rule of a pattern.

    Args:
        rows: Rows of the block.
        cols: Columns of the block.
        grid_shape: (n_rows, n_cols) of the grid, which must be large enough.

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
    """Place a small mask on the grid.

    Args:
        mask: bool (rows, cols).
        grid_shape: (n_rows, n_cols) of the grid.
        origin: (row, col) of the mask's top left site. None centres it. With an odd number of free rows or
            columns, the mask is one site nearer to the top or to the left.

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


Origin: TypeAlias = tuple[int, int] | None
"""(row, col) of the pattern's top left site. None centres it."""
Clear: TypeAlias = Literal["bounding_box", "none"]
"""Sites that must be empty: every other site of the pattern's block, or none."""


def pattern(
    mask: NDArray[np.bool_],
    grid: SiteGrid,
    *,
    origin: Origin = None,
    clear: Clear = "bounding_box",
    name: str = "target",
) -> TargetPattern:
    """Make a target from a mask, as the last step of a plugin's pattern.

    Args:
        mask: bool (rows, cols), True where an atom must be.
        grid: The grid that the target lies on.
        origin: (row, col) of the mask's top left site. None centres it as :func:`place` does.
        clear: With "bounding_box" all other sites of the mask's block must be empty. With "none" they are
            reservoir.
        name: Name in records and on the screen.

    Raises:
        LimitError: The mask has no atom, is larger than the grid or sticks out of it.

    Example:
        >>> target = pattern(np.eye(2, dtype=np.bool_), SiteGrid(2, 3), name="diagonal")
        >>> target.clear.astype(int).tolist()
        [[0, 1, 0], [1, 0, 0]]
    """
    if not mask.any():
        raise LimitError(f"the number of atoms of {name}", 0, "at least 1", "choose a larger target")
    fill = place(mask, grid.shape, origin)
    empty = ~mask if clear == "bounding_box" else np.zeros_like(mask)
    return TargetPattern(fill, place(empty, grid.shape, origin), name)
