"""Powers of the static tweezers before and after they were equalised."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.saving import make_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

SIZE_IN: Final = (8.4, 5.6)
MIN_RANGE: Final = 0.05
"""Least deviation from the mean that the colours go to."""
TITLE_PT: Final = 10
LABEL_PT: Final = 9
TICK_PT: Final = 8


def draw_powers(before: Floats, after: Floats, rows: Floats, cols: Floats) -> Figure:
    """Draw maps of the powers, relative to their means, and the amplitudes that were found.

    Args:
        before: float64 (n_rows, n_cols), powers at first; nan where they are not known.
        after: float64 (n_rows, n_cols), powers in the end.
        rows: float64 (n_rows,), amplitudes of the rows' tones, fractions of full scale.
        cols: float64 (n_cols,), amplitudes of the columns' tones.
    """
    figure = make_figure(*SIZE_IN, layout="constrained")
    panels = figure.subplots(2, 2, height_ratios=(2.2, 1.0))
    maps = [power / np.nanmean(power) - 1 for power in (before, after)]
    most = max(MIN_RANGE, *(float(np.nanmax(np.abs(each))) for each in maps))
    for axes, each, title in zip(panels[0], maps, ("before", "after"), strict=True):
        axes.imshow(100 * each, cmap="RdBu_r", vmin=-100 * most, vmax=100 * most)
        axes.set_title(f"{title}: {100 * float(np.nanstd(each)):.1f} % r.m.s.", fontsize=TITLE_PT)
        _label(axes, "column", "row")
        _count(axes.xaxis)
        _count(axes.yaxis)
    bar = figure.colorbar(panels[0][0].images[0], ax=panels[0], shrink=0.9)
    _label(bar.ax, "", "power beside the mean (%)")
    for axes, amplitudes, name in zip(panels[1], (rows, cols), ("row", "column"), strict=True):
        axes.bar(np.arange(len(amplitudes)), 100 * amplitudes, color="#1f4e8c")
        axes.set_ylim(0, 115 * float(amplitudes.max()))
        _label(axes, name, "tone (% of full scale)")
        _count(axes.xaxis)
    return figure


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=LABEL_PT)
    axes.set_ylabel(y, fontsize=LABEL_PT)
    axes.tick_params(labelsize=TICK_PT)


def _count(axis: Axis) -> None:
    """Let an axis tick at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
