"""Pictures of calibrations."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.pictures.figures import make_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

WIDTH_IN: Final = 9.0
N_BINS: Final = 120
SITE, ARROW = "#e8a33d", "#c8102e"


def draw_sites(mean: Floats, positions_px: Floats, residuals_px: Floats) -> Figure:
    """Draw an averaged frame with the sites on it, and the distance of each spot from its site.

    Args:
        mean: float64 (height, width), the averaged frame, in counts.
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site in pixels.
        residuals_px: float64 (n_rows, n_cols, 2), (y, x) of each spot minus its site. NaN if not found.
    """
    spacing = _spacing_px(positions_px)
    y, x = positions_px.reshape(-1, 2).T
    room = 2.0 * spacing
    wide, high = np.ptp(x) + 2 * room, np.ptp(y) + 2 * room
    figure = make_figure(WIDTH_IN, WIDTH_IN * high / wide + 0.6, layout="constrained")
    axes = figure.add_subplot()
    dark, bright = np.quantile(mean, [0.01, 0.999])
    axes.imshow(mean, cmap="gray", vmin=dark, vmax=max(bright, dark + 1e-9), interpolation="nearest")
    axes.set_xlim(x.min() - room, x.max() + room)
    axes.set_ylim(y.max() + room, y.min() - room)
    has_spot = np.isfinite(residuals_px[..., 0]).ravel()
    size = 0.6 * spacing / wide * WIDTH_IN * 72
    for selected, marker, label in ((has_spot, "o", "site"), (~has_spot, "x", "site without a spot")):
        if selected.any():
            axes.plot(
                *(x[selected], y[selected], marker),
                label=label,
                color=SITE,
                markersize=size,
                fillstyle="none",
                markeredgewidth=0.8,
            )
    axes.plot(x[:1], y[:1], "s", color=SITE, markersize=1.4 * size, fillstyle="none", label="row 0, column 0")
    longest = _draw_arrows(axes, x[has_spot], y[has_spot], residuals_px.reshape(-1, 2)[has_spot], spacing)
    axes.set_title(f"arrows: distance of spots from their sites, {longest:.2g} px at most")
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.legend(loc="upper right", fontsize="small", markerscale=0.5)
    return figure


def _draw_arrows(axes: Axes, x: Floats, y: Floats, off_px: Floats, spacing_px: float) -> float:
    """Draw the enlarged distances of spots from their sites, and return the longest, in pixels."""
    longest = float(np.hypot(*off_px.T).max(initial=0.0))
    if longest > 0:
        # the longest is as long as half a spacing
        along_y, along_x = 0.5 * spacing_px / longest * off_px.T
        to_scale: Any = {"angles": "xy", "scale_units": "xy", "scale": 1.0}
        axes.quiver(x, y, along_x, along_y, color=ARROW, width=0.0015, **to_scale)
    return longest


def draw_thresholds(signals: Floats, thresholds: Floats, unit: str) -> Figure:
    """Draw the histogram of all signals, and each site's signals with its threshold.

    Args:
        signals: float64 (n_frames, n_rows, n_cols), the detector's signals.
        thresholds: float64 (n_rows, n_cols).
        unit: Unit of signals and thresholds: "counts", "log-odds".
    """
    figure = make_figure(WIDTH_IN, 7.0, layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=[2, 3])
    low, high = np.quantile(signals, [0.001, 0.999])
    edges = np.linspace(low, high, N_BINS + 1)
    above.hist(signals.ravel(), edges, color="0.6", log=True)
    above.axvspan(float(thresholds.min()), float(thresholds.max()), color=SITE, alpha=0.5, label="thresholds")
    above.set(xlabel=f"signal of all sites ({unit})", ylabel="signals")
    by_site = signals.reshape(len(signals), -1).T
    counts = np.stack([np.histogram(site_signals, edges)[0] for site_signals in by_site], axis=1)
    extent = (-0.5, len(by_site) - 0.5, low, high)
    # logarithmic, because the few signals between the peaks matter
    below.imshow(np.log1p(counts), cmap="gray_r", aspect="auto", origin="lower", extent=extent)
    site = np.arange(len(by_site))
    below.step(site, thresholds.ravel(), where="mid", color=ARROW, linewidth=0.8, label="threshold")
    below.set(xlabel="site, row by row", ylabel=f"signal ({unit})")
    for axes in (above, below):
        axes.legend(loc="upper right", fontsize="small")
    return figure


def _spacing_px(positions_px: Floats) -> float:
    """Smallest distance of neighbours along rows and columns, in pixels. A guess for a single site."""
    steps = [np.diff(positions_px, axis=axis).reshape(-1, 2) for axis in (0, 1)]
    lengths = np.hypot(*np.concatenate(steps).T)
    return float(np.median(lengths)) if len(lengths) else 10.0


DIRECTIONS: Final = ("along a row", "from row to row")
POINT, CURVE = "#1b5e8c", "#c8102e"


def draw_survival(
    offset_m: Floats,
    n_before: NDArray[np.int64],
    n_survived: NDArray[np.int64],
    survival: Callable[[Floats], Floats],
) -> Figure:
    """Draw survival against the offset on each axis.

    Args:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int64 (n_points,), number of probed atoms.
        n_survived: int64 (n_points,), number of surviving atoms.
        survival: The fitted function from offsets (n, 2) to probabilities (n,).
    """
    figure = make_figure(8.0, 4.0, layout="constrained")
    middle = np.median(offset_m, axis=0)
    for axis, axes in enumerate(figure.subplots(1, 2, sharey=True)):
        # the scan is a cross, so take only the points of its arm along this axis, within rounding
        on_line = np.abs(offset_m[:, 1 - axis] - middle[1 - axis]) < 1e-9
        x_m, n, k = offset_m[on_line, axis], np.maximum(n_before[on_line], 1), n_survived[on_line]
        # half an atom is added to both counts, so that the error is not 0 if all survive
        error = np.sqrt((k + 0.5) * (n - k + 0.5) / (n + 1)) / (n + 1)
        axes.errorbar(1e6 * x_m, k / n, error, fmt="o", color=POINT, markersize=4, label="atoms")
        line_m = np.repeat(middle[None], 200, axis=0)
        line_m[:, axis] = np.linspace(offset_m[:, axis].min(), offset_m[:, axis].max(), 200)
        axes.plot(1e6 * line_m[:, axis], survival(line_m), color=CURVE, label="fit")
        axes.set(xlabel=f"offset {DIRECTIONS[axis]} (um)", ylim=(-0.02, 1.02))
    figure.axes[0].set_ylabel("survival")
    figure.axes[0].legend(fontsize="small")
    return figure


def draw_tone_offsets(rows: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> Figure:
    """Draw the distances of the tweezers of each row and column from their sites.

    Args:
        rows: Offset from row to row and its standard error, each float64 (n_rows,), in metres.
        columns: Offset along a row and its standard error, each float64 (n_cols,).
    """
    figure = make_figure(8.0, 4.0, layout="constrained")
    for axes, name, (off_m, error_m), direction in zip(
        figure.subplots(1, 2), ("row", "column"), (rows, columns), reversed(DIRECTIONS), strict=True
    ):
        axes.errorbar(np.arange(len(off_m)), 1e9 * off_m, 1e9 * error_m, fmt="o", color=POINT, markersize=4)
        axes.set(xlabel=name, ylabel=f"offset {direction} (nm)")
    return figure


SIZE_IN: Final = (8.4, 5.6)


def draw_powers(
    before: Floats, after: Floats, rows: Floats, cols: Floats, label: str = "tone (% of full scale)"
) -> Figure:
    """Draw maps of the powers, relative to their means, and the resulting amplitudes.

    Args:
        before: float64 (n_rows, n_cols), powers at the start. nan if unknown.
        after: float64 (n_rows, n_cols), powers at the end.
        rows: float64 (n_rows,), amplitudes of the rows' tones, fractions of full scale.
        cols: float64 (n_cols,), amplitudes of the columns' tones.
        label: Label of the bars of rows and columns. For tweezers without tones they show mean weights.
    """
    figure = make_figure(*SIZE_IN, layout="constrained")
    panels = figure.subplots(2, 2, height_ratios=(2.2, 1.0))
    maps = [power / np.nanmean(power) - 1 for power in (before, after)]
    # at least 5 %, or noise would look like a pattern
    most = max(0.05, *(float(np.nanmax(np.abs(deviation))) for deviation in maps))
    for axes, deviation, title in zip(panels[0], maps, ("before", "after"), strict=True):
        axes.imshow(100 * deviation, cmap="RdBu_r", vmin=-100 * most, vmax=100 * most)
        axes.set(
            title=f"{title}: {100 * float(np.nanstd(deviation)):.1f} % r.m.s.", xlabel="column", ylabel="row"
        )
        _count(axes.xaxis)
        _count(axes.yaxis)
    bar = figure.colorbar(panels[0][0].images[0], ax=panels[0], shrink=0.9)
    bar.set_label("deviation from the mean (%)")
    for axes, amplitudes, name in zip(panels[1], (rows, cols), ("row", "column"), strict=True):
        axes.bar(np.arange(len(amplitudes)), 100 * amplitudes, color="#1f4e8c")
        axes.set(ylim=(0, 115 * float(amplitudes.max())), xlabel=name, ylabel=label)
        _count(axes.xaxis)
    return figure


def _count(axis: Axis) -> None:
    """Put ticks of an axis at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
