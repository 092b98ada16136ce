"""Draws one shot: frames, occupancies and moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.overview import cannot_draw, grid_of, note_of, sites_of
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import ConfigError, Problem
from labseq.messages import clean
from labseq.model import CycleRecord, ImageRecord, Occupancy, ShotRecord, SiteGrid, TargetPattern
from labseq.pictures.animations import Animation
from labseq.pictures.figures import (
    PANEL_IN,
    MarkerStyle,
    Sheet,
    extent_of_sites,
    make_figure,
    outline,
    place_sites,
    plan_timelines,
    save_figure,
)
from labseq.pictures.plans import (
    ATOM_LOOK,
    DEFECT_LOOK,
    EJECTED_LOOK,
    EMPTY_LOOK,
    RESERVOIR_LOOK,
    SURPLUS_LOOK,
    check_size,
    frame,
    on_grid,
    paint_moves,
    paint_numbers,
    paint_sites,
)
from labseq.pictures.playback import play_back_cycle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Moves = NDArray[np.int16]

DPI: Final = 150
ON_FRAME: Final = (
    MarkerStyle("atom on a target site", "o", 0.86, "none", "#56b4e9"),
    MarkerStyle("empty target site", "o", 0.86, "none", "#ff7f0e"),
    MarkerStyle("surplus atom", "s", 0.8, "none", "#f0e442"),
    MarkerStyle("atom in the reservoir", "o", 0.86, "none", "0.62"),
)
"""Colours of the rings around sites, from Okabe and Ito, visible on grey for all kinds of colour vision."""
OUTLINE: Final = "#c8102e"
COLOURS: Final = ("plasma", 0.25, 0.95)
"""Colour map of the order of batches, and the part of it that is visible on black and white."""


@dataclass(frozen=True, slots=True, eq=False)
class ShotPanel:
    """An image and the moves that followed it.

    Attributes:
        title: Title above the panel.
        occupancy: bool (n_rows, n_cols), as detected.
        image: uint16 (height, width). None if the frame was not recorded.
        moves: int16 (n, 4), the atom moves that followed: from row, from column, to row, to column.
        batch: int64 (n,), the batch of each move, from 0.
    """

    title: str
    occupancy: Occupancy
    image: NDArray[np.uint16] | None
    moves: Moves
    batch: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ShotDrawing:
    """The content of a picture of a shot.

    Attributes:
        title: Title at the top.
        note: Line below the title.
        grid: The grid of sites.
        target: The target pattern.
        sites_px: float64 (n_rows, n_cols, 2), (y, x) of each site on the frames. None if unknown, and then
            no frames are drawn.
        panels: The images in order, at least one.
    """

    title: str
    note: str
    grid: SiteGrid
    target: TargetPattern
    sites_px: Floats | None
    panels: tuple[ShotPanel, ...]


def save_shot(path: Path, drawing: ShotDrawing) -> None:
    """Draw the images of a shot, each aligned with the lattice.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: ShotDrawing) -> Figure:
    grid, panels = drawing.grid, drawing.panels
    moved = np.concatenate([panel.moves for panel in panels])
    panel_in = PANEL_IN if len(panels) > 2 else 6.5
    sheet = plan_timelines(extent_of_sites(moved[:, 2:], grid), len(panels), panel_in)
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
        n_batches = int(panel.batch[-1]) + 1
        colours = np.array([_colour(i, n_batches) for i in range(n_batches)])
        paint_moves(axes, sheet, grid, panel.moves, colours[panel.batch])
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
    affine, *_ = np.linalg.lstsq(np.stack([x, y, np.ones_like(x)], axis=1), places, rcond=None)
    matrix = np.eye(3)
    matrix[:2] = affine.T
    low, high = limits
    drawn = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest", zorder=0)
    drawn.set_transform(Affine2D(matrix) + axes.transData)
    # separates the frame from its neighbours, and the outer half of its 6 points is not visible
    rim: dict[str, Any] = {"fill": False, "edgecolor": "white", "linewidth": 6, "zorder": 5}
    axes.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, transform=axes.transAxes, **rim))


