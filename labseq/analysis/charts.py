"""Panels of a run's picture: functions that draw on matplotlib axes."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.timing import Quantiles, StageStatistics
from labseq.data.images import average_frame, signals_of
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.model import SiteGrid
from labseq.model.estimate import Estimate, Estimated, Rate, mean
from labseq.pictures.figures import (
    DARK,
    LIGHT,
    ORANGE,
    RED,
    cell,
    outline,
    place_sites,
    show_plain_numbers,
)
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

Floats = NDArray[np.float64]
Panel = Callable[["Axes"], None]
"""A function that draws on axes."""

MAX_POINTS: Final = 200
"""Maximum number of points on the line of a running mean."""
MIN_SHARE: Final = 1e-3
"""Numbers of defects less probable than this are not drawn unless they occurred."""
MAX_BARS: Final = 40
"""Maximum number of bars in the histogram of defects."""
N_BINS: Final = 80
"""Number of bars in the histogram of signals."""
COLOURS: Final = "cividis"
"""Colour map of fractions. Its lightness rises evenly, for all kinds of colour vision and in print."""
DIVERGING: Final = "RdBu"
"""Colour map of deviations: red below, white at 0, blue above."""
NO_VALUE: Final = "0.94"
"""Grey of a cell without a value."""
MANY_BARS: Final = 15
"""Above this number of bars, the line has no markers, and empty bars have no error bars."""
MIN_RANGE_PERCENT: Final = 1.0
MAX_TICKS: Final = 10


STYLE: Final[dict[Any, Any]] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "0.35",
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "figure.titlesize": 10,
    "grid.color": "0.92",
    "grid.linewidth": 0.7,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "xtick.color": "0.35",
    "xtick.labelcolor": "black",
    "xtick.labelsize": 8,
    "xtick.major.width": 0.7,
    "ytick.color": "0.35",
    "ytick.labelcolor": "black",
    "ytick.labelsize": 8,
    "ytick.major.width": 0.7,
}
"""Settings of matplotlib: thin grey frames, a faint grid, small text."""


def points_of(x: Sequence[float], values: Sequence[Estimated]) -> Floats:
    """Means with the ends of their 1 sigma intervals. Unknown means are left out.

    Args:
        x: The x value of each mean.
        values: Means with standard errors, or rates with Jeffreys intervals.

    Returns:
        float64 (4, n): x, mean, lower and upper end.
    """
    rows = [
        (at, value.value, *value.interval)
        for at, value in zip(x, values, strict=True)
        if not math.isnan(value.value)
    ]
    return np.array(rows, np.float64).reshape(-1, 4).T


def trend(
    name: str, shots: Floats, values: Floats, *, is_yes_or_no: bool, unit: str = "%", scale: float = 100.0
) -> Panel | None:
    """A panel with a quantity of each shot and its running mean with error. None if no shot has a value.

    Args:
        shots: float64 (n,), indices of the shots.
        values: float64 (n,), a value for each shot, SI. nan if unknown.
        is_yes_or_no: True if each value is 0 or 1. The axis then goes from 0 to 100 %.
        unit: Unit in which the values are shown.
        scale: Factor from SI to this unit.
    """
    has_value = np.isfinite(values)
    if not has_value.any():
        return None
    shots, values = shots[has_value], values[has_value]
    window, running = running_mean(shots, values, is_yes_or_no=is_yes_or_no)

    def draw(axes: Axes) -> None:
        is_few = len(shots) <= 500
        look: dict[str, Any] = {"marker": "o", "markersize": 3 if is_few else 1, "markeredgewidth": 0}
        if is_yes_or_no:
            look = {
                "marker": "|",
                "markersize": 5 if is_few else 3,
                "markeredgewidth": 0.8 if is_few else 0.3,
            }
        # an SVG or PDF file with more marks than these is slow to open
        axes.plot(shots, scale * values, color=LIGHT, linestyle="none", rasterized=len(shots) > 2000, **look)
        x, y, low, high = running
        has_error = np.isfinite(low) & np.isfinite(high)
        axes.fill_between(
            x, scale * low, scale * high, where=has_error, color=DARK, alpha=0.2, linewidth=0, zorder=3
        )
        axes.plot(x, scale * y, color=DARK, linewidth=1.4, marker="o" if len(x) == 1 else "", zorder=4)
        averaged = "1 shot" if window == 1 else f"{window} shots"
        title, label = f"{name} by shot, line: mean of {averaged}", f"{name} ({unit})" if unit else name
        axes.set(title=title, xlabel="shot", ylabel=label)
        axes.set_xlim(shots[0] - 0.5, shots[-1] + 0.5)
        # -4 and 104 leave room for the marks at 0 and 100 %
        least = MIN_RANGE_PERCENT if unit == "%" else 0.0
        axes.set_ylim(*((-4.0, 104.0) if is_yes_or_no else _with_room(scale * values, 0.1, least)))
        whole_numbers(axes.xaxis)

    return draw


def running_mean(shots: Floats, values: Floats, *, is_yes_or_no: bool) -> tuple[int, Floats]:
    """The number of shots in a running mean, and the mean as :func:`points_of` returns it."""
    window = min(len(values), max(10, len(values) // 10))
    starts = np.unique(np.linspace(0, len(values) - window, MAX_POINTS).astype(np.int64))
    parts = [values[start : start + window].tolist() for start in starts]
    means = [Rate(round(math.fsum(part)), window) if is_yes_or_no else mean(part) for part in parts]
    return window, points_of(((shots[starts] + shots[starts + window - 1]) / 2).tolist(), means)


def draw_curves(
    axes: Axes,
    *,
    title: str,
    x_label: str,
    y_label: str,
    curves: Mapping[str, Floats],
    ticks: Sequence[str] = (),
    whole: bool = False,
    logarithmic: bool = False,
    from_zero: bool = False,
    scale: float = 100.0,
    line: Callable[[Floats], Floats] | None = None,
) -> None:
    """Draw values with error bars. Default: fractions in per cent.

    Args:
        curves: Name -> points, see :func:`points_of`, at least one point each.
        ticks: Text at x = 0, 1, 2, ... instead of numbers. The points are then not joined.
        scale: Factor on the values.
        line: A function of x that is drawn through the points instead of joining them.
    """
    for (name, (x, y, low, high)), colour, marker in zip(curves.items(), (DARK, ORANGE), "os", strict=False):
        # a value without an error has no bar
        bars = scale * np.nan_to_num([y - low, high - y]).clip(min=0.0)
        look: dict[str, Any] = {"markersize": 5, "linewidth": 0.9, "capsize": 2, "capthick": 0.9, "zorder": 3}
        style = "none" if ticks or line is not None else "-"
        axes.errorbar(x, scale * y, bars, label=name, color=colour, marker=marker, linestyle=style, **look)
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    all_x, *ends = np.concatenate([*curves.values()], axis=1)
    if line is not None:
        across = np.geomspace if logarithmic else np.linspace
        x = across(all_x.min(), all_x.max(), 200)
        axes.plot(x, scale * line(x), color=ORANGE, linewidth=1.2, zorder=2)
    if logarithmic:
        _plain_logarithmic(axes)
    elif ticks:
        set_labels(axes.xaxis, ticks)
    elif whole:
        whole_numbers(axes.xaxis)
    elif _fit_as_ticks(np.unique(all_x)):
        axes.set_xticks(np.unique(all_x))
    else:
        axes.ticklabel_format(axis="x", scilimits=(-3, 5))
    if whole or ticks:
        axes.set_xlim(all_x.min() - 0.5, all_x.max() + 0.5)
    low, high = _with_room(scale * np.concatenate(ends), 0.12, MIN_RANGE_PERCENT / 2 if scale == 100 else 0.0)
    axes.set_ylim(0.0 if from_zero else low, high)
    if len(curves) > 1:
        axes.legend()


def draw_map(
    axes: Axes,
    *,
    title: str,
    x_label: str,
    y_label: str,
    x_ticks: Sequence[str],
    y_ticks: Sequence[str],
    values: Floats,
    label: str,
    limits: tuple[float, float],
) -> None:
    """Draw values against two scanned values, with a cell for each pair.

    Args:
        values: float64 (len(y_ticks), len(x_ticks)), in the unit of the label. NaN if unknown.
    """
    from matplotlib import colormaps

    low, high = limits
    if high <= low:  # all values are the same
        low, high = (high - 0.01 * abs(high), high) if high else (0.0, 1.0)
    image = axes.imshow(
        np.ma.masked_invalid(values),
        origin="lower",
        aspect="auto",
        cmap=colormaps[COLOURS].with_extremes(bad=NO_VALUE),
        vmin=low,
        vmax=high,
    )
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    axes.grid(visible=False)
    set_labels(axes.xaxis, x_ticks, room=24, most=MAX_TICKS)
    set_labels(axes.yaxis, y_ticks, room=sys.maxsize, most=MAX_TICKS)  # never turned
    if max(values.shape) <= 6:  # the numbers fit into the cells
        for (row, col), value in np.ndenumerate(values):
            if np.isfinite(value):
                colour = "white" if value < (low + high) / 2 else "black"
                axes.text(col, row, f"{value:.3g}", ha="center", va="center", fontsize=8, color=colour)
    axes.figure.colorbar(image, ax=axes, pad=0.02, label=label)


def draw_sites(
    axes: Axes,
    *,
    title: str,
    label: str,
    grid: SiteGrid,
    values: Floats,
    outlined: NDArray[np.bool_],
    limit: float = 0.0,
) -> None:
    """Draw a fraction for each site in its cell.

    Args:
        values: float64 (n_rows, n_cols), fractions. NaN if unknown.
        outlined: bool (n_rows, n_cols), the target, around which a line is drawn.
        limit: For deviations instead of fractions. The colours then span -limit to limit.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection, PolyCollection

    rows, cols = np.indices(values.shape)
    cells = place_sites(np.stack([rows.ravel(), cols.ravel()], axis=1), grid)[:, None] + cell(grid)
    fractions = colormaps[COLOURS].with_extremes(bad=NO_VALUE, under="black")
    # the colour of no deviation is nearly white
    colours = colormaps[DIVERGING].with_extremes(bad="0.7") if limit else fractions
    filled = PolyCollection(list(cells), cmap=colours, edgecolors="white", linewidths=0.3)
    scale = 1.0 if limit else 100.0
    filled.set_array(np.ma.masked_invalid(scale * values.ravel()))
    finite = values[np.isfinite(values)]
    low, high = (-limit, limit) if limit else (0.0, 1.0)
    if len(finite) and not limit:  # a site with few atoms must not stretch the range
        high = float(finite.max())
        low = min(float(np.quantile(finite, 0.02)), high - 0.01)
    filled.set_clim(scale * low, scale * high)
    axes.add_collection(filled)
    line: dict[str, Any] = {"colors": RED, "linewidths": 1.0, "capstyle": "round"}
    axes.add_collection(LineCollection(list(outline(outlined, grid)), **line))
    x, y = cells.reshape(-1, 2).T
    axes.set(title=title, aspect="equal")
    axes.set_xlim(x.min() - 0.3, x.max() + 0.3)
    axes.set_ylim(y.max() + 0.3, y.min() - 0.3)  # downwards, as on a frame
    axes.set_axis_off()
    extend = "min" if (finite < low).any() else "neither"
    axes.figure.colorbar(filled, ax=axes, pad=0.02, shrink=0.85, extend=extend, label=label)


