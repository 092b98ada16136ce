"""A plan as a picture of small multiples, for a person to follow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from labseq.drawing.batches import occupancies, summarise_batches
from labseq.drawing.paint import (
    EJECTED_LOOK,
    MarkerStyle,
    frame,
    paint_lines,
    paint_moves,
    paint_numbers,
    paint_sites,
)
from labseq.drawing.panels import Panel, make_panels
from labseq.drawing.saving import check_place, make_figure, save_figure
from labseq.drawing.sheet import Sheet, extent_of, lay_out, place_sites
from labseq.errors import ConfigError, Problem
from labseq.model import Occupancy, Plan, PlanReport, SiteGrid, TargetPattern

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 150
MAX_SITES: Final = 128
"""Most rows, and most columns, of an array that can be made out in a picture."""
COLOURS: Final = ("plasma", 0.0, 0.82)
"""Colour map of the order of batches, and the part of it that can be seen on white."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        source: Where the occupancy comes from; stands below it.
        grid: The grid of sites.
        occupancy: bool (n_rows, n_cols), before.
        target: What the array shall look like.
        plan: The plan, checked.
        report: What the check says of it.
    """

    title: str
    source: str
    grid: SiteGrid
    occupancy: Occupancy
    target: TargetPattern
    plan: Plan
    report: PlanReport


def check_picture(path: Path, shape: tuple[int, int]) -> None:
    """Find out whether a picture can be drawn and where it is to go, before anything is planned.

    Args:
        path: The file.
        shape: (n_rows, n_cols) of the grid.

    Raises:
        ConfigError: The file has another ending than .png, its folder does not
            exist, the array is too large, or matplotlib is not installed.
    """
    if max(shape) > MAX_SITES:
        what = f"{shape[0]} x {shape[1]} sites are too many for a picture"
        raise ConfigError(Problem(what, str(path), expected=f"at most {MAX_SITES} rows and columns"))
    check_place(path, (".png",))


def save_plan(path: Path, drawing: PlanDrawing) -> None:
    """Draw the array before and after, and between them a panel for each batch or some of them.

    Args:
        path: The PNG file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    told = {"Title": drawing.title, "Software": None}
    save_figure(path, lambda: _draw(drawing), dpi=DPI, metadata=told)


def _draw(drawing: PlanDrawing) -> Figure:
    plan, grid = drawing.plan, drawing.grid
    panels = make_panels(summarise_batches(plan, grid.shape))
    sheet = lay_out(extent_of(plan, grid), len(panels) + 2)
    figure = make_figure(sheet.width_in, sheet.height_in)
    looks = _fill(figure, sheet, drawing, panels)
    _write_head(figure, sheet, drawing, looks)
    if len(panels) < plan.n_batches:
        _colour_bar(figure, sheet, "batches of a panel", ("first", "last"))
    elif panels:
        _colour_bar(figure, sheet, "batch", ("1", str(plan.n_batches)))
    return figure


def _fill(figure: Figure, sheet: Sheet, drawing: PlanDrawing, panels: list[Panel]) -> list[MarkerStyle]:
    """Paint all panels; return what the key has to explain."""
    plan, grid, target = drawing.plan, drawing.grid, drawing.target
    n_rows, n_cols = grid.shape
    edge = place_sites(np.array([[0, 0], [0, n_cols], [n_rows, n_cols], [n_rows, 0]]) - 0.5, grid)
    before = occupancies(plan, drawing.occupancy)
    shown = [before[0], *(before[panel.first] for panel in panels), before[-1]]
    titles = [
        f"before: {int(before[0].sum())} atoms",
        *(panel.title for panel in panels),
        f"after: {target.n_atoms - drawing.report.n_defects} of {target.n_atoms} target sites filled",
    ]
    looks: dict[MarkerStyle, None] = {}
    for i, (atoms, title) in enumerate(zip(shown, titles, strict=True)):
        axes = figure.add_axes(sheet.place(i))
        final = i == len(shown) - 1
        looks |= dict.fromkeys(paint_sites(axes, sheet, grid, atoms, target, final=final))
        frame(axes, sheet, title, edge)
        if 0 < i <= len(panels):
            _paint_panel(axes, sheet, drawing, panels[i - 1], alone=len(panels) == plan.n_batches)
        elif i == 0:
            paint_numbers(axes, grid)
            _scale_bar(axes, sheet, grid)
    if drawing.occupancy.sum() > before[-1].sum():
        looks[EJECTED_LOOK] = None
    return list(looks)


