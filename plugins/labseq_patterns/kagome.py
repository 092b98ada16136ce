"""Kagome and link-kagome: corner-sharing triangles, and the atoms on their edges."""

from __future__ import annotations

from labseq.plugin import SiteGrid, TargetPattern
from labseq_patterns.settings import BlockSettings
from labseq_patterns.triangular import Ints, Mask, diluted


def kagome(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """The kagome lattice: a quarter of the triangular lattice's sites is left out.

    The unit cell is 2 x 2 sites with 3 atoms; in the bulk each atom has 4 nearest
    neighbours. Left out are the odd rows' odd sites, counted from 0 at the top
    left (at the top right with ``shear: -1``): the block's edges are full lines.

    Args:
        settings: Size and place.
        grid: A triangular grid.

    Raises:
        ConfigError: The grid is square.
        LimitError: The block is larger than the grid or sticks out of it.

    Example:
        >>> kagome(BlockSettings(rows=3, cols=3), SiteGrid(3, 3)).fill.astype(int).tolist()
        [[1, 1, 1], [1, 0, 1], [1, 1, 1]]
    """
    return diluted("kagome", settings, grid, lambda row, col: (row % 2 == 0) | (col % 2 == 0))


def link_kagome(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """One atom on every link of a kagome lattice, also called ruby lattice.

    The sites of even row and even column make a triangular lattice of twice the
    spacing; with every fourth of them left out it is a kagome lattice. Atoms sit
    halfway between its neighbours, so a block of (2 m - 1) x (2 n - 1) sites holds
    the links of m x n sites of the pattern ``kagome``. The unit cell is 4 x 4 sites
    with 6 atoms. In the bulk each atom has 2 neighbours at one spacing a (the
    triangles of the kagome lattice), 2 at sqrt(3) a and 2 at 2 a: the six other
    links at the ends of its link, as in Semeghini et al., "Probing topological
    spin liquids on a programmable quantum simulator", Science 374, 1242 (2021).

    Args:
        settings: Size and place.
        grid: A triangular grid.

    Raises:
        ConfigError: The grid is square.
        LimitError: The block is larger than the grid or sticks out of it.

    Example:
        >>> target = link_kagome(BlockSettings(rows=3, cols=4), SiteGrid(3, 4))
        >>> target.fill.astype(int).tolist()
        [[0, 1, 0, 1], [1, 1, 0, 0], [0, 0, 0, 0]]
    """
    return diluted("link_kagome", settings, grid, _is_on_a_link)


def _is_on_a_link(row: Ints, col: Ints) -> Mask:
    """Both ends of a link are kagome sites: not both of their coordinates, halved, are odd."""
    odd_row, odd_col = row % 2 == 1, col % 2 == 1
    along_row = (row % 4 == 0) & odd_col
    along_column = odd_row & (col % 4 == 0)
    along_diagonal = odd_row & odd_col & ((row + col) % 4 == 2)
    return along_row | along_column | along_diagonal
