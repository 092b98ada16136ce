"""A fraction for each site, on the lattice as it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.cells import cell, outline
from labseq.drawing.charts.style import COLOURS, NOTHING, TITLE_PT, finish_bar
from labseq.drawing.series import plain
from labseq.drawing.sheet import place_sites
from labseq.model import SiteGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MIN_RANGE: Final = 0.01
"""Least range of the colours."""
OUTLINE: Final = "#c8102e"
LOW_PART: Final = 0.02
"""So many of the sites may lie below the scale of colours: a site of few atoms must not take all of it."""


@dataclass(frozen=True, slots=True, eq=False)
class SitesChart:
    """A fraction for each site, in its cell.

    Attributes:
        title: Stands above it.
        label: What the colours show.
        grid: The grid of sites.
        values: float64 (n_rows, n_cols), fractions; NaN where there is none.
        outlined: bool (n_rows, n_cols), sites that a line is drawn around: the target.
    """

    title: str
    label: str
    grid: SiteGrid
    values: NDArray[np.float64]
    outlined: NDArray[np.bool_]

    def paint(self, axes: Axes) -> None:
        """Paint each site's cell, and the outline."""
        from matplotlib import colormaps
        from matplotlib.collections import LineCollection, PolyCollection

        rows, cols = np.indices(self.values.shape)
        places = place_sites(np.stack([rows.ravel(), cols.ravel()], axis=1), self.grid)
        cells = places[:, None] + cell(self.grid)
        colours = colormaps[COLOURS].with_extremes(bad=NOTHING, under="black")
        painted = PolyCollection(list(cells), cmap=colours, edgecolors="white", linewidths=0.3)
        painted.set_array(np.ma.masked_invalid(100 * self.values.ravel()))
        low, high = self._limits()
        painted.set_clim(100 * low, 100 * high)
        axes.add_collection(painted)
        line: dict[str, Any] = {"colors": OUTLINE, "linewidths": 1.0, "capstyle": "round"}
        axes.add_collection(LineCollection(list(outline(self.outlined, self.grid)), **line))
        x, y = cells.reshape(-1, 2).T
        axes.set_xlim(x.min() - 0.3, x.max() + 0.3)
        axes.set_ylim(y.max() + 0.3, y.min() - 0.3)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(plain(self.title), fontsize=TITLE_PT, loc="left")
        below = bool((self.values < low).any())
        bar = axes.figure.colorbar(
            painted, ax=axes, pad=0.02, shrink=0.85, extend="min" if below else "neither"
        )
        finish_bar(bar, self.label)

    def _limits(self) -> tuple[float, float]:
        known = self.values[np.isfinite(self.values)]
        if not len(known):
            return 0.0, 1.0
        low, high = float(np.quantile(known, LOW_PART)), float(known.max())
        return min(low, high - MIN_RANGE), high