def _mark(
    axes: Axes, sheet: Sheet, grid: SiteGrid, occupancy: Occupancy, target: TargetPattern
) -> list[MarkerStyle]:
    sites_of_look = (
        occupancy & target.fill,
        ~occupancy & target.fill,
        occupancy & target.clear,
        occupancy & ~target.fill & ~target.clear,
    )
    used_looks: list[MarkerStyle] = []
    for look, sites in zip(ON_FRAME, sites_of_look, strict=True):
        if sites.any():
            x, y = place_sites(np.argwhere(sites), grid).T
            axes.plot(x, y, **look.keywords(sheet.site_in), zorder=1)
            used_looks.append(look)
    return used_looks


def _limits(drawing: ShotDrawing) -> tuple[float, float]:
    """The counts that are drawn as black and as white, the same in all panels."""
    images = [panel.image for panel in drawing.panels if panel.image is not None]
    if not images:
        return 0.0, 1.0
    # without the extremes, because a hot pixel would darken all others
    low, high = np.quantile(np.concatenate([image.ravel() for image in images]), (0.01, 0.998))
    return float(low), float(max(high, low + 1))


def _colour(index: int, n_batches: int) -> Any:
    from matplotlib import colormaps

    name, first, last = COLOURS
    return colormaps[name](first + (last - first) * index / max(1, n_batches - 1))


def _write_head(figure: Figure, sheet: Sheet, drawing: ShotDrawing, looks: list[MarkerStyle]) -> None:
    """Write the title, and the meaning of the marks."""
    from matplotlib.lines import Line2D

    across, down = sheet.width_in, sheet.height_in
    text: dict[str, Any] = {"va": "top", "parse_math": False}
    figure.text(0.2 / across, 1 - 0.12 / down, drawing.title, fontsize=11, **text)
    figure.text(0.2 / across, 1 - 0.36 / down, drawing.note, fontsize=8, color="0.4", **text)
    order = (*ON_FRAME, ATOM_LOOK, DEFECT_LOOK, SURPLUS_LOOK, RESERVOIR_LOOK, EMPTY_LOOK, EJECTED_LOOK)
    handles = [Line2D([], [], label=look.label, **look.keywords(0.16)) for look in order if look in looks]
    handles.append(Line2D([], [], color=OUTLINE, linewidth=1, label="border of the target"))
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


MAX_SITES = 128
"""Maximum number of rows and columns of an array that is drawn."""


def shot_picture(run: Run, index: int, cycle: int | None = None) -> ShotDrawing:
    """The images of a shot with the detected atoms and the moves that followed.

    Args:
        index: Index of the shot, from 0. If the shot did not complete, its last attempt is drawn.
        cycle: Only this cycle, counted from 0 over all rearrangements of the shot. Draws the image on which
            it was planned and the image that ended it.

    Raises:
        ConfigError: There is no such shot or cycle, it has no images, or the array is too large.
        RecordingError: The shot's file is damaged.
    """
    shot = _shot(run, index)
    record, target = shot.record(), run.target
    if max(target.shape) > MAX_SITES:
        problem = f"{target.shape[0]} x {target.shape[1]} sites are too many to draw"
        raise cannot_draw(run, problem, f"at most {MAX_SITES} rows and columns")
    if not record.images:
        raise cannot_draw(run, f"shot {index} has no images", "a shot with an 'image' step")
    panels = _panels(record, target)
    if cycle is not None:
        panels = _of_cycle(run, index, record, panels, cycle)
    sites = sites_of(run)
    frames = [panel.image for panel in panels if panel.image is not None]
    fits = sites is not None and all(image.shape == sites.frame for image in frames)
    no_frames = ""
    if not frames:
        no_frames = "; no frames: they were not kept"
    elif not fits:
        no_frames = "; no frames: their size does not fit the sites"
    ended = "" if shot.status == "complete" else f", {shot.status}: {clean(record.error)}"
    return ShotDrawing(
        title=f"shot {index}{ended}",
        note=note_of(run) + no_frames,
        grid=grid_of(run),
        target=target,
        sites_px=sites.positions_px if sites is not None and fits else None,
        panels=tuple(panels),
    )


