"""Rings."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from labseq.plugin import SiteGrid, TargetPattern, block, pattern
from labseq_patterns.settings import RingSettings

_ROUNDING: Final = 1e-9


def ring(settings: RingSettings, grid: SiteGrid) -> TargetPattern:
    """The sites between two circles about the middle of the block, on any grid.

    Sites on the outer circle belong to the ring, those on the inner one do not: on
    a triangular grid ``radius: 1, width: 1`` is a hexagon of 6 atoms. With ``rows``
    and ``cols`` the outer circle is the largest one within the block's outermost
    lines of sites; with ``radius`` the block is the smallest with a site in its
    middle that holds the circle.

    Args:
        settings: Size and place.
        grid: Any grid.

    Raises:
        LimitError: The block is larger than the grid or sticks out of it.

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
