"""Pictures of plans."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, InvalidPlanError, Problem
from labseq.model import Batch, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.pictures.figures import (
    POINTS_PER_INCH,
    MarkerStyle,
    Sheet,
    check_place,
    extent_of_sites,
    make_figure,
    place_sites,
    plan_timelines,
    save_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHT: Final = (0.28, 0.85)
"""Least and largest height of a hop, in units of the spacing."""
STEP: Final = 0.17
"""Height between lanes, in units of the spacing, while there is room for all of them."""
GAP: Final = 0.16
"""Distance of an arrow's ends from the centres of its sites, in units of the spacing."""
HEAD: Final = (0.42, 0.2)
"""Length and half width of an arrow's head, in units of the spacing."""

N_POINTS: Final = 16


def lanes(moves: NDArray[np.integer]) -> NDArray[np.intp]:
    """Separate moves that overlap on a line, so that they can be drawn next to each other.

    Short moves get the low lanes. Opposite moves along a line need no separate lanes, because they are drawn
    on opposite sides of it.

    Args:
        moves: (n, 4), from row, from column, to row, to column, each along a row or a column.

    Returns:
        The lane of each, from 0.

    Example:
        >>> lanes(np.array([[0, 0, 0, 3], [0, 1, 0, 2], [0, 5, 0, 6], [1, 0, 1, 3]])).tolist()
        [1, 0, 0, 0]
    """
    way = moves[:, 2:] - moves[:, :2]
    axis = (way[:, 0] != 0).astype(np.intp)  # 1 along a column, where moves count rows
    each = np.arange(len(moves))
    line, start, end = moves[each, axis], moves[each, 1 - axis], moves[each, 3 - axis]
    lane_of_move = np.zeros(len(moves), np.intp)
    taken: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for i in np.argsort(np.abs(end - start), kind="stable"):
        low, high = sorted((int(start[i]), int(end[i])))
        track = int(axis[i]), int(line[i]), int(end[i] > start[i])
        lane = 0
        while any(a < high and low < b for a, b in taken.get((*track, lane), ())):
            lane += 1
        taken.setdefault((*track, lane), []).append((low, high))
        lane_of_move[i] = lane
    return lane_of_move


def heights(lane: NDArray[np.intp]) -> NDArray[np.float64]:
    """Heights of hops, in units of the spacing. Many lanes are closer together.

    Example:
        >>> heights(np.array([0, 1])).round(2).tolist()
        [0.28, 0.45]
    """
    low, high = HEIGHT
    step = min(STEP, (high - low) / max(1, int(lane.max(initial=0))))
    return low + step * lane.astype(np.float64)


