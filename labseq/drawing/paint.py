"""What is painted into a panel: sites, atoms and arrows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.arrows import heights, hops, lanes
from labseq.drawing.batches import on_grid
from labseq.drawing.sheet import Sheet, place_sites
from labseq.model import Occupancy, SiteGrid, TargetPattern

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS_PER_INCH: Final = 72
ATOM, SURPLUS, RESERVOIR = "0.45", "#86c5ea", "0.80"
DEFECT, RING, DOT, BAND = "#c8102e", "0.45", "0.82", "#dff0e0"


@dataclass(frozen=True, slots=True)
class MarkerStyle:
    """A marker and how it is painted.

    Attributes:
        label: What it stands for, in the key.
        marker: matplotlib's name of the shape.
        size: Diameter, in units of the spacing.
        face: Colour inside; "none" for a ring.
        edge: Colour of the rim.
    """

    label: str
    marker: str
    size: float
    face: str
    edge: str

    def keywords(self, site_in: float) -> dict[str, Any]:
        """How matplotlib is told, for neighbours so far apart."""
        points = site_in * POINTS_PER_INCH
        return {
            "linestyle": "none",
            "marker": self.marker,
            "markersize": self.size * points,
            "markerfacecolor": self.face,
            "markeredgecolor": self.edge,
            "markeredgewidth": min(1.0, 0.07 * points),
        }


ATOM_LOOK: Final = MarkerStyle("atom on a target site", "o", 0.62, ATOM, ATOM)
DEFECT_LOOK: Final = MarkerStyle("empty target site", "o", 0.62, "white", RING)
SURPLUS_LOOK: Final = MarkerStyle("surplus atom", "o", 0.5, SURPLUS, SURPLUS)
RESERVOIR_LOOK: Final = MarkerStyle("atom in the reservoir", "o", 0.5, RESERVOIR, RESERVOIR)
EMPTY_LOOK: Final = MarkerStyle("empty site", "o", 0.14, DOT, DOT)
MISSING_LOOK: Final = MarkerStyle("target site that stays empty", "o", 0.62, "white", DEFECT)
EJECTED_LOOK: Final = MarkerStyle("ejected", "X", 0.55, DEFECT, DEFECT)


def paint_sites(
    axes: Axes, sheet: Sheet, grid: SiteGrid, occupancy: Occupancy, target: TargetPattern, *, final: bool
) -> list[MarkerStyle]:
    """Paint every site as what it is.

    Args:
        axes: The panel.
        sheet: Its size.
        grid: The grid of sites.
        occupancy: bool (n_rows, n_cols).
        target: What the array shall look like.
        final: Whether target sites that are empty now stay so.

    Returns:
        The looks that occur, in the order of the key.
    """
    wanted, unwanted = target.fill, target.clear
    layers = (
        (EMPTY_LOOK, ~occupancy & ~wanted),
        (MISSING_LOOK if final else DEFECT_LOOK, ~occupancy & wanted),
        (RESERVOIR_LOOK, occupancy & ~wanted & ~unwanted),
        (SURPLUS_LOOK, occupancy & unwanted),
        (ATOM_LOOK, occupancy & wanted),
    )
    painted: list[MarkerStyle] = []
    for look, here in layers:
        if here.any():
            x, y = place_sites(np.argwhere(here), grid).T
            axes.plot(x, y, **look.keywords(sheet.site_in), zorder=1)
            painted.append(look)
    return painted


def paint_moves(axes: Axes, sheet: Sheet, grid: SiteGrid, moves: NDArray[np.int16], colours: Any) -> None:
    """Paint atom moves as arrows, with a cross where an atom is ejected.

    Args:
        axes: The panel.
        sheet: Its size.
        grid: The grid of sites.
        moves: int16 (n, 4), from row, from column, to row, to column.
        colours: One per move, as matplotlib takes them.
    """
    from matplotlib.collections import LineCollection, PolyCollection

    start, end = place_sites(moves[:, :2], grid), place_sites(moves[:, 2:], grid)
    shafts, heads = hops(start, end, heights(lanes(moves)))
    points = sheet.site_in * POINTS_PER_INCH
    thick = min(1.5, 0.11 * points)
    rings: dict[str, Any] = {"s": (0.62 * points) ** 2, "facecolors": "none", "linewidths": thick}
    axes.scatter(start[:, 0], start[:, 1], edgecolors=colours, zorder=2, **rings)
    lost = ~on_grid(moves[:, 2:], grid.shape)
    axes.plot(end[lost, 0], end[lost, 1], **EJECTED_LOOK.keywords(sheet.site_in), zorder=2)
    axes.add_collection(LineCollection(list(shafts), colors=colours, linewidths=thick, zorder=3))
    axes.add_collection(PolyCollection(list(heads), facecolors=colours, linewidths=0, zorder=4))


def paint_lines(axes: Axes, sheet: Sheet, grid: SiteGrid, moves: NDArray[np.int16]) -> None:
    """Lay a pale band along each row and column that atoms move along."""
    thick = 0.8 * sheet.site_in * POINTS_PER_INCH
    n_rows, n_cols = grid.shape
    along_column = moves[:, 0] != moves[:, 2]
    rows, cols = np.unique(moves[~along_column, 0]), np.unique(moves[along_column, 1])
    ends = [[(row, -0.1), (row, n_cols - 0.9)] for row in rows] + [
        [(-0.1, col), (n_rows - 0.9, col)] for col in cols
    ]
    for pair in ends:
        x, y = place_sites(np.array(pair), grid).T
        axes.plot(x, y, color=BAND, linewidth=thick, solid_capstyle="round", zorder=0.5)


def paint_numbers(axes: Axes, grid: SiteGrid, colour: str = "0.4") -> None:
    """Number rows on the left and columns at the top, every one or every fifth."""
    rows = [(row, -1, row) for row in range(0, grid.n_rows, 1 if grid.n_rows < 10 else 5)]
    cols = [(-1, col, col) for col in range(0, grid.n_cols, 1 if grid.n_cols < 10 else 5)]
    for row, col, number in rows + cols:
        x, y = place_sites(np.array([row, col]), grid)
        axes.text(x, y, str(number), fontsize=6, color=colour, ha="center", va="center")


def frame(axes: Axes, sheet: Sheet, title: str, edge: NDArray[np.float64]) -> None:
    """Set a panel's limits and title, and draw a thin line around the array.

    Args:
        axes: The panel.
        sheet: Its size.
        title: What stands above it.
        edge: float64 (n, 2), corners of the array.
    """
    extent = sheet.extent
    axes.set_xlim(extent.left, extent.right)
    axes.set_ylim(extent.bottom, extent.top)
    axes.set_axis_off()
    axes.set_title(title, fontsize=8, pad=2, y=1.0)  # a fixed y spares matplotlib a search
    closed = np.concatenate([edge, edge[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color="0.88", linewidth=0.6, zorder=0)
