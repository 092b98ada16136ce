"""Pictures of comparisons: scaling with array size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.pictures.figures import make_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 150
PANEL_IN: Final = (5.4, 4.2)
"""Width and height of a panel, in inches."""
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X")
_POINTS_OF_A_LAW: Final = 50


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Means over something that differs.

    Attributes:
        label: What the key calls it; mathtext.
        x: float64 (n,), rising.
        y: float64 (n,), NaN where there is nothing.
        error: float64 (n,), standard errors.
        law: Factor and exponent of a power law, drawn as a line; None: straight lines from point to point.
        is_limit: Whether it is no planner's but a limit, drawn dashed and grey.
        is_quoted: Whether it was not measured here; drawn as stars.
    """

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    error: NDArray[np.float64]
    law: tuple[float, float] | None = None
    is_limit: bool = False
    is_quoted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """How often something was counted.

    Attributes:
        label: What the key calls it; mathtext.
        counts: int64 (largest number + 1,), how often each number came, from 0.
    """

    label: str
    counts: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonDrawing:
    """What is drawn; a panel each for curves and histograms, if there are any.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        x_label: What differs between the points of the curves.
        y_label: What the curves are means of.
        counted: What the histograms count.
        curves: The curves.
        histograms: The histograms.
        logarithmic: Whether both axes of the curves are.
    """

    title: str
    note: str
    x_label: str
    y_label: str
    counted: str
    curves: tuple[Curve, ...] = ()
    histograms: tuple[Histogram, ...] = ()
    logarithmic: bool = False


def save_comparison(path: Path, drawing: ComparisonDrawing) -> None:
    """Draw a comparison.

    Args:
        path: The PNG file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: ComparisonDrawing) -> Figure:
    n_panels = max(1, bool(drawing.curves) + bool(drawing.histograms))
    figure = make_figure(n_panels * PANEL_IN[0], PANEL_IN[1], layout="constrained")
    panels = list(figure.subplots(1, n_panels, squeeze=False)[0])
    if drawing.histograms:
        _draw_histograms(panels[0], drawing)
    if drawing.curves:
        _draw_curves(panels[-1], drawing)
    figure.suptitle(f"{drawing.title}\n{drawing.note}".rstrip(), fontsize=9)
    return figure


def _draw_curves(axes: Axes, drawing: ComparisonDrawing) -> None:
    logarithmic = drawing.logarithmic and any((curve.y > 0.0).any() for curve in drawing.curves)
    for i, curve in enumerate(drawing.curves):
        look = _look(curve, i)
        there = curve.y > 0.0 if logarithmic else np.isfinite(curve.y)
        x, y = curve.x[there], curve.y[there]
        error = np.where(np.isfinite(curve.error[there]), curve.error[there], 0.0)
        joined: dict[str, Any] = {} if curve.law is None and not curve.is_quoted else {"linestyle": "none"}
        axes.errorbar(x, y, error, label=curve.label, **{**look, **joined})
        if curve.law is not None and len(x):
            factor, exponent = curve.law
            along = np.geomspace(x[0], x[-1], _POINTS_OF_A_LAW)
            bare: dict[str, Any] = {**look, "marker": ""}
            axes.plot(along, factor * along**exponent, **bare)
    if logarithmic:
        _make_logarithmic(axes)
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel(drawing.x_label)
    axes.set_ylabel(drawing.y_label)
    axes.legend(frameon=False, fontsize=8)


def _look(curve: Curve, index: int) -> dict[str, Any]:
    if curve.is_quoted:
        return {"color": "0.2", "marker": "*", "markersize": 9, "linestyle": "-"}
    if curve.is_limit:
        return {"color": "0.5", "marker": "_", "markersize": 6, "linestyle": "--", "linewidth": 1}
    marker = MARKERS[index % len(MARKERS)]
    return {"color": f"C{index}", "marker": marker, "markersize": 5, "linestyle": "-", "linewidth": 1}


def _make_logarithmic(axes: Axes) -> None:
    """Both axes logarithmic, with plain numbers as far as there is room for them."""
    from matplotlib.ticker import LogFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(LogFormatter())
        axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))


def _draw_histograms(axes: Axes, drawing: ComparisonDrawing) -> None:
    for i, histogram in enumerate(drawing.histograms):
        counts = histogram.counts
        seen = np.flatnonzero(counts)
        if len(seen):
            first, last = int(seen[0]), int(seen[-1])
            edges = np.arange(first, last + 2) - 0.5
            share = counts[first : last + 1] / counts.sum()
            axes.stairs(share, edges, fill=True, color=f"C{i % 10}", alpha=0.45, label=histogram.label)
            axes.stairs(share, edges, color=f"C{i % 10}", linewidth=1)
    axes.set_xlabel(drawing.counted)
    axes.set_ylabel("share of the loadings")
    if any(histogram.counts.any() for histogram in drawing.histograms):
        axes.legend(frameon=False, fontsize=8)
