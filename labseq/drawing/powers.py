"""Powers of the static tweezers before and after they were equalised."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.saving import make_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

SIZE_IN: Final = (8.4, 5.6)
LEAST_RANGE: Final = 0.05
"""Least deviation from the mean that the colours go to."""


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
    most = max(LEAST_RANGE, *(float(np.nanmax(np.abs(each))) for each in maps))
    for axes, each, title in zip(panels[0], maps, ("before", "after"), strict=True):
        axes.imshow(100 * each, cmap="RdBu_r", vmin=-100 * most, vmax=100 * most)
        axes.set_title(f"{title}: {100 * float(np.nanstd(each)):.1f} % r.m.s.", fontsize=9)
        axes.set_xlabel("column", fontsize=8)
        axes.set_ylabel("row", fontsize=8)
    figure.colorbar(panels[0][0].images[0], ax=panels[0], label="power beside the mean (%)", shrink=0.9)
    for axes, amplitudes, name in zip(panels[1], (rows, cols), ("row", "column"), strict=True):
        _draw_amplitudes(axes, amplitudes, name)
    return figure


def _draw_amplitudes(axes: Axes, amplitudes: Floats, name: str) -> None:
    axes.bar(np.arange(len(amplitudes)), 100 * amplitudes, color="#1f4e8c")
    axes.set_ylim(0, 115 * float(amplitudes.max()))
    axes.set_xlabel(name, fontsize=8)
    axes.set_ylabel("amplitude (% of full scale)", fontsize=8)
    axes.tick_params(labelsize=8)
