"""The Sierpinski triangle."""

from __future__ import annotations

from labseq.plugin import SiteGrid, TargetPattern, block, pattern
from labseq_patterns.settings import SierpinskiSettings


def sierpinski(settings: SierpinskiSettings, grid: SiteGrid) -> TargetPattern:
    """The odd numbers of Pascal's triangle, tip up: 3^n atoms in 2^n rows.

    On a triangular grid the triangle is equilateral: its tip is the block's top
    right site (the top left one with ``shear: -1``), its base the whole lowest row.
    On a square grid it has a right angle at the lower left, below its tip. A block
    that is no power of two is a larger triangle, cut below or at the side away
    from the tip.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or sticks out of it.

    Example:
        >>> grid = SiteGrid(4, 4, shear=-1)
        >>> sierpinski(SierpinskiSettings(order=2), grid).fill.astype(int).tolist()
        [[1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 1]]
    """
    rows, cols = settings.size
    row, col = block(rows, cols, grid.shape)
    # Lucas' theorem: the binomial coefficient is odd if no digit of `col` exceeds that of `row`.
    mask = (col & ~row) == 0
    if grid.lattice == "triangular" and grid.shear > 0:
        mask = mask[:, ::-1]
    name = f"sierpinski {rows} x {cols}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)
