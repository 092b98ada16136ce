"""A target as a picture: the lattice as it stands in the atom plane."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from labseq.drawing.paint import MarkerStyle
from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.sheet import MARGIN, place_sites
from labseq.model import SiteGrid, TargetPattern

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 100
SITE_IN: Final = 0.18
"""Distance between neighbours in a picture of :func:`save_target`, in inches."""

FILL_LOOK: Final = MarkerStyle("atom", "o", 0.76, "#1b5e8c", "#1b5e8c")
CLEAR_LOOK: Final = MarkerStyle("must be empty", "o", 0.34, "white", "0.78")
OTHER_LOOK: Final = MarkerStyle("reservoir", "o", 0.16, "0.6", "0.6")


def draw_target(axes: Axes, target: TargetPattern, grid: SiteGrid, site_in: float = SITE_IN) -> None:
    """Draw a target: atoms filled, sites that must be empty as rings, the reservoir as dots.

    Args:
        axes: Where; gets limits that show the whole grid, and no axes.
        target: What the array shall look like.
        grid: The grid that it lies on.
        site_in: Distance between neighbours in the finished picture, in inches.

    Raises:
        ValueError: Target and grid differ in shape.
    """
    if target.shape != grid.shape:
        raise ValueError(f"the target has {target.shape} sites and the grid {grid.shape}; expected the same")
    for look, here in (
        (OTHER_LOOK, ~target.fill & ~target.clear),
        (CLEAR_LOOK, target.clear),
        (FILL_LOOK, target.fill),
    ):
        x, y = place_sites(np.argwhere(here), grid).T
        axes.plot(x, y, **look.keywords(site_in))
    left, right, top, bottom = _extent(grid)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_axis_off()


def save_target(path: Path, target: TargetPattern, grid: SiteGrid) -> None:
    """Save a target as a PNG, with the target's name and :func:`target_text` in its text chunks.

    Args:
        path: The file.
        target: What the array shall look like.
        grid: The grid that it lies on.

    Raises:
        ConfigError: The file cannot be written.
    """
    told = {"Title": target.name, "Description": target_text(target), "Software": None}
    save_figure(path, lambda: _draw(target, grid), dpi=DPI, metadata=told, pil_kwargs={"optimize": True})


def _draw(target: TargetPattern, grid: SiteGrid) -> Figure:
    left, right, top, bottom = _extent(grid)
    figure = make_figure((right - left) * SITE_IN, (bottom - top) * SITE_IN)
    draw_target(figure.add_axes((0.0, 0.0, 1.0, 1.0)), target, grid)
    return figure


def target_text(target: TargetPattern) -> str:
    r"""A target as text, one line per row: "#" an atom, "o" must be empty, "." reservoir.

    Example:
        >>> fill = np.array([[True, False, False]])
        >>> target_text(TargetPattern(fill, np.array([[False, True, False]])))
        '#o.'
    """
    signs = np.where(target.fill, "#", np.where(target.clear, "o", "."))
    return "\n".join("".join(row) for row in signs)


def _extent(grid: SiteGrid) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of the grid with a margin, in units of the spacing."""
    corners = np.array([[row, col] for row in (0, grid.n_rows - 1) for col in (0, grid.n_cols - 1)])
    places = place_sites(corners, grid)
    (left, top), (right, bottom) = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    return float(left), float(right), float(top), float(bottom)