def hops(
    start: NDArray[np.float64], end: NDArray[np.float64], height: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Make each arrow a flat arc to the left of its path, so that opposite paths differ.

    The arc is a quadratic Bezier curve.

    Args:
        start: float64 (n, 2), in units of the spacing.
        end: float64 (n, 2). No arrow may have length 0.
        height: float64 (n,), in units of the spacing.

    Returns:
        The shafts, float64 (n, points, 2), and the heads, float64 (n, 3, 2).

    Example:
        >>> shafts, heads = hops(np.zeros((1, 2)), np.array([[3.0, 0.0]]), np.array([0.3]))
        >>> shafts.shape, heads.shape
        ((1, 16, 2), (1, 3, 2))
    """
    way = end - start
    length = np.hypot(way[:, 0], way[:, 1])[:, None]
    along = way / length
    aside = np.stack([along[:, 1], -along[:, 0]], axis=1)
    start, end = start + GAP * along, end - GAP * along
    bend = (start + end) / 2 + 2 * height[:, None] * aside
    landing = end - bend
    landing /= np.hypot(landing[:, 0], landing[:, 1])[:, None]
    size = np.minimum(1.0, 0.8 * length)
    neck = end - HEAD[0] * size * landing
    side = HEAD[1] * size * np.stack([landing[:, 1], -landing[:, 0]], axis=1)
    t = np.linspace(0.0, 1.0, N_POINTS)[None, :, None]
    shafts = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * bend[:, None] + t**2 * neck[:, None]
    return shafts, np.stack([end, neck + side, neck - side], axis=1)


Axis = Literal["row", "column"]


Lines = tuple[Axis, tuple[int, ...]]
"""Rows or columns, sorted."""


def batch_lines(plan: Plan) -> list[Lines]:
    """The rows or the columns along which the atoms of each batch of a checked plan move.

    For a batch with paths of tones, these are the rows that its atoms come from.

    Example:
        >>> batch_lines(Plan.from_batches([([(2, 0), (2, 1)], [(2, 3), (2, 4)])]))
        [('row', (2,))]
    """
    return [_lines_of(batch) for batch in plan.batches]


def _lines_of(batch: Batch) -> Lines:
    axis: Axis = (
        "column" if batch.tones is None and (batch.to_sites != batch.from_sites)[:, 0].any() else "row"
    )
    return axis, tuple(np.unique(batch.from_sites[:, 1 if axis == "column" else 0]).tolist())


def on_grid(sites: NDArray[np.integer], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """True for each site (n, 2) on a grid with (n_rows, n_cols) sites, bool (n,)."""
    inside = (sites >= 0) & (sites < shape)
    return inside[:, 0] & inside[:, 1]


def occupancies(plan: Plan, occupancy: Occupancy) -> list[Occupancy]:
    """The occupancy before each batch, and after the last, n_batches + 1 in all.

    Args:
        plan: A plan that was checked for this occupancy.
        occupancy: bool (n_rows, n_cols), before the plan.

    Example:
        >>> plan = Plan.from_batches([([(0, 0), (0, 1)], [(0, 1), (0, 2)])])
        >>> [a.astype(int).tolist() for a in occupancies(plan, np.array([[True, True, False]]))]
        [[[1, 1, 0]], [[0, 1, 1]]]
    """
    before = [occupancy]
    for batch in plan.batches:
        atoms = before[-1].copy()
        atoms[tuple(batch.from_sites[on_grid(batch.from_sites, occupancy.shape)].T)] = False
        atoms[tuple(batch.to_sites[on_grid(batch.to_sites, occupancy.shape)].T)] = True
        before.append(atoms)
    return before


def lines_label(axis: Axis, lines: Iterable[int]) -> str:
    """Name rows or columns, counted from 0.

    Example:
        >>> lines_label("row", [7]), lines_label("column", [2, 3, 4, 9])
        ('row 7', 'columns 2-4, 9')
    """
    numbers = sorted(set(lines))
    starts = [n for n, before in zip(numbers, [None, *numbers], strict=False) if before != n - 1]
    bounds = pairwise([*starts, 1 << 31])
    spans = [[n for n in numbers if start <= n < stop] for start, stop in bounds]
    ranges = [str(span[0]) if span[0] == span[-1] else f"{span[0]}-{span[-1]}" for span in spans]
    return f"{axis}{'s' if len(numbers) > 1 else ''} {', '.join(ranges)}"


ATOM, SURPLUS, RESERVOIR = "0.45", "#86c5ea", "0.80"
DEFECT, RING, DOT, BAND = "#c8102e", "0.45", "0.82", "#dff0e0"


ATOM_LOOK: Final = MarkerStyle("atom on a target site", "o", 0.62, ATOM, ATOM)
DEFECT_LOOK: Final = MarkerStyle("empty target site", "o", 0.62, "white", RING)
SURPLUS_LOOK: Final = MarkerStyle("surplus atom", "o", 0.5, SURPLUS, SURPLUS)
RESERVOIR_LOOK: Final = MarkerStyle("atom in the reservoir", "o", 0.5, RESERVOIR, RESERVOIR)
EMPTY_LOOK: Final = MarkerStyle("empty site", "o", 0.14, DOT, DOT)
STILL_EMPTY_LOOK: Final = MarkerStyle("target site that stays empty", "o", 0.62, "white", DEFECT)
EJECTED_LOOK: Final = MarkerStyle("ejected", "X", 0.55, DEFECT, DEFECT)
WRONG_LOOK: Final = MarkerStyle("refused", "D", 0.95, "none", DEFECT)


def paint_sites(
    axes: Axes, sheet: Sheet, grid: SiteGrid, occupancy: Occupancy, target: TargetPattern, *, final: bool
) -> list[MarkerStyle]:
    """Paint every site. With ``final``, empty target sites stay empty.

    Returns:
        The markers that occur, in the order of the key.
    """
    wanted, unwanted = target.fill, target.clear
    layers = (
        (EMPTY_LOOK, ~occupancy & ~wanted),
        (STILL_EMPTY_LOOK if final else DEFECT_LOOK, ~occupancy & wanted),
        (RESERVOIR_LOOK, occupancy & ~wanted & ~unwanted),
        (SURPLUS_LOOK, occupancy & unwanted),
        (ATOM_LOOK, occupancy & wanted),
    )
    painted: list[MarkerStyle] = []
    for look, sites in layers:
        if sites.any():
            x, y = place_sites(np.argwhere(sites), grid).T
            axes.plot(x, y, **look.keywords(sheet.site_in), zorder=1)
            painted.append(look)
    return painted


def paint_moves(axes: Axes, sheet: Sheet, grid: SiteGrid, moves: NDArray[np.int16], colours: Any) -> None:
    """Paint atom moves (n, 4) as arrows of given colours, with a cross where an atom is ejected."""
    from matplotlib.collections import LineCollection, PolyCollection

    start, end = place_sites(moves[:, :2], grid), place_sites(moves[:, 2:], grid)
    goes = (moves[:, :2] != moves[:, 2:]).any(axis=1)
    shafts, heads = hops(start[goes], end[goes], heights(lanes(moves[goes])))
    points = sheet.site_in * POINTS_PER_INCH
    thick = min(1.5, 0.11 * points)
    rings: dict[str, Any] = {"s": (0.62 * points) ** 2, "facecolors": "none", "linewidths": thick}
    axes.scatter(start[:, 0], start[:, 1], edgecolors=colours, zorder=2, **rings)
    lost = ~on_grid(moves[:, 2:], grid.shape)
    axes.plot(end[lost, 0], end[lost, 1], **EJECTED_LOOK.keywords(sheet.site_in), zorder=2)
    arrows = np.asarray(colours)[goes]
    axes.add_collection(LineCollection(list(shafts), colors=arrows, linewidths=thick, zorder=3))
    axes.add_collection(PolyCollection(list(heads), facecolors=arrows, linewidths=0, zorder=4))


def paint_paths(axes: Axes, sheet: Sheet, grid: SiteGrid, batch: Batch, colour: Any) -> None:
    """Paint the paths of all tweezers of a batch with paths of tones, dotted without an atom."""
    paths, points = batch.tones, sheet.site_in * POINTS_PER_INCH
    assert paths is not None
    thick = min(1.5, 0.11 * points)
    carrying = set(map(tuple, paths.tones_of(batch.from_sites).tolist()))
    for crossing in product(range(paths.shape[1]), range(paths.shape[2])):
        way = place_sites(paths.path_of(*crossing), grid)
        if crossing not in carrying:
            axes.plot(way[:, 0], way[:, 1], ":", color=colour, linewidth=thick / 2, zorder=2)
            continue
        axes.plot(*way[0], "o", ms=0.62 * points, mfc="none", mec=colour, mew=thick, zorder=2)
        axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=thick, zorder=3)
        axes.plot(*way[-1], "o", ms=0.3 * points, color=colour, mew=0, zorder=4)
    lost = place_sites(batch.to_sites[~on_grid(batch.to_sites, grid.shape)], grid)
    axes.plot(lost[:, 0], lost[:, 1], **EJECTED_LOOK.keywords(sheet.site_in), zorder=4)


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
    """Number every row on the left and every column at the top, or every fifth."""
    rows = [(row, -1, row) for row in range(0, grid.n_rows, 1 if grid.n_rows < 10 else 5)]
    cols = [(-1, col, col) for col in range(0, grid.n_cols, 1 if grid.n_cols < 10 else 5)]
    for row, col, number in rows + cols:
        x, y = place_sites(np.array([row, col]), grid)
        axes.text(x, y, str(number), fontsize=6, color=colour, ha="center", va="center")


def frame(axes: Axes, sheet: Sheet, title: str, edge: NDArray[np.float64]) -> None:
    """Set a panel's limits and title, and draw a thin line around the array with corners ``edge`` (n, 2)."""
    extent = sheet.extent
    axes.set_xlim(extent.left, extent.right)
    axes.set_ylim(extent.bottom, extent.top)
    axes.set_axis_off()
    fits = extent.width * sheet.site_in * POINTS_PER_INCH / (0.6 * max(1, len(title)))
    axes.set_title(title, fontsize=min(8, fits), pad=2, y=1.0)  # a fixed y spares matplotlib a search
    closed = np.concatenate([edge, edge[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color="0.88", linewidth=0.6, zorder=0)


MAX_PANELS: Final = 38
"""Maximum number of panels of batches. With the panels before and after there are 40."""


@dataclass(frozen=True, slots=True)
class Panel:
    """Batches that are drawn together.

    Attributes:
        first: Index of the first batch.
        last: Index of the last batch.
        moves_along: Their rows, their columns, or both.
    """

    first: int
    last: int
    moves_along: tuple[Lines, ...]

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return self.last - self.first + 1

    @property
    def title(self) -> str:
        """Indices of the batches, and the lines that they move along.

        Example:
            >>> Panel(2, 4, (("row", (7, 9)),)).title
            'batches 2-4: rows 7, 9'
        """
        numbers = f"batch {self.first}" if self.n_batches == 1 else f"batches {self.first}-{self.last}"
        return f"{numbers}: " + "; ".join(_short_label(axis, lines) for axis, lines in self.moves_along)


def make_panels(batches: Sequence[Lines], max_panels: int = MAX_PANELS) -> list[Panel]:
    """Distribute batches among panels, in order and evenly, one per panel if there are enough panels.

    Example:
        >>> [(panel.first, panel.last) for panel in make_panels([("row", (i // 2,)) for i in range(8)], 4)]
        [(0, 1), (2, 3), (4, 5), (6, 7)]
    """
    n, n_panels = len(batches), min(len(batches), max_panels)
    return [_panel(batches, range(n * i // n_panels, n * (i + 1) // n_panels)) for i in range(n_panels)]


def _short_label(axis: Axis, lines: tuple[int, ...]) -> str:
    """The lines for a panel's title, or only their number if they need more than 24 characters."""
    label = lines_label(axis, lines)
    return label if len(label) <= 24 else f"{len(lines)} {axis}s"


def _panel(batches: Sequence[Lines], group: range) -> Panel:
    lines_by_axis: dict[Axis, set[int]] = {}
    for axis, lines in (batches[i] for i in group):
        lines_by_axis.setdefault(axis, set()).update(lines)
    return Panel(
        group[0], group[-1], tuple((axis, tuple(sorted(lines))) for axis, lines in lines_by_axis.items())
    )


DPI: Final = 150
MAX_SITES: Final = 128
"""Maximum number of rows or columns of an array whose sites can be told apart in a picture."""
COLOURS: Final = ("plasma", 0.0, 0.82)
"""Colour map of the order of batches, and the part of it that is visible on white."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanDrawing:
    """A plan to draw, the occupancy before it, two lines of text at the top, and a refusal."""

    title: str
    source: str
    grid: SiteGrid
    occupancy: Occupancy
    target: TargetPattern
    plan: Plan
    report: PlanReport
    refused: InvalidPlanError | None = None

    @property
    def refused_batch(self) -> Batch | None:
        """The batch that breaks a rule, with sites far outside the grid moved closer to it."""
        if self.refused is None:
            return None
        batch, most = self.plan.batch(self.refused.batch), np.array(self.grid.shape) + 1
        starts, goals = (
            np.clip(sites, -2, most).astype(np.int16) for sites in (batch.from_sites, batch.to_sites)
        )
        return Batch(starts, goals)


def check_picture(path: Path, shape: tuple[int, int]) -> None:
    """Check that a picture of (n_rows, n_cols) sites can be drawn and saved, before anything is planned.

    Raises:
        ConfigError: The name does not end in .png, its folder does not exist, the array is too large, or
            matplotlib is not installed.
    """
    check_size(path, shape)
    check_place(path, (".png",))


def check_size(path: Path, shape: tuple[int, int]) -> None:
    """Check that (n_rows, n_cols) sites can be told apart in a picture.

    Raises:
        ConfigError: They cannot.
    """
    if max(shape) > MAX_SITES:
        what = f"{shape[0]} x {shape[1]} sites are too many for a picture"
        raise ConfigError(Problem(what, str(path), expected=f"at most {MAX_SITES} rows and columns"))


def save_plan(path: Path, drawing: PlanDrawing) -> None:
    """Draw the array before and after, and in between a panel for each batch or group of batches.

    A refused plan is drawn up to the refused batch, with its mistake.

    Raises:
        ConfigError: The file cannot be written.
    """
    metadata = {"Title": drawing.title, "Software": None}
    save_figure(path, lambda: _draw(drawing), dpi=DPI, metadata=metadata)


def _draw(drawing: PlanDrawing) -> Figure:
    grid, refused = drawing.grid, drawing.refused_batch
    if drawing.refused is not None:
        drawing = replace(drawing, plan=drawing.plan.first(drawing.refused.batch))
    plan = drawing.plan
    others = (
        [plan.moves[:, 2:]] if refused is None else [plan.moves[:, 2:], refused.to_sites, refused.from_sites]
    )
    panels = make_panels(batch_lines(plan))
    extent = extent_of_sites(np.concatenate(others), grid)
    sheet = plan_timelines(extent, len(panels) + 1 + len(others[:2]))
    figure = make_figure(sheet.width_in, sheet.height_in)
    looks = _fill(figure, sheet, drawing, panels)
    if refused is not None:
        looks += _paint_refused(figure, sheet, drawing, refused, len(panels) + 1)
    _write_head(figure, sheet, drawing, looks)
    if len(panels) < plan.n_batches:
        _colour_bar(figure, sheet, "batches of a panel", ("first", "last"))
    elif panels:
        _colour_bar(figure, sheet, "batch", ("0", str(plan.n_batches - 1)))
    return figure


def _fill(figure: Figure, sheet: Sheet, drawing: PlanDrawing, panels: list[Panel]) -> list[MarkerStyle]:
    """Paint all panels of valid batches, and return the markers for the key."""
    grid, target, refused = drawing.grid, drawing.target, drawing.refused
    before = occupancies(drawing.plan, drawing.occupancy)
    shown = [before[0], *(before[panel.first] for panel in panels), before[-1]]
    filled = f"after: {target.n_atoms - drawing.report.n_defects} of {target.n_atoms} target sites filled"
    titles = [
        f"before: {int(before[0].sum())} atoms",
        *(panel.title for panel in panels),
        filled if refused is None else f"batch {refused.batch}: refused",
    ]
    looks: dict[MarkerStyle, None] = {}
    for i, (atoms, title) in enumerate(zip(shown, titles, strict=True)):
        axes = figure.add_axes(sheet.place(i))
        final = i == len(shown) - 1 and refused is None
        looks |= dict.fromkeys(paint_sites(axes, sheet, grid, atoms, target, final=final))
        frame(axes, sheet, title, _corners(grid))
        if 0 < i <= len(panels):
            _paint_panel(axes, sheet, drawing, panels[i - 1], alone=len(panels) == drawing.plan.n_batches)
        elif i == 0:
            paint_numbers(axes, grid)
            _scale_bar(axes, sheet, grid)
    if drawing.occupancy.sum() > before[-1].sum():
        looks[EJECTED_LOOK] = None
    return list(looks)


def _corners(grid: SiteGrid) -> NDArray[np.float64]:
    n_rows, n_cols = grid.shape
    return place_sites(np.array([[0, 0], [0, n_cols], [n_rows, n_cols], [n_rows, 0]]) - 0.5, grid)


def _paint_refused(
    figure: Figure, sheet: Sheet, drawing: PlanDrawing, batch: Batch, index: int
) -> list[MarkerStyle]:
    """Mark the mistake in the panel of the refused batch, and write the reason next to it."""
    axes, error, grid = figure.axes[index], drawing.refused, drawing.grid
    assert error is not None
    axes.title.set_color(DEFECT)
    paint_numbers(axes, grid)
    moves = np.concatenate([batch.from_sites, batch.to_sites], axis=1)
    wrong = (
        np.arange(len(moves)) == error.move if error.move >= 0 else np.full(len(moves), error.site is None)
    )
    goes = (batch.from_sites != batch.to_sites).any(axis=1)
    colours = np.where(wrong, DEFECT, "0.25")  # moves that break no rule are grey
    paint_moves(axes, sheet, grid, moves[goes], colours[goes])
    sites = moves[wrong & ~goes, :2] if error.site is None else np.array([error.site])
    x, y = place_sites(np.clip(sites, -2, np.array(grid.shape) + 1), grid).T
    axes.plot(x, y, **WRONG_LOOK.keywords(sheet.site_in), zorder=5)
    left, bottom, width, height = sheet.place(index + 1)
    per_line = max(20, int(width * sheet.width_in * POINTS_PER_INCH / 5))
    text = "\n".join(wrap(str(error), per_line))
    plain: dict[str, Any] = {"va": "top", "parse_math": False}
    figure.text(left + 0.05 * width, bottom + 0.9 * height, text, fontsize=9, color=DEFECT, **plain)
    return [WRONG_LOOK] if len(sites) else []


def _paint_panel(axes: Axes, sheet: Sheet, drawing: PlanDrawing, panel: Panel, *, alone: bool) -> None:
    plan = drawing.plan
    offsets = plan.batch_offsets[panel.first : panel.last + 2]
    moves = plan.moves[offsets[0] : offsets[-1]]
    if alone:  # otherwise colours distinguish the batches of a panel
        of_batch = [colour_of(panel.first, plan.n_batches)]
    else:
        of_batch = [colour_of(i, panel.n_batches) for i in range(panel.n_batches)]
    straight = np.ones(len(moves), np.bool_)
    for index, colour in zip(range(panel.first, panel.last + 1), of_batch, strict=True):
        if (batch := plan.batch(index)).tones is not None:
            straight[plan.batch_offsets[index] - offsets[0] :][: len(batch)] = False
            paint_paths(axes, sheet, drawing.grid, batch, colour)
    colours = np.repeat(of_batch, np.diff(offsets), axis=0)[straight]
    paint_lines(axes, sheet, drawing.grid, moves[straight])
    paint_moves(axes, sheet, drawing.grid, moves[straight], colours)


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
    """Write the title, and the meaning of the markers."""
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
    """Explain the colours of arrows."""
    across, down = sheet.width_in, sheet.height_in
    axes = figure.add_axes((1 - 1.9 / across, 1 - 0.7 / down, 1.0 / across, 0.1 / down))
    axes.imshow([[colour_of(i, 100) for i in range(100)]], aspect="auto")
    axes.set_axis_off()
    axes.set_title(title, fontsize=8, pad=3)
    axes.text(-4, 0, ends[0], fontsize=7, ha="right", va="center")
    axes.text(104, 0, ends[1], fontsize=7, ha="left", va="center")
