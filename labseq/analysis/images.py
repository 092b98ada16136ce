"""Panels of the average image, the loading of each site, and the detector's signals with their thresholds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.charts import Panel, draw_sites
from labseq.model import SiteGrid
from labseq.pictures.figures import LIGHT, RED
from labseq.recording import Run, Shot
from labseq.recording.images import average_frame, loading_map, signals_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

N_BINS: Final = 80
BRIGHTEST: Final = 0.999
"""Quantile of the mean counts that is drawn white."""


def average_panel(run: Run, shots: Sequence[Shot]) -> Panel:
    """The mean of the first frame that each shot keeps, with the sites."""
    image = -1 if run.record.get("record_frames") == "last" else 0
    mean, n = average_frame(shots, image)
    sites = next((sites for shot in shots[:1] if (sites := shot.sites_px) is not None), None)
    which = "last" if image else "first"
    return partial(_draw_average, title=f"mean of the {which} frames of {n} shots", mean=mean, sites_px=sites)


def loading_panel(grid: SiteGrid, run: Run, shots: Sequence[Shot]) -> Panel:
    """The fraction of the shots with an atom on each site, on the first image."""
    values, n = loading_map(shots)
    title = f"loading: {100 * values.mean():.1f} % on the first image of {n} shots"
    label = "with an atom (%)"
    return partial(draw_sites, title=title, label=label, grid=grid, values=values, outlined=run.target.fill)


def signals_panel(run: Run, shots: Sequence[Shot]) -> Panel:
    """Histogram of the detector's signals of all sites on the first image, with the thresholds."""
    del run
    signals, thresholds, unit = signals_of(shots)
    n_atoms = int((signals > thresholds).sum())
    title = f"{signals.size} signals on the first image of {len(signals)} shots, {n_atoms} above threshold"
    return partial(
        _draw_signals, title=title, unit=unit, signals=signals.ravel(), thresholds=thresholds.ravel()
    )


def _draw_average(axes: Axes, *, title: str, mean: Floats, sites_px: Floats | None) -> None:
    low, high = np.quantile(mean, (0.01, BRIGHTEST))
    shown = axes.imshow(mean, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    if sites_px is not None:
        y, x = sites_px.reshape(-1, 2).T
        axes.plot(x, y, "o", markersize=4, markerfacecolor="none", markeredgecolor=RED, markeredgewidth=0.4)
        room = 0.08 * max(np.ptp(x), np.ptp(y), 40.0)
        axes.set_xlim(max(x.min() - room, -0.5), min(x.max() + room, mean.shape[1] - 0.5))
        axes.set_ylim(min(y.max() + room, mean.shape[0] - 0.5), max(y.min() - room, -0.5))
    axes.set(title=title, xlabel="x (px)", ylabel="y (px)")
    axes.grid(visible=False)
    axes.figure.colorbar(shown, ax=axes, pad=0.02, shrink=0.85, label="mean counts (adu)")


def _draw_signals(axes: Axes, *, title: str, unit: str, signals: Floats, thresholds: Floats) -> None:
    axes.hist(signals[np.isfinite(signals)], N_BINS, color=LIGHT, edgecolor="none")
    low, middle, high = np.quantile(thresholds, (0.0, 0.5, 1.0))
    label = f"threshold {middle:.4g}"
    if high > low:
        label = f"median {label}; thresholds of the sites from {low:.4g} to {high:.4g}"
        axes.axvspan(low, high, color=RED, alpha=0.15, linewidth=0)
    axes.axvline(middle, color=RED, linewidth=1.2, label=label)
    axes.set(title=title, xlabel=f"signal of a site ({unit})" if unit else "signal of a site", ylabel="sites")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend()