def defects(counts: Sequence[int], n_sites: int, n_all: int, end: str) -> Panel | None:
    """The share of shots with each number of defects, next to independent sites. None without any shots.

    Args:
        counts: Number of shots with 0, 1, 2, ... defects.
        n_sites: Number of sites of the target.
        n_all: Number of shots, including shots without a number of defects.
        end: When the defects were counted, such as "on the last image".
    """
    n_shots = sum(counts)
    if not n_shots or not n_sites:
        return None
    number = np.arange(len(counts))
    # if sites were independent, the number of defects would have a binomial distribution
    independent = binomial(n_sites, float(np.dot(counts, number)) / n_shots / n_sites, len(counts))
    padded_counts = np.pad(counts, (0, len(independent) - len(counts)))
    first = int(np.flatnonzero((padded_counts > 0) | (independent > MIN_SHARE))[0])
    width = -(-(len(independent) - first) // MAX_BARS)  # numbers of defects that a bar spans
    # from 0, if that leaves less than half of the picture empty
    first = 0 if width == 1 and first < MAX_BARS // 2 else first
    starts = np.arange(first, len(independent), width)
    expected = np.add.reduceat(independent, starts)
    shots_of_bar = np.add.reduceat(padded_counts, starts)[: np.searchsorted(starts, len(counts))]
    middles = (starts[: len(shots_of_bar)] + (width - 1) / 2).tolist()
    x, y, low, high = points_of(middles, [Rate(int(count), n_shots) for count in shots_of_bar])

    def draw(axes: Axes) -> None:
        errors = 100 * np.stack([y - low, high - y]).clip(min=0.0)
        shown = y > 0 if len(x) > MANY_BARS else np.ones(len(x), np.bool_)
        axes.bar(x, 100 * y, width=0.8 * width, color=LIGHT, label="shots")
        bars: dict[str, Any] = {"color": DARK, "capsize": 2, "elinewidth": 0.9, "capthick": 0.9}
        axes.errorbar(x[shown], 100 * y[shown], errors[:, shown], linestyle="none", **bars)
        size = 4 if len(x) <= MANY_BARS else 0
        look: dict[str, Any] = {"marker": "D", "markersize": size, "linewidth": 0.9, "linestyle": "--"}
        at = x[0] + width * np.arange(len(expected))
        axes.plot(at, 100 * expected, color=ORANGE, label="independent sites", zorder=3, **look)
        bar_note = f", {width} numbers to a bar" if width > 1 else ""
        average = mean(np.repeat(number, counts))
        title = f"{average} defects in a shot, {n_shots} of {n_all} shots"
        axes.set(title=title, xlabel=f"defects {end}{bar_note}", ylabel="shots (%)")
        least = x[0] - 0.6 * width
        # at least five bars wide, because a single bar would fill the picture
        axes.set_xlim(least, max(least + 5.2, x[-1] + 0.6 * width, at[-1] + 0.6 * width))
        axes.set_ylim(0.0, 135 * float(max(np.nanmax(high), expected.max())))  # with room for the legend
        whole_numbers(axes.xaxis)
        axes.legend()

    return draw


def binomial(n: int, p: float, n_least: int) -> Floats:
    """Probabilities of 0, 1, 2, ... of n independent events of probability p.

    The result ends at the last probability above 0.1 %, but has at least ``n_least`` values.

    Example:
        >>> binomial(2, 0.5, 1).round(6).tolist()
        [0.25, 0.5, 0.25]
    """
    from scipy.special import bdtr

    terms = np.diff(bdtr(np.arange(n + 1.0), n, p), prepend=0.0)
    likely = np.flatnonzero(terms > MIN_SHARE)
    return terms[: max(n_least, int(likely[-1]) + 1)]


def loss_causes(losses: Mapping[str, Estimate]) -> Panel | None:
    """Bars for the atoms lost to each cause in a simulation, most first. None if nothing was lost."""
    sorted_losses = sorted(losses.items(), key=lambda item: -item[1].value)
    rows = [
        (cause.replace("_", " "), loss.value, loss.error) for cause, loss in sorted_losses if loss.value > 0
    ]
    if not rows:
        return None

    def draw(axes: Axes) -> None:
        causes, means, errors = zip(*rows, strict=True)
        at = np.arange(len(rows))
        bars: dict[str, Any] = {
            "ecolor": DARK,
            "capsize": 2,
            "error_kw": {"elinewidth": 0.9, "capthick": 0.9},
        }
        axes.barh(at, means, height=0.65, color=LIGHT, xerr=np.nan_to_num(errors), **bars)
        axes.set_yticks(at, causes)
        axes.invert_yaxis()  # the worst at the top
        axes.set(title="lost in a shot, by cause", xlabel="atoms (known in the simulation)")
        _vertical_grid(axes)
        axes.set_xlim(left=0.0)

    return draw


def stages_of_a_shot(title: str, stages: Sequence[StageStatistics], clocks: Mapping[str, str]) -> Panel:
    """The times of a shot's stages, one below the other, on a logarithmic scale.

    A point shows the median, a line reaches to the 99th percentile, and a mark shows the budget.

    Args:
        stages: The stages, at least one.
        clocks: "session_s" and perhaps "host_s" -> name of the clock.
    """

    def draw(axes: Axes) -> None:
        from matplotlib.ticker import FuncFormatter, NullFormatter

        shown_s: list[float] = []
        for number, ((clock, name), colour) in enumerate(zip(clocks.items(), (DARK, ORANGE), strict=False)):
            aside = 0.17 * (2 * number - 1) if len(clocks) > 1 else 0.0
            shown: list[Quantiles] = [getattr(stage, clock) for stage in stages]
            p50, p99 = np.array([(time_s.p50, time_s.p99) for time_s in shown], np.float64).T
            # times below 1 us come from models that neglect a stage
            y = np.flatnonzero(p50 > (1e-6 if clock == "session_s" else 0.0))
            p50, p99 = p50[y], np.fmax(p50, p99)[y]
            axes.hlines(y + aside, p50, p99, color=colour, linewidth=1.6, capstyle="round")
            axes.plot(p50, y + aside, color=colour, marker="o", markersize=5, linestyle="none", label=name)
            shown_s += [*p50, *p99]
        budgets = np.array([stage.budget_s for stage in stages])
        y = np.flatnonzero(budgets > 0)
        if len(y):
            mark: dict[str, Any] = {"linestyle": "none", "marker": "|", "markersize": 13}
            axes.plot(budgets[y], y, color=RED, label="budget", zorder=4, markeredgewidth=1.6, **mark)
            shown_s += [*budgets[y]]
        low, high = (min(shown_s), max(shown_s)) if shown_s else (1e-3, 1.0)
        axes.set(title=title, xlabel="time: median, line to the 99th percentile", xscale="log")
        axes.set_xlim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(1.05 * high)))
        axes.xaxis.set_major_formatter(FuncFormatter(_time_text))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yticks(range(len(stages)), [stage.stage for stage in stages])
        axes.set_ylim(len(stages) - 0.5, -0.5)
        _vertical_grid(axes)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3)

    return draw


