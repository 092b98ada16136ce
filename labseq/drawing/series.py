"""Measured points with their errors, as the figures of a run show them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

DARK, LIGHT, OTHER, ANOTHER = "#1f4e8c", "#86b6e0", "#f28e2b", "#f7c48f"
QUOTED, LIMIT = "#c8102e", "0.5"
FRAME: Final = "0.35"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Points that belong together.

    Attributes:
        label: What the key calls them; plain text.
        x: float64 (n,), rising.
        y: float64 (n,), fractions.
        low: float64 (n,), lower ends of their errors; NaN where the error is not known.
        high: float64 (n,), upper ends.
    """

    label: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats


def span(series: Iterable[Series | None]) -> tuple[float, float]:
    """The lowest and the highest end of any point, in per cent."""
    ends = [values for one in series if one is not None for values in (one.y, one.low, one.high)]
    return 100 * float(np.nanmin(np.concatenate(ends))), 100 * float(np.nanmax(np.concatenate(ends)))


def paint_series(axes: Axes, series: Series, colour: str, marker: str, *, joined: bool) -> None:
    """Paint points with error bars, in per cent.

    Args:
        axes: The panel.
        series: The points.
        colour: Of points and bars.
        marker: matplotlib's name of the shape.
        joined: Whether a thin line leads from point to point.
    """
    y, low, high = (100 * values for values in (series.y, series.low, series.high))
    bars = np.nan_to_num(np.stack([y - low, high - y])).clip(min=0.0)
    look: dict[str, Any] = {"color": colour, "markersize": 5, "linewidth": 0.9, "capsize": 2, "capthick": 0.9}
    line = "-" if joined else "none"
    axes.errorbar(
        series.x, y, bars, label=plain(series.label), marker=marker, linestyle=line, zorder=3, **look
    )


def paint_quoted(axes: Axes, series: Series) -> None:
    """Paint points that were not measured here, as stars."""
    y, low, high = (100 * values for values in (series.y, series.low, series.high))
    look: dict[str, Any] = {
        "color": QUOTED,
        "marker": "*",
        "markersize": 11,
        "linestyle": "none",
        "capsize": 2,
    }
    rim: dict[str, Any] = {"markeredgecolor": "white", "markeredgewidth": 0.6}
    bars = np.stack([y - low, high - y])
    axes.errorbar(series.x, y, bars, label=plain(series.label), zorder=4, **look, **rim)


def tidy(axes: Axes) -> None:
    """Thin grey frame and ticks, a faint grid behind everything."""
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.7)
    axes.tick_params(color=FRAME, width=0.7, labelsize=9)
    axes.grid(visible=True, axis="y", color="0.92", linewidth=0.7)
    axes.set_axisbelow(True)


def plain(text: str) -> str:
    """A text in which mathtext finds nothing to set."""
    return text.replace("$", r"\$")
