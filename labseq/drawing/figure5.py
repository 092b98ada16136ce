"""The paper's figure 5: defect-free probability against the number of cycles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.series import (
    DARK,
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
SIZE_IN: Final = (8.6, 4.4)
WIDTHS: Final = (2.3, 1.0)
"""Of the probabilities and of the histogram; relative."""
HEADROOM: Final = 1.35
"""Height of the panel, relative to the highest point: the key stands above the points."""
MIN_DEFECTS: Final = 4
"""Number of defects up to which the histogram goes at least."""


@dataclass(frozen=True, slots=True, eq=False)
class CyclesDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        series: P_n of the run, and of one that it is compared with if there is one.
        defects: For each of them, int64 (n,), how many shots have 0, 1, 2, ... defects after the last cycle.
        quoted: The paper's points; None if they are of another array.
        ceiling: What losses and detection leave at most, by cycle; None if that is not known.
    """

    title: str
    note: str
    series: tuple[Series, ...]
    defects: tuple[NDArray[np.int64], ...]
    quoted: Series | None = None
    max_defect_free: Series | None = None


def save_cycles(path: Path, drawing: CyclesDrawing) -> None:
    """Draw the defect-free probability against the number of cycles, with the defects at the end.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: CyclesDrawing) -> Figure:
    figure = make_figure(*SIZE_IN, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=WIDTHS)
    _draw_rates(left, drawing)
    _draw_defects(right, drawing)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=9)
    return figure


def _draw_rates(axes: Axes, drawing: CyclesDrawing) -> None:
    from matplotlib.ticker import MaxNLocator

    for series, colour, marker in zip(drawing.series, (DARK, OTHER), "os", strict=False):
        paint_series(axes, series, colour, marker, joined=True)
    if drawing.quoted is not None:
        paint_quoted(axes, drawing.quoted)
    if drawing.max_defect_free is not None:
        limit = drawing.max_defect_free
        axes.plot(limit.x, 100 * limit.y, color=LIMIT, linewidth=1, linestyle="--", label=plain(limit.label))
    shown = [one for one in (*drawing.series, drawing.quoted, drawing.max_defect_free) if one is not None]
    axes.set_ylim(0.0, HEADROOM * span(shown)[1])
    axes.set_xlim(0.5, max(float(one.x[-1]) for one in shown) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("rearrangement cycles n")
    axes.set_ylabel("defect-free on the image that ends cycle n (%)")
    axes.legend(*_key(axes, drawing), frameon=False, fontsize=8, loc="upper left")
    tidy(axes)


def _key(axes: Axes, drawing: CyclesDrawing) -> tuple[list[Any], list[str]]:
    """Handles and labels, points before lines."""
    handles, labels = axes.get_legend_handles_labels()
    if drawing.max_defect_free is not None:  # matplotlib sorts lines before points with error bars
        handles, labels = [*handles[1:], handles[0]], [*labels[1:], labels[0]]
    return handles, labels


def _draw_defects(axes: Axes, drawing: CyclesDrawing) -> None:
    """The histogram: share of the shots with each number of defects."""
    from matplotlib.ticker import MaxNLocator

    for counts, inside, rim in zip(drawing.defects, (LIGHT, None), (DARK, OTHER), strict=False):
        share = 100 * counts / max(1, counts.sum())
        edges = np.arange(len(counts) + 1) - 0.5
        if inside is not None:
            axes.stairs(share, edges, fill=True, color=inside)
        axes.stairs(share, edges, color=rim, linewidth=0.9)
    most = max(MIN_DEFECTS, *(len(counts) - 1 for counts in drawing.defects))
    axes.set_xlim(-0.8, most + 0.8)
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"defects after cycle {int(drawing.series[0].x[-1])}")
    axes.set_ylabel("shots (%)")
    tidy(axes)
