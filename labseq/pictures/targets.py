"""Draws targets, and writes them as text."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from labseq.model import SiteGrid, TargetPattern
from labseq.pictures.figures import MarkerStyle, extent_of_sites, make_figure, place_sites, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 100
SITE_IN: Final = 0.18
"""Distance between neighbours in a picture of :func:`save_target`, in inches."""

FILL_LOOK: Final = MarkerStyle("atom", "o", 0.76, "#1b5e8c", "#1b5e8c")


def draw_target(axes: Axes, target: TargetPattern, grid: SiteGrid, site_in: float = SITE_IN) -> None:
    """Draw a target with filled atoms, rings for sites that must be empty, and dots for the reservoir.

    Args:
        axes: Axes to draw on. Their limits show the whole grid, and their frame is hidden.
        grid: The grid of the target.
        site_in: Distance between neighbours in the finished picture, in inches.

    Raises:
        ValueError: Target and grid differ in shape.
    """
    if target.shape != grid.shape:
        raise ValueError(f"the target has {target.shape} sites but the grid {grid.shape}; expected the same")
    for look, sites in (
        (MarkerStyle("reservoir", "o", 0.16, "0.6", "0.6"), ~target.fill & ~target.clear),
        (MarkerStyle("must be empty", "o", 0.34, "white", "0.78"), target.clear),
        (FILL_LOOK, target.fill),
    ):
        x, y = place_sites(np.argwhere(sites), grid).T
        axes.plot(x, y, **look.keywords(site_in))
    extent = extent_of_sites(np.empty((0, 2), np.int64), grid)
    axes.set_xlim(extent.left, extent.right)
    axes.set_ylim(extent.bottom, extent.top)
    axes.set_aspect("equal")
    axes.set_axis_off()


def save_target(path: Path, target: TargetPattern, grid: SiteGrid) -> None:
    """Save a target as a PNG, with the target's name and :func:`target_text` in its text chunks.

    Raises:
        ConfigError: The file cannot be written.
    """
    metadata = {"Title": target.name, "Description": target_text(target), "Software": None}

    def draw() -> Figure:
        extent = extent_of_sites(np.empty((0, 2), np.int64), grid)
        figure = make_figure(extent.width * SITE_IN, extent.height * SITE_IN)
        draw_target(figure.add_axes((0.0, 0.0, 1.0, 1.0)), target, grid)
        return figure

    save_figure(path, draw, dpi=DPI, metadata=metadata, pil_kwargs={"optimize": True})


def target_text(target: TargetPattern) -> str:
    r"""A target as text, one line per row, with "#" for an atom, "o" for must be empty, "." for reservoir.

    Example:
        >>> fill = np.array([[True, False, False]])
        >>> target_text(TargetPattern(fill, np.array([[False, True, False]])))
        '#o.'
    """
    signs = np.where(target.fill, "#", np.where(target.clear, "o", "."))
    return "\n".join("".join(row) for row in signs)
