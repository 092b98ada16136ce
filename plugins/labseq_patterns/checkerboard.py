"""Checkerboard: every other site."""

from __future__ import annotations

from labseq.plugin import SiteGrid, TargetPattern, block, pattern
from labseq_patterns.settings import BlockSettings


def checkerboard(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """Every other site of each row and column, the top left one included.

    On a square grid that is a square lattice of sqrt(2) times the spacing, turned
    by 45 degrees. A triangular lattice has no checkerboard: there the sites of each
    diagonal line stay together, and lines with and without atoms take turns.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or sticks out of it.

    Example:
        >>> grid = SiteGrid(2, 3, lattice="square")
        >>> checkerboard(BlockSettings(rows=2, cols=3), grid).fill.astype(int).tolist()
        [[1, 0, 1], [0, 1, 0]]
    """
    row, col = block(settings.rows, settings.cols, grid.shape)
    name = f"checkerboard {settings.rows} x {settings.cols}"
    mask = (row + col) % 2 == 0
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)
