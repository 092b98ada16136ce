"""A fraction against the shot: how a run went on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.charts.style import count_along, label
from labseq.drawing.series import DARK, LIGHT, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

MANY: Final = 500
"""From so many points on they are smaller."""
PIXELS: Final = 2000
"""From so many points on they are pixels in a vector picture too."""
MIN_RANGE: Final = 1.0
"""Least range that is shown, in per cent."""


@dataclass(frozen=True, slots=True, eq=False)
class TrendChart:
    """A fraction against the shot.

    Attributes:
        title: Stands above it.
        label: What is shown, with its unit.
        shots: float64 (n,), numbers of the shots, rising.
        values: float64 (n,), a fraction for each; NaN where there is none.
        running: The mean over neighbouring shots, with its error.
        is_rate: Whether each value is 0 or 1, a mark at the edge; the scale then goes from 0 to 100 %.
    """

    title: str
    label: str
    shots: Floats
    values: Floats
    running: Series
    is_rate: bool = False

    def paint(self, axes: Axes) -> None:
        """Paint the shots faintly, and their running mean with its error."""
        look: dict[str, Any] = {"linestyle": "none", "zorder": 2, "rasterized": len(self.shots) > PIXELS}
        few = len(self.shots) <= MANY
        if self.is_rate:
            look |= {"marker": "|", "markersize": 5 if few else 3, "markeredgewidth": 0.8 if few else 0.3}
        else:
            look |= {"marker": "o", "markersize": 3 if few else 1, "markeredgewidth": 0}
        axes.plot(self.shots, 100 * self.values, color=LIGHT, **look)
        run = self.running
        low, high = 100 * run.low, 100 * run.high
        known = np.isfinite(low) & np.isfinite(high)
        axes.fill_between(run.x, low, high, where=known, color=DARK, alpha=0.2, linewidth=0, zorder=3)
        axes.plot(
            run.x, 100 * run.y, color=DARK, linewidth=1.4, marker="o" if len(run.x) == 1 else "", zorder=4
        )
        label(axes, self.title, "shot", self.label)
        count_along(axes)
        axes.set_xlim(self.shots[0] - 0.5, self.shots[-1] + 0.5)
        axes.set_ylim(*self._limits())

    def _limits(self) -> tuple[float, float]:
        if self.is_rate:
            return -4.0, 104.0
        low, high = 100 * float(np.nanmin(self.values)), 100 * float(np.nanmax(self.values))
        room = 0.1 * max(high - low, MIN_RANGE)
        return low - room, high + room
