"""Honeycomb: hexagons without their centres."""

from __future__ import annotations

from labseq.plugin import SiteGrid, TargetPattern
from labseq_patterns.settings import BlockSettings
from labseq_patterns.triangular import diluted


def honeycomb(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """The honeycomb lattice: a third of the triangular lattice's sites is left out.

    The three sublattices of the triangular lattice are row - column modulo 3; left
    out is the one of the block's top left site (its top right site with
    ``shear: -1``). In a block with as many rows as columns the two acute corners
    are empty; if that number is 3 n or 3 n + 1, no atom hangs on by a single
    neighbour. In the bulk each atom has 3 nearest neighbours.

    Args:
        settings: Size and place.
        grid: A triangular grid.

    Raises:
        ConfigError: The grid is square.
        LimitError: The block is larger than the grid or sticks out of it.

    Example:
        >>> honeycomb(BlockSettings(rows=3, cols=3), SiteGrid(3, 3)).fill.astype(int).tolist()
        [[0, 1, 1], [1, 0, 1], [1, 1, 0]]
    """
    return diluted("honeycomb", settings, grid, lambda row, col: (row - col) % 3 != 0)