def shot_animation(run: Run, index: int, cycle: int | None = None) -> Animation:
    """The motion in a cycle of a shot, and the atoms that were lost.

    Args:
        index: Index of the shot, from 0. If the shot did not complete, its last attempt is drawn.
        cycle: The cycle, counted from 0 over all rearrangements of the shot. None if there is only one.

    Raises:
        ConfigError: There is no such shot or cycle, several cycles but none given, or the array is too large.
        RecordingError: The shot's file is damaged.
    """
    shot = _shot(run, index)
    check_size(shot.file, run.target.shape)
    n_cycles = len(shot.cycles)
    if cycle is None and n_cycles > 1:
        problem = f"shot {index} has {n_cycles} cycles, and an animation shows one"
        raise ConfigError(Problem(problem, expected=f"--cycle with a number from 0 to {n_cycles - 1}"))
    number = cycle or 0
    if not 0 <= number < n_cycles:
        raise _no_cycle(run, index, number, n_cycles)
    playback = play_back_cycle(shot, number)
    n_batches, n_lost = len(playback.batch_s), sum(atom.is_lost for atom in playback.atoms)
    batches = f"{n_batches} batch{'es' * (n_batches != 1)}"
    title = f"shot {index}, cycle {number}: {batches}, {n_lost} atom{'s' * (n_lost != 1)} lost"
    return Animation(title, note_of(run), playback)


def _no_cycle(run: Run, index: int, cycle: int, n_cycles: int) -> ConfigError:
    expected = f"a cycle from 0 to {n_cycles - 1}" if n_cycles else "a shot that rearranges"
    problem = f"shot {index} of {clean(run.path.name)} has no cycle {cycle}"
    return ConfigError(Problem(problem, "--cycle", expected=expected))


def _shot(run: Run, index: int) -> Shot:
    attempts = [shot for shot in (*run.attempts, *run.shots) if shot.index == index]
    if not attempts:
        indices = sorted({shot.index for shot in (*run.shots, *run.attempts)})
        expected = f"a shot from {indices[0]} to {indices[-1]}" if indices else "a run that has shots"
        raise ConfigError(Problem(f"the run has no shot {index}", "--shot", expected=expected))
    return attempts[-1]


def _panels(record: ShotRecord, target: TargetPattern) -> list[ShotPanel]:
    """A panel for each image, with the moves of the cycle that was planned on it."""
    cycles = iter(record.cycles)
    ended_by = [next(cycles, None) if image.cycle >= 0 else None for image in record.images]
    after = [*ended_by[1:], next(cycles, None)]  # a shot that was interrupted may lack the last image
    return [
        _panel(image, f"{clean(image.name)}: {_contents(image, target)}", cycle)
        for image, cycle in zip(record.images, after, strict=True)
    ]


def _contents(image: ImageRecord, target: TargetPattern) -> str:
    n_defects, n_surplus = target.n_defects(image.occupancy), target.n_surplus(image.occupancy)
    text = f"{int(image.occupancy.sum())} atoms, {n_defects or 'no'} defect{'s' * (n_defects != 1)}"
    return text + (f", {n_surplus} surplus" if n_surplus else "")


def _panel(image: ImageRecord, title: str, cycle: CycleRecord | None) -> ShotPanel:
    pixels = None if image.frame is None else image.frame.image
    if cycle is None:
        return ShotPanel(title, image.occupancy, pixels, np.empty((0, 4), np.int16), np.empty(0, np.int64))
    offsets = cycle.plan.batch_offsets[: cycle.n_batches_played + 1]
    batch = np.repeat(np.arange(cycle.n_batches_played), np.diff(offsets))
    played, planned = cycle.n_batches_played, cycle.plan.n_batches
    moves = cycle.plan.moves[: int(offsets[-1])]
    batches = (
        f"{played} of {planned} batches" if played < planned else f"{played} batch{'es' * (played != 1)}"
    )
    title = f"{title}; then {len(moves)} move{'s' * (len(moves) != 1)} in {batches}"
    return ShotPanel(title, image.occupancy, pixels, moves, batch)


def _of_cycle(
    run: Run, index: int, record: ShotRecord, panels: list[ShotPanel], cycle: int
) -> list[ShotPanel]:
    ends = [i for i, image in enumerate(record.images) if image.cycle >= 0]
    if not 0 <= cycle < len(ends):
        raise _no_cycle(run, index, cycle, len(ends))
    after = ends[cycle]
    return panels[max(0, after - 1) : after + 1]
