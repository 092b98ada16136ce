"""The paper's figure 4: filling against the degree of parallelism."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.series import (
    ANOTHER,
    DARK,
    FRAME,
    LIGHT,
    LIMIT,
    OTHER,
    Series,
    paint_quoted,
    paint_series,
    plain,
    span,
    tidy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 150
SIZE_IN: Final = (6.4, 4.6)
COLOURS: Final = ((LIGHT, DARK), (ANOTHER, OTHER))
"""Of the series with one window and of that with a window for each point; this run's, and the other's."""
ROOM: Final = 0.25
"""Room above and below the points, relative to their range."""
MIN_RANGE: Final = 0.5
"""Least range of filling that is shown, in per cent."""


@dataclass(frozen=True, slots=True, eq=False)
class ParallelismDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        fixed: Filling where all points have one window: of the run, and of one that it is compared with.
        optimised: Filling where each point has a window of its own, likewise; either may be empty.
        survival: What the lifetime leaves of an atom after the window.
        quoted: The paper's points; None if they are of another array.
    """

    title: str
    note: str
    fixed: tuple[Series | None, ...]
    optimised: tuple[Series | None, ...]
    survival: Series
    quoted: Series | None = None


def save_parallelism(path: Path, drawing: ParallelismDrawing) -> None:
    """Draw filling against the degree of parallelism, with the survival during the window.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: ParallelismDrawing) -> Figure:
    from matplotlib.ticker import MaxNLocator

    figure = make_figure(*SIZE_IN, layout="constrained")
    axes: Axes = figure.add_subplot()
    for kind, marker, series in ((0, "s", drawing.fixed), (1, "o", drawing.optimised)):
        for one, colours in zip(series, COLOURS, strict=False):
            if one is not None:
                paint_series(axes, one, colours[kind], marker, joined=True)
    if drawing.quoted is not None:
        paint_quoted(axes, drawing.quoted)
    low, high = span((*drawing.fixed, *drawing.optimised, drawing.quoted))
    room = ROOM * max(high - low, MIN_RANGE)
    axes.set_ylim(low - room, high + room)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("degree of parallelism")
    axes.set_ylabel("filling after one cycle (%)")
    tidy(axes)
    _draw_survival(axes, drawing.survival)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=9)
    return figure


def _draw_survival(axes: Axes, survival: Series) -> None:
    """A grey curve with an axis of its own on the right."""
    right = axes.twinx()
    right.plot(survival.x, 100 * survival.y, color=LIMIT, linewidth=1, label=plain(survival.label))
    low, high = span([survival])
    room = ROOM * max(high - low, MIN_RANGE)
    right.set_ylim(low - room, high + room)
    right.set_ylabel("survival of the window (%)", color=LIMIT)
    right.tick_params(colors=LIMIT, width=0.7, labelsize=9)
    for spine in right.spines.values():
        spine.set(color=FRAME, linewidth=0.7)
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
