"""Fractions against a number: the cycle, or a scanned value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.charts.style import KEY_PT, count_along, label
from labseq.drawing.series import DARK, OTHER, Series, paint_series, plain, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final = (DARK, OTHER, "#2a9d6f", "#a05195")
MARKERS: Final = "osD^"
ROOM: Final = 0.12
"""Room above and below the points, relative to their range."""
MIN_RANGE: Final = 0.5
"""Least range that is shown, in per cent."""
MIN_GAP: Final = 0.09
"""Least distance of values, relative to their range, that are all written below the axis."""
LONG: Final = 4
"""Letters from which on tick labels are turned where there are many."""


@dataclass(frozen=True, slots=True, eq=False)
class CurvesChart:
    """Points with errors, joined by thin lines.

    Attributes:
        title: Stands above it.
        x_label: What the x axis shows, with its unit.
        y_label: What the y axis shows, with its unit.
        series: The points, fractions; each with at least one.
        ticks: Words at x = 0, 1, 2, ... instead of numbers; none for numbers.
        whole: Whether x is a count.
        logarithmic: Whether the x axis is.
        from_zero: Whether the y axis begins at 0.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    ticks: tuple[str, ...] = ()
    whole: bool = False
    logarithmic: bool = False
    from_zero: bool = False

    def paint(self, axes: Axes) -> None:
        """Paint."""
        for one, colour, marker in zip(self.series, COLOURS, MARKERS, strict=False):
            paint_series(axes, one, colour, marker, joined=not self.ticks)
        label(axes, self.title, self.x_label, self.y_label)
        if self.logarithmic:
            _make_logarithmic(axes)
        if self.ticks:
            turned = len(self.ticks) * max(map(len, self.ticks)) > 8 * LONG
            axes.set_xticks(
                np.arange(len(self.ticks)), list(map(plain, self.ticks)), rotation=90 if turned else 0
            )
        elif self.whole:
            count_along(axes)
        elif not self.logarithmic and _are_apart(x := self.series[0].x):
            axes.set_xticks(x)
        if self.whole or self.ticks:
            x = np.concatenate([one.x for one in self.series])
            axes.set_xlim(x.min() - 0.5, x.max() + 0.5)
        low, high = span(self.series)
        room = ROOM * max(high - low, MIN_RANGE)
        axes.set_ylim(0.0 if self.from_zero else low - room, high + room)
        if len(self.series) > 1:
            axes.legend(frameon=False, fontsize=KEY_PT)


def _are_apart(x: NDArray[np.float64]) -> bool:
    """Whether every value has room for its number."""
    return len(x) < 2 or bool(np.diff(x).min() >= MIN_GAP * np.ptp(x) > 0)


def _make_logarithmic(axes: Axes) -> None:
    """Plain numbers on a logarithmic axis, as far as there is room for them."""
    from matplotlib.ticker import LogFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(LogFormatter())
    axes.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    axes.tick_params(which="both", labelsize=8)