def _paint_panel(axes: Axes, sheet: Sheet, drawing: PlanDrawing, panel: Panel, *, alone: bool) -> None:
    plan = drawing.plan
    offsets = plan.batch_offsets[panel.first : panel.last + 2]
    moves = plan.moves[offsets[0] : offsets[-1]]
    of_batch = [colour_of(*place) for place in _order(panel, plan.n_batches, alone=alone)]
    colours = np.repeat(of_batch, np.diff(offsets), axis=0)
    paint_lines(axes, sheet, drawing.grid, moves)
    paint_moves(axes, sheet, drawing.grid, moves, colours)


def _order(panel: Panel, n_batches: int, *, alone: bool) -> list[tuple[int, int]]:
    """Each batch's place and of how many: in the plan if all are alone in their panels, else in the panel."""
    if alone:
        return [(panel.first, n_batches)]
    return [(i, panel.n_batches) for i in range(panel.n_batches)]


def colour_of(index: int, n_batches: int) -> Any:
    """Colour of a batch by its place among others."""
    from matplotlib import colormaps

    name, first, last = COLOURS
    return colormaps[name](first + (last - first) * index / max(1, n_batches - 1))


def _scale_bar(axes: Axes, sheet: Sheet, grid: SiteGrid) -> None:
    """A bar of a round length in the lower left corner."""
    quarter_um = 0.25 * sheet.extent.width * grid.spacing_m * 1e6
    length_um = max(um for um in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 0.0) if um <= quarter_um)
    if not length_um:
        return
    left, y = sheet.extent.left + 0.3, sheet.extent.bottom - 0.25
    length = length_um * 1e-6 / grid.spacing_m
    axes.plot([left, left + length], [y, y], color="black", linewidth=1.5, solid_capstyle="butt")
    axes.text(left + length + 0.25, y, f"{length_um:g} µm", fontsize=7, ha="left", va="center")


def _write_head(figure: Figure, sheet: Sheet, drawing: PlanDrawing, looks: list[MarkerStyle]) -> None:
    """The title, and what the markers stand for."""
    from matplotlib.lines import Line2D

    across, down = sheet.width_in, sheet.height_in
    plain: dict[str, Any] = {"va": "top", "parse_math": False}  # a file may be called $x$
    figure.text(0.2 / across, 1 - 0.12 / down, drawing.title, fontsize=11, **plain)
    figure.text(0.2 / across, 1 - 0.36 / down, drawing.source, fontsize=8, color="0.4", **plain)
    figure.legend(
        handles=[Line2D([], [], label=look.label, **look.keywords(0.16)) for look in looks],
        loc="center left",
        bbox_to_anchor=(0.1 / across, 1 - 0.66 / down),
        ncols=len(looks),
        frameon=False,
        fontsize=8,
        handletextpad=0.2,
        columnspacing=1.2,
    )


def _colour_bar(figure: Figure, sheet: Sheet, title: str, ends: tuple[str, str]) -> None:
    """What the colours of arrows stand for."""
    across, down = sheet.width_in, sheet.height_in
    axes = figure.add_axes((1 - 1.9 / across, 1 - 0.7 / down, 1.0 / across, 0.1 / down))
    axes.imshow([[colour_of(i, 100) for i in range(100)]], aspect="auto")
    axes.set_axis_off()
    axes.set_title(title, fontsize=8, pad=3)
    axes.text(-4, 0, ends[0], fontsize=7, ha="right", va="center")
    axes.text(104, 0, ends[1], fontsize=7, ha="left", va="center")
