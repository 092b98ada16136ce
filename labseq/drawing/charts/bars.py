"""Histograms and means as bars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.charts.style import KEY_PT, count_along, label
from labseq.drawing.series import DARK, LIGHT, OTHER, Series, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

BARS: Final[dict[str, Any]] = {"ecolor": DARK, "capsize": 2, "error_kw": {"elinewidth": 0.9, "capthick": 0.9}}
LEAST: Final = 4
"""Number of defects up to which the histogram goes at least."""


@dataclass(frozen=True, slots=True, eq=False)
class DefectsChart:
    """How many defects are left in how many of the shots.

    Attributes:
        title: Stands above it.
        x_label: What is counted.
        shares: Share of the shots at 0, 1, 2, ... defects, with errors.
        expected: float64 (n,), the shares of independent sites with the same mean filling, from 0 on.
    """

    title: str
    x_label: str
    shares: Series
    expected: Floats

    def paint(self, axes: Axes) -> None:
        """Paint bars for what was found, and points for what independent sites would give."""
        y, low, high = (100 * part for part in (self.shares.y, self.shares.low, self.shares.high))
        errors = np.stack([y - low, high - y]).clip(min=0.0)
        axes.bar(
            self.shares.x, y, width=0.8, color=LIGHT, yerr=errors, label=plain(self.shares.label), **BARS
        )
        points: dict[str, Any] = {
            "color": OTHER,
            "marker": "D",
            "markersize": 4,
            "linewidth": 0.9,
            "linestyle": "--",
        }
        axes.plot(
            np.arange(len(self.expected)), 100 * self.expected, label="independent sites", zorder=3, **points
        )
        label(axes, self.title, self.x_label, "shots (%)")
        count_along(axes)
        axes.set_xlim(-0.6, max(LEAST, self.shares.x[-1], len(self.expected) - 1) + 0.6)
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False, fontsize=KEY_PT)


@dataclass(frozen=True, slots=True, eq=False)
class LossCausesChart:
    """What atoms were lost to.

    Attributes:
        title: Stands above it.
        x_label: What is counted.
        causes: Their names, the worst first.
        means: float64 (n,).
        errors: float64 (n,), standard errors; NaN where they are not known.
    """

    title: str
    x_label: str
    causes: tuple[str, ...]
    means: Floats
    errors: Floats

    def paint(self, axes: Axes) -> None:
        """Paint a bar for each cause."""
        at = np.arange(len(self.causes))
        axes.barh(at, self.means, height=0.65, color=LIGHT, xerr=np.nan_to_num(self.errors), **BARS)
        axes.set_yticks(at, list(map(plain, self.causes)))
        axes.invert_yaxis()
        label(axes, self.title, self.x_label, "")
        axes.grid(visible=False, axis="y")
        axes.grid(visible=True, axis="x", color="0.92", linewidth=0.7)
        axes.set_xlim(left=0.0)
