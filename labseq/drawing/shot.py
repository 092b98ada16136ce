"""A shot as a picture: its frames, what was seen on them, and the moves that followed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.batches import on_grid
from labseq.drawing.cells import outline
from labseq.drawing.paint import (
    ATOM_LOOK,
    DEFECT_LOOK,
    EJECTED_LOOK,
    EMPTY_LOOK,
    RESERVOIR_LOOK,
    SURPLUS_LOOK,
    MarkerStyle,
    frame,
    paint_moves,
    paint_numbers,
    paint_sites,
)
from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.sheet import PANEL_IN, Sheet, extent_of_sites, lay_out, place_sites
from labseq.model import Occupancy, SiteGrid, TargetPattern

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Moves = NDArray[np.int16]

DPI: Final = 150
LARGE_IN: Final = 6.5
"""Width of a panel where there are two at most, in inches."""
ON_FRAME: Final = (
    MarkerStyle("atom on a target site", "o", 0.86, "none", "#56b4e9"),
    MarkerStyle("empty target site", "o", 0.86, "none", "#ff7f0e"),
    MarkerStyle("surplus atom", "s", 0.8, "none", "#f0e442"),
    MarkerStyle("atom in the reservoir", "o", 0.86, "none", "0.62"),
)
"""Rings around sites, in the colours of Okabe and Ito, that stand out from grey for all eyes."""
OUTLINE: Final = "#c8102e"
OUTLINE_LABEL: Final = "border of the target"
COLOURS: Final = ("plasma", 0.25, 0.95)
"""Colour map of the order of batches, and the part of it that can be seen on black and on white."""
RIM_PT: Final = 6
"""White rim of a frame, which keeps it apart from others; half of it is seen."""
RANGE: Final = (0.01, 0.998)
"""Quantiles of the pixels that are shown black and white."""


@dataclass(frozen=True, slots=True, eq=False)
class ShotPanel:
    """An image, and what was moved next.

    Attributes:
        title: Stands above it.
        occupancy: bool (n_rows, n_cols), as detected.
        image: uint16 (height, width); None if the frame was not kept.
        moves: int16 (n, 4), the atom moves that followed: from row, from column, to row, to column.
        batch: int64 (n,), the batch of each, from 0.
    """

    title: str
    occupancy: Occupancy
    image: NDArray[np.uint16] | None
    moves: Moves
    batch: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ShotDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        grid: The grid of sites.
        target: What the array shall look like.
        sites_px: float64 (n_rows, n_cols, 2), (y, x) of each site on the frames; None if that is not known:
            then no frames are shown.
        panels: The images, in order; at least one.
    """

    title: str
    note: str
    grid: SiteGrid
    target: TargetPattern
    sites_px: Floats | None
    panels: tuple[ShotPanel, ...]


def save_shot(path: Path, drawing: ShotDrawing) -> None:
    """Draw the images of a shot, each laid under the lattice.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: ShotDrawing) -> Figure:
    grid, panels = drawing.grid, drawing.panels
    moved = np.concatenate([panel.moves for panel in panels])
    panel_in = PANEL_IN if len(panels) > 2 else LARGE_IN
    sheet = lay_out(extent_of_sites(moved[:, 2:], grid), len(panels), panel_in)
    figure = make_figure(sheet.width_in, sheet.height_in)
    n_rows, n_cols = grid.shape
    edge = place_sites(np.array([[0, 0], [0, n_cols], [n_rows, n_cols], [n_rows, 0]]) - 0.5, grid)
    limits = _limits(drawing)
    looks: dict[MarkerStyle, None] = {}
    for i, panel in enumerate(panels):
        axes = figure.add_axes(sheet.place(i))
        looks |= dict.fromkeys(_paint(axes, sheet, drawing, panel, limits))
        frame(axes, sheet, panel.title, edge)
        if i == 0:
            paint_numbers(axes, grid, "0.4" if panel.image is None or drawing.sites_px is None else "0.8")
    if not on_grid(moved[:, 2:], grid.shape).all():
        looks[EJECTED_LOOK] = None
    _write_head(figure, sheet, drawing, list(looks))
    return figure


def _paint(
    axes: Axes, sheet: Sheet, drawing: ShotDrawing, panel: ShotPanel, limits: tuple[float, float]
) -> list[MarkerStyle]:
    """Paint the frame if there is one, the sites, the target's border and the moves."""
    from matplotlib.collections import LineCollection

    grid, target = drawing.grid, drawing.target
    if panel.image is None or drawing.sites_px is None:
        looks = paint_sites(axes, sheet, grid, panel.occupancy, target, final=False)
    else:
        _lay_under(axes, panel.image, drawing.sites_px, grid, limits)
        looks = _mark(axes, sheet, grid, panel.occupancy, target)
    border: dict[str, Any] = {"colors": OUTLINE, "linewidths": 0.8, "capstyle": "round", "zorder": 1.5}
    axes.add_collection(LineCollection(list(outline(target.fill, grid)), **border))
    if len(panel.moves):
        of_batch = [_colour(i, int(panel.batch[-1]) + 1) for i in range(int(panel.batch[-1]) + 1)]
        paint_moves(axes, sheet, grid, panel.moves, np.array(of_batch)[panel.batch])
    return looks


