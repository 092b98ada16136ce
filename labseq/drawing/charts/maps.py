"""A fraction against two scanned values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.charts.style import COLOURS, NOTHING, finish_bar, label
from labseq.drawing.series import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

Floats = NDArray[np.float64]

MAX_WORDS: Final = 6
"""Up to so many rows and columns each cell says its value."""
MAX_TICKS: Final = 10
"""Up to so many values of an axis are written."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChart:
    """A fraction against two scanned values, a cell for each pair.

    Attributes:
        title: Stands above it.
        x_label: The address along x.
        y_label: The address along y.
        x_ticks: Its values, as written.
        y_ticks: Likewise.
        values: float64 (len(y_ticks), len(x_ticks)), fractions; NaN where there is none.
        label: What the colours show.
        limits: Fractions that the colours go from and to.
    """

    title: str
    x_label: str
    y_label: str
    x_ticks: tuple[str, ...]
    y_ticks: tuple[str, ...]
    values: Floats
    label: str
    limits: tuple[float, float]

    def paint(self, axes: Axes) -> None:
        """Paint cells, with their values where there are few."""
        from matplotlib import colormaps

        low, high = (100 * end for end in self.limits)
        colours = colormaps[COLOURS].with_extremes(bad=NOTHING)
        values = np.ma.masked_invalid(100 * self.values)
        image = axes.imshow(
            values, origin="lower", aspect="auto", cmap=colours, vmin=low, vmax=max(high, low + 1e-9)
        )
        label(axes, self.title, self.x_label, self.y_label)
        axes.grid(visible=False)
        _write_ticks(axes.xaxis, self.x_ticks)
        _write_ticks(axes.yaxis, self.y_ticks)
        if max(self.values.shape) <= MAX_WORDS:
            self._write_values(axes, low, high)
        finish_bar(axes.figure.colorbar(image, ax=axes, pad=0.02), self.label)

    def _write_values(self, axes: Axes, low: float, high: float) -> None:
        for (row, col), value in np.ndenumerate(100 * self.values):
            if np.isfinite(value):
                dark = value < (low + high) / 2
                text = f"{value:.3g}"
                axes.text(
                    col, row, text, ha="center", va="center", fontsize=8, color="white" if dark else "black"
                )


def _write_ticks(axis: Axis, words: tuple[str, ...]) -> None:
    every = -(-len(words) // MAX_TICKS)
    at = np.arange(0, len(words), every)
    axis.set_ticks(at, [plain(words[i]) for i in at])