def average_frame_of(run: Run, shots: Sequence[Shot]) -> Panel:
    """The mean of the first frame that each shot keeps, with the sites."""
    image = -1 if run.record.get("record_frames") == "last" else 0
    average, n = average_frame(shots, image)
    sites_px = next((sites for shot in shots[:1] if (sites := shot.sites_px) is not None), None)

    def draw(axes: Axes) -> None:
        low, high = np.quantile(average, (0.01, 0.999))  # a hot pixel must not darken all others
        look: dict[str, Any] = {"cmap": "gray", "vmin": low, "vmax": max(high, low + 1e-9)}
        shown = axes.imshow(average, interpolation="nearest", **look)
        if sites_px is not None:
            y, x = sites_px.reshape(-1, 2).T
            rings: dict[str, Any] = {
                "markerfacecolor": "none",
                "markeredgecolor": RED,
                "markeredgewidth": 0.4,
            }
            axes.plot(x, y, "o", markersize=4, **rings)
            room, (height, width) = 0.08 * max(np.ptp(x), np.ptp(y), 40.0), average.shape
            axes.set_xlim(max(x.min() - room, -0.5), min(x.max() + room, width - 0.5))
            axes.set_ylim(min(y.max() + room, height - 0.5), max(y.min() - room, -0.5))
        title = f"mean of the {'last' if image else 'first'} frames of {n} shots"
        axes.set(title=title, xlabel="x (px)", ylabel="y (px)")
        axes.grid(visible=False)
        axes.figure.colorbar(shown, ax=axes, pad=0.02, shrink=0.85, label="mean counts (adu)")

    return draw


