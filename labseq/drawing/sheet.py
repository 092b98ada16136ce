"""How large panels are, and where they stand on the sheet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import Plan, SiteGrid

PANEL_IN: Final = 4.4
"""Width of a panel, in inches, as long as its sites are neither too small nor too large in it."""
SITE_IN: Final = (0.05, 0.3)
"""Least and largest distance between neighbours, in inches."""
MARGIN: Final = 1.4
"""Room around the outermost sites and landing places, in units of the spacing."""
TITLE_IN: Final = 0.3
"""Room above each panel for its title, in inches."""
HEAD_IN: Final = 0.9
"""Room at the top of the sheet for its title and key, in inches."""
MIN_WIDTH_IN: Final = 9.0
"""So wide are a sheet's title and key."""


@dataclass(frozen=True, slots=True)
class Extent:
    """The part of the lattice that a panel shows, in units of the spacing, y down the image."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def width(self) -> float:
        """Its width."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Its height."""
        return self.bottom - self.top


@dataclass(frozen=True, slots=True)
class Sheet:
    """The sheet.

    Attributes:
        n_cols: Panels beside one another.
        n_rows: Panels below one another.
        site_in: Distance between neighbours, in inches.
        width_in: Width, in inches.
        height_in: Height, in inches.
        extent: What each panel shows.
    """

    n_cols: int
    n_rows: int
    site_in: float
    width_in: float
    height_in: float
    extent: Extent

    def place(self, index: int) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of a panel, in fractions of the sheet."""
        row, col = divmod(index, self.n_cols)
        width, height = self.extent.width * self.site_in, self.extent.height * self.site_in
        aside = (self.width_in - self.n_cols * width) / 2
        left = aside + col * width
        below = self.height_in - HEAD_IN - (row + 1) * (height + TITLE_IN)
        return (
            left / self.width_in,
            below / self.height_in,
            width / self.width_in,
            height / self.height_in,
        )


def place_sites(sites: NDArray[np.generic], grid: SiteGrid) -> NDArray[np.float64]:
    """Where sites are, on the grid or off it.

    Args:
        sites: (..., 2), row and column.
        grid: The grid of sites.

    Returns:
        float64 (..., 2), x and y in units of the spacing, from the site (0, 0); y down the image.

    Example:
        >>> place_sites(np.array([[0, 3], [2, -1]]), SiteGrid(lattice="square")).tolist()
        [[3.0, 0.0], [-1.0, 2.0]]
    """
    axes = grid.axes / grid.spacing_m
    return sites[..., 1:] * axes[0] + sites[..., :1] * axes[1]


def extent_of(plan: Plan, grid: SiteGrid) -> Extent:
    """What has to be seen of a plan: all sites, and where atoms are ejected to."""
    return extent_of_sites(plan.moves[:, 2:], grid)


def extent_of_sites(others: NDArray[np.integer], grid: SiteGrid) -> Extent:
    """What has to be seen: all sites of the grid, and others, int (n, 2), that may lie beside it."""
    rows, cols = np.mgrid[: grid.n_rows : max(1, grid.n_rows - 1), : grid.n_cols : max(1, grid.n_cols - 1)]
    corners = np.stack([rows.ravel(), cols.ravel()], axis=1)
    places = place_sites(np.concatenate([corners, others]), grid)
    (left, top), (right, bottom) = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    return Extent(float(left), float(right), float(top), float(bottom))


def lay_out(extent: Extent, n_panels: int, panel_in: float = PANEL_IN) -> Sheet:
    """Choose the size of the panels, and how many stand side by side.

    The sheet shall be somewhat wider than high, and few of its places empty.

    Args:
        extent: What each panel shows.
        n_panels: How many there are.
        panel_in: Width of a panel, in inches, as long as its sites are neither too small nor too large in it.

    Example:
        >>> sheet = lay_out(Extent(-1, 11, -1, 11), 6)
        >>> sheet.n_cols, sheet.n_rows, sheet.site_in
        (3, 2, 0.3)
    """
    site_in = min(max(panel_in / extent.width, SITE_IN[0]), SITE_IN[1])
    width, height = extent.width * site_in, extent.height * site_in + TITLE_IN

    def size(n_cols: int) -> tuple[float, float]:
        return n_cols * width, math.ceil(n_panels / n_cols) * height + HEAD_IN

    def fault(n_cols: int) -> float:
        across, down = size(n_cols)
        return abs(math.log(across / down / 1.5)) + 1.5 * (-n_panels % n_cols) / n_panels

    n_cols = min(range(1, n_panels + 1), key=fault)
    across, down = size(n_cols)
    n_rows = math.ceil(n_panels / n_cols)
    return Sheet(n_cols, n_rows, site_in, max(across, MIN_WIDTH_IN), down, extent)