def _lay_under(
    axes: Axes, image: NDArray[np.uint16], sites_px: Floats, grid: SiteGrid, limits: tuple[float, float]
) -> None:
    """Show a frame turned and scaled so that its sites lie on the lattice, with a white rim."""
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    rows, cols = np.indices(grid.shape)
    places = place_sites(np.stack([rows.ravel(), cols.ravel()], axis=1), grid)
    y, x = sites_px.reshape(-1, 2).T
    onto, *_ = np.linalg.lstsq(np.stack([x, y, np.ones_like(x)], axis=1), places, rcond=None)
    matrix = np.eye(3)
    matrix[:2] = onto.T
    low, high = limits
    shown = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest", zorder=0)
    shown.set_transform(Affine2D(matrix) + axes.transData)
    rim: dict[str, Any] = {"fill": False, "edgecolor": "white", "linewidth": RIM_PT, "zorder": 5}
    axes.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, transform=axes.transAxes, **rim))


def _mark(
    axes: Axes, sheet: Sheet, grid: SiteGrid, occupancy: Occupancy, target: TargetPattern
) -> list[MarkerStyle]:
    here = (
        occupancy & target.fill,
        ~occupancy & target.fill,
        occupancy & target.clear,
        occupancy & ~target.fill & ~target.clear,
    )
    marked: list[MarkerStyle] = []
    for look, sites in zip(ON_FRAME, here, strict=True):
        if sites.any():
            x, y = place_sites(np.argwhere(sites), grid).T
            axes.plot(x, y, **look.keywords(sheet.site_in), zorder=1)
            marked.append(look)
    return marked


def _limits(drawing: ShotDrawing) -> tuple[float, float]:
    """Counts that are black and white, the same in all panels."""
    images = [panel.image for panel in drawing.panels if panel.image is not None]
    if not images:
        return 0.0, 1.0
    low, high = np.quantile(np.concatenate([image.ravel() for image in images]), RANGE)
    return float(low), float(max(high, low + 1))


def _colour(index: int, n_batches: int) -> Any:
    from matplotlib import colormaps

    name, first, last = COLOURS
    return colormaps[name](first + (last - first) * index / max(1, n_batches - 1))


def _write_head(figure: Figure, sheet: Sheet, drawing: ShotDrawing, looks: list[MarkerStyle]) -> None:
    """The title, and what the marks stand for."""
    from matplotlib.lines import Line2D

    across, down = sheet.width_in, sheet.height_in
    text: dict[str, Any] = {"va": "top", "parse_math": False}
    figure.text(0.2 / across, 1 - 0.12 / down, drawing.title, fontsize=11, **text)
    figure.text(0.2 / across, 1 - 0.36 / down, drawing.note, fontsize=8, color="0.4", **text)
    order = (*ON_FRAME, ATOM_LOOK, DEFECT_LOOK, SURPLUS_LOOK, RESERVOIR_LOOK, EMPTY_LOOK, EJECTED_LOOK)
    handles = [Line2D([], [], label=look.label, **look.keywords(0.16)) for look in order if look in looks]
    handles.append(Line2D([], [], color=OUTLINE, linewidth=1, label=OUTLINE_LABEL))
    if any(len(panel.moves) for panel in drawing.panels):
        for index, name in ((0, "first batch"), (1, "last batch")):
            handles.append(Line2D([], [], color=_colour(index, 2), linewidth=2, label=name))
    figure.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(0.1 / across, 1 - 0.66 / down),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        handletextpad=0.4,
        columnspacing=1.2,
    )