def signals_of_sites(shots: Sequence[Shot]) -> Panel:
    """Histogram of the detector's signals of all sites on the first image, with the thresholds."""
    signals, thresholds, unit = signals_of(shots)

    def draw(axes: Axes) -> None:
        axes.hist(signals[np.isfinite(signals)], N_BINS, color=LIGHT, edgecolor="none")
        low, middle, high = np.quantile(thresholds, (0.0, 0.5, 1.0))
        label = f"threshold {middle:.4g}"
        if high > low:
            label = f"median {label}, thresholds of the sites from {low:.4g} to {high:.4g}"
            axes.axvspan(low, high, color=RED, alpha=0.15, linewidth=0)
        axes.axvline(middle, color=RED, linewidth=1.2, label=label)
        total = f"{signals.size} signals on the first image of {len(signals)} shots"
        title = f"{total}, {int((signals > thresholds).sum())} above threshold"
        axes.set(title=title, xlabel=f"signal of a site ({unit})" if unit else "signal of a site")
        # logarithmic, because the tails of the peaks determine the errors
        axes.set(ylabel="sites", yscale="log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.legend()

    return draw


def whole_numbers(axis: Axis) -> None:
    """Put ticks at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins=6, integer=True, min_n_ticks=1))


def _time_text(time_s: float, _: object) -> str:
    return format_quantity(time_s, "time").replace("us", "µs")


def _with_room(values: Floats, room: float, min_range: float) -> tuple[float, float]:
    """Limits of an axis, with margins above and below relative to the range."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room *= max(high - low, min_range) or abs(high) or 1.0
    return low - room, high + room


def _fit_as_ticks(values: Floats) -> bool:
    """Whether each value can have a tick without overlapping labels."""
    # relative to the axis: a character is 2 % wide, and ticks closer than 9 % look crowded
    gap = max(0.09, 0.02 * (max(len(f"{value:g}") for value in values) + 1.5))
    return len(values) < 2 or bool(np.diff(values).min() >= gap * np.ptp(values) > 0)


def set_labels(axis: Axis, labels: Sequence[str], room: int = 32, most: int = 24) -> None:
    """Label the ticks at 0, 1, 2, ...

    Args:
        room: Labels with more characters than this in total are rotated.
        most: Maximum number of labels. If there are more, some are left out.
    """
    turned = len(labels) * max(map(len, labels)) > room
    at = range(0, len(labels), -(-len(labels) // most))
    axis.set_ticks(at, [labels[i] for i in at], rotation=90 if turned else 0)


def _vertical_grid(axes: Axes) -> None:
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")


def _plain_logarithmic(axes: Axes) -> None:
    """Make an x axis logarithmic, with as many plain numbers as fit."""
    axes.set_xscale("log")
    show_plain_numbers(axes.xaxis)
    axes.tick_params(which="both", labelsize=8)
