"""What the lattices that dilute a triangular one have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ConfigError, Problem, SiteGrid, TargetPattern, block, pattern
from labseq_patterns.settings import BlockSettings

Ints: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]


def diluted(
    name: str, settings: BlockSettings, grid: SiteGrid, keep: Callable[[Ints, Ints], Mask]
) -> TargetPattern:
    """A block of a triangular lattice, of which only some sites hold atoms.

    Args:
        name: Name of the pattern.
        settings: Size and place.
        grid: A triangular grid.
        keep: Says of the sites' rows and columns, counted from the block's top left site, which of
            them hold an atom.

    Raises:
        ConfigError: The grid is square.
        LimitError: The block is larger than the grid or sticks out of it.
    """
    need_triangular(grid, name)
    mask = as_sheared(keep(*block(settings.rows, settings.cols, grid.shape)), grid)
    title = f"{name.replace('_', '-')} {settings.rows} x {settings.cols}"
    return pattern(mask, grid, origin=settings.origin, clear=settings.clear, name=title)


def need_triangular(grid: SiteGrid, name: str) -> None:
    """Refuse a square grid, on which the pattern would be another lattice.

    Raises:
        ConfigError: The grid is square.
    """
    if grid.lattice != "triangular":
        raise ConfigError(
            Problem(
                f"the pattern '{name}' dilutes a triangular lattice, and the grid is {grid.lattice}",
                expected="a profile with 'lattice: triangular'",
                hint="draw what you mean with the pattern 'bitmap'",
            )
        )


def as_sheared(mask: Mask, grid: SiteGrid) -> Mask:
    """A mask made for ``shear: +1``, mirrored left to right on a grid with ``shear: -1``.

    So the array of atoms is the mirror image too.
    """
    return mask if grid.shear > 0 else mask[:, ::-1]
