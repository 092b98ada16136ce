"""Target patterns on the lattice, with their settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Final, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from labseq.plugin import ConfigError, Problem, Settings, SiteGrid, TargetPattern
from labseq.plugin.geometry import block, pattern

Index: TypeAlias = Annotated[int, Field(ge=0)]
"""Index of a row or a column, from 0."""
Origin: TypeAlias = Annotated[
    tuple[Index, Index] | None,
    Field(description="[row, column] of the block's top left site, from 0; centred by default"),
]
Clear: TypeAlias = Annotated[
    Literal["bounding_box", "none"],
    Field(
        description="with 'bounding_box' all other block sites must be empty; with 'none' they are reservoir"
    ),
]


class BlockSettings(Settings):
    """A periodic pattern, cut to a block."""

    rows: int = Field(ge=1, description="rows of the block")
    cols: int = Field(ge=1, description="columns of the block")
    origin: Origin = None
    clear: Clear = "bounding_box"


class SierpinskiSettings(Settings):
    """A Sierpinski triangle, of a whole order or cut to a block.

    Example:
        >>> SierpinskiSettings(order=4).size
        (16, 16)
        >>> SierpinskiSettings(rows=15, cols=15).size
        (15, 15)
    """

    order: Annotated[int, Field(ge=0, le=12)] | None = Field(
        default=None,
        description="number of divisions of the triangle, where order n takes 2^n rows and columns",
    )
    rows: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="rows of the block, counted from the tip, instead of the order"
    )
    cols: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="columns of the block, counted from the tip, instead of the order"
    )
    origin: Origin = None
    clear: Clear = "bounding_box"

    @property
    def size(self) -> tuple[int, int]:
        """(rows, cols) of the block."""
        if self.order is not None:
            return 2**self.order, 2**self.order
        assert self.rows is not None  # see _has_one_size
        assert self.cols is not None
        return self.rows, self.cols

    @model_validator(mode="after")
    def _has_one_size(self) -> Self:
        check_one_size("order", self.order, self.rows, self.cols)
        return self


class RingSettings(Settings):
    """A ring with a given radius, or as large as fits into a block.

    Example:
        >>> RingSettings(radius=6).width
        2.0
    """

    radius: Annotated[float, Field(ge=0, le=10_000)] | None = Field(
        default=None, description="outer radius, in units of the spacing of the sites"
    )
    rows: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="rows of the block that the ring fits into, instead of the radius"
    )
    cols: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="columns of the block that the ring fits into, instead of the radius"
    )
    width: float = Field(
        default=2.0,
        ge=1,
        description="thickness of the ring, in units of the spacing; above the radius it is a full disc",
    )
    origin: Origin = None
    clear: Clear = "bounding_box"

    @model_validator(mode="after")
    def _has_one_size(self) -> Self:
        check_one_size("radius", self.radius, self.rows, self.cols)
        return self


def check_one_size(name: str, value: float | None, rows: int | None, cols: int | None) -> None:
    """Refuse a pattern with no size, half a size or two sizes.

    Args:
        name: Name of the setting that replaces rows and columns.
        value: Its value.
        rows: Rows of the block.
        cols: Columns of the block.

    Raises:
        ValueError: The size is missing or ambiguous. The message says what was expected.
    """
    n_given = (rows is not None) + (cols is not None)
    if n_given == (2 if value is None else 0):
        return
    came = "two sizes are given" if n_given and value is not None else "the size is missing, or half of it"
    raise ValueError(f"{came}; expected either '{name}', or 'rows' and 'cols'")


def checkerboard(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """Every other site of each row and column, including the top left site.

    On a square grid this is a square lattice of sqrt(2) times the spacing, turned by 45 degrees. A triangular
    lattice has no checkerboard. There the sites of each diagonal line stay together, and lines with and
    without atoms alternate.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or extends beyond it.

    Example:
        >>> grid = SiteGrid(2, 3, lattice="square")
        >>> checkerboard(BlockSettings(rows=2, cols=3), grid).fill.astype(int).tolist()
        [[1, 0, 1], [0, 1, 0]]
    """
    row, col = block(settings.rows, settings.cols, grid.shape)
    name = f"checkerboard {settings.rows} x {settings.cols}"
    mask = (row + col) % 2 == 0
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)


Ints: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]


def diluted(
    name: str, settings: BlockSettings, grid: SiteGrid, keep: Callable[[Ints, Ints], Mask]
) -> TargetPattern:
    """A block of a triangular lattice in which only some sites hold atoms.

    Args:
        name: Name of the pattern.
        settings: Size and place.
        grid: A triangular grid.
        keep: Takes the sites' rows and columns, counted from the block's top left site, and says which hold
            an atom.

    Raises:
        ConfigError: The grid is square.
        LimitError: The block is larger than the grid or extends beyond it.
    """
    if grid.lattice != "triangular":  # it would be another lattice on a square grid
        raise ConfigError(
            Problem(
                f"the pattern '{name}' dilutes a triangular lattice, but the grid is {grid.lattice}",
                expected="a profile with 'lattice: triangular'",
                hint="draw your target with the pattern 'bitmap'",
            )
        )
    mask = keep(*block(settings.rows, settings.cols, grid.shape))
    if grid.shear < 0:  # then the array of atoms is also the mirror image
        mask = mask[:, ::-1]
    title = f"{name.replace('_', '-')} {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=title)


def honeycomb(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """The honeycomb lattice, which leaves out a third of the triangular lattice's sites.

    The three sublattices of the triangular lattice are row - column modulo 3. The sublattice of the block's
    top left site is left out (its top right site with ``shear: -1``). In a block with as many rows as columns
    the two acute corners are empty. If that number is 3 n or 3 n + 1, each atom has more than a single
    neighbour. In the bulk each atom has 3 nearest neighbours.

    Arguments and errors are as for :func:`diluted`.

    Example:
        >>> honeycomb(BlockSettings(rows=3, cols=3), SiteGrid(3, 3)).fill.astype(int).tolist()
        [[0, 1, 1], [1, 0, 1], [1, 1, 0]]
    """
    return diluted("honeycomb", settings, grid, lambda row, col: (row - col) % 3 != 0)


def kagome(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """The kagome lattice, which leaves out a quarter of the triangular lattice's sites.

    The unit cell is 2 x 2 sites with 3 atoms. In the bulk each atom has 4 nearest neighbours. The odd sites
    of odd rows are left out, counted from 0 at the top left (at the top right with ``shear: -1``), so the
    block's edges are full lines.

    Arguments and errors are as for :func:`diluted`.

    Example:
        >>> kagome(BlockSettings(rows=3, cols=3), SiteGrid(3, 3)).fill.astype(int).tolist()
        [[1, 1, 1], [1, 0, 1], [1, 1, 1]]
    """
    return diluted("kagome", settings, grid, lambda row, col: (row % 2 == 0) | (col % 2 == 0))


def link_kagome(settings: BlockSettings, grid: SiteGrid) -> TargetPattern:
    """One atom on every link of a kagome lattice, also called ruby lattice.

    The sites of even row and even column make a triangular lattice of twice the spacing. Without every fourth
    of these it is a kagome lattice. Atoms sit halfway between its neighbours, so a block of (2 m - 1) x (2 n
    - 1) sites holds the links of m x n sites of the pattern ``kagome``. The unit cell is 4 x 4 sites with 6
    atoms. In the bulk each atom has 2 neighbours at one spacing a (the triangles of the kagome lattice), 2 at
    sqrt(3) a and 2 at 2 a. These are the six other links at the ends of its link, as in Semeghini et al.,
    "Probing topological spin liquids on a programmable quantum simulator", Science 374, 1242 (2021).

    Arguments and errors are as for :func:`diluted`.

    Example:
        >>> target = link_kagome(BlockSettings(rows=3, cols=4), SiteGrid(3, 4))
        >>> target.fill.astype(int).tolist()
        [[0, 1, 0, 1], [1, 1, 0, 0], [0, 0, 0, 0]]
    """
    return diluted("link_kagome", settings, grid, _is_on_a_link)


def _is_on_a_link(row: Ints, col: Ints) -> Mask:
    """True if both ends are kagome sites, which do not have two odd coordinates after halving."""
    odd_row, odd_col = row % 2 == 1, col % 2 == 1
    along_row = (row % 4 == 0) & odd_col
    along_column = odd_row & (col % 4 == 0)
    along_diagonal = odd_row & odd_col & ((row + col) % 4 == 2)
    return along_row | along_column | along_diagonal


_ROUNDING: Final = 1e-9


def ring(settings: RingSettings, grid: SiteGrid) -> TargetPattern:
    """The sites between two circles about the middle of the block, on any grid.

    Sites on the outer circle belong to the ring, but not sites on the inner circle, so on a triangular grid
    ``radius: 1, width: 1`` is a hexagon of 6 atoms. With ``rows`` and ``cols`` the outer circle is the
    largest circle within the block's outermost lines of sites. With ``radius`` the block is the smallest with
    a site in its middle that contains the circle.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or extends beyond it.

    Example:
        >>> target = ring(RingSettings(radius=1, width=1), SiteGrid(3, 3))
        >>> target.fill.astype(int).tolist()
        [[0, 1, 1], [1, 0, 1], [1, 1, 0]]
    """
    triangular = grid.lattice == "triangular"
    line_distance = math.sqrt(3) / 2 if triangular else 1.0
    if settings.radius is not None:
        radius = settings.radius
        rows = cols = 2 * math.floor(radius / line_distance + _ROUNDING) + 1
    else:
        assert settings.rows is not None  # see RingSettings
        assert settings.cols is not None
        rows, cols = settings.rows, settings.cols
        radius = (min(rows, cols) - 1) / 2 * line_distance
    row, col = block(rows, cols, grid.shape)
    down, right = row - (rows - 1) / 2, col - (cols - 1) / 2
    skew = grid.shear * down * right if triangular else 0.0
    distance = np.sqrt(down**2 + right**2 + skew)  # |right a1 + down a2| / a
    inner = radius - settings.width
    mask = (distance <= radius + _ROUNDING) & (distance > inner + _ROUNDING)
    name = f"ring {rows} x {cols}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=name)


def sierpinski(settings: SierpinskiSettings, grid: SiteGrid) -> TargetPattern:
    """The odd numbers of Pascal's triangle, tip up, with 3^n atoms in 2^n rows.

    On a triangular grid the triangle is equilateral. Its tip is the block's top right site (top left with
    ``shear: -1``), and its base is the whole lowest row. On a square grid it has a right angle at the lower
    left, below its tip. A block that is not a power of two is a larger triangle, cut below or at the side
    away from the tip.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or extends beyond it.

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
