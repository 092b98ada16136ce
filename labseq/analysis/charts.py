"""Charts of the figures that runs give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.model import SiteGrid
from labseq.pictures.figures import (
    DARK,
    LIGHT,
    OTHER,
    QUOTED,
    Series,
    cell,
    make_figure,
    outline,
    paint_series,
    place_sites,
    plain,
    save_figure,
    span,
    tidy,
)
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure

TITLE_PT: Final = 9
LABEL_PT: Final = 9
TICK_PT: Final = 8
KEY_PT: Final = 8

COLOURS: Final = "cividis"
"""Colour map of fractions: rises evenly in lightness, for every kind of colour vision and in print."""
NOTHING: Final = "0.94"
"""Of cells without a value."""


def label(axes: Axes, title: str, x: str, y: str) -> None:
    """Name a panel and its axes.

    Args:
        axes: The panel.
        title: What stands above it.
        x: What the x axis shows, with its unit.
        y: What the y axis shows, with its unit.
    """
    tidy(axes)
    axes.set_title(plain(title), fontsize=TITLE_PT, loc="left")
    axes.set_xlabel(plain(x), fontsize=LABEL_PT)
    axes.set_ylabel(plain(y), fontsize=LABEL_PT)
    axes.tick_params(labelsize=TICK_PT)


def count_along(axes: Axes, *, x: bool = True) -> None:
    """Let an axis tick at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis = axes.xaxis if x else axes.yaxis
    axis.set_major_locator(MaxNLocator(nbins=6, integer=True, min_n_ticks=1))


def finish_bar(bar: Colorbar, text: str) -> None:
    """Name a colour bar."""
    bar.set_label(plain(text), fontsize=LABEL_PT)
    bar.ax.tick_params(labelsize=TICK_PT, width=0.7)
    bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]


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


CURVES_COLOURS: Final = (DARK, OTHER, "#2a9d6f", "#a05195")
MARKERS: Final = "osD^"
ROOM: Final = 0.12
"""Room above and below the points, relative to their range."""
CURVES_MIN_RANGE: Final = 0.5
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
        for one, colour, marker in zip(self.series, CURVES_COLOURS, MARKERS, strict=False):
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
        room = ROOM * max(high - low, CURVES_MIN_RANGE)
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


DPI: Final = 150
PANEL_IN: Final = (3.7, 3.1)
"""Width and height of a panel where there are several, in inches."""
ALONE_IN: Final = (6.4, 4.4)
"""Those of a panel that is alone."""
HEAD_IN: Final = 0.55
"""Room for the title, in inches."""


class Chart(Protocol):
    """Paints itself into a panel."""

    def paint(self, axes: Axes) -> None:
        """Paint."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RunDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        rows: The charts, row by row; none of the rows is empty.
    """

    title: str
    note: str
    rows: tuple[tuple[Chart, ...], ...]


def save_run(path: Path, drawing: RunDrawing) -> None:
    """Draw charts of a run on a sheet.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: RunDrawing) -> Figure:
    n_rows, n_cols = len(drawing.rows), max(map(len, drawing.rows))
    width, height = ALONE_IN if n_rows == n_cols == 1 else (n_cols * PANEL_IN[0], n_rows * PANEL_IN[1])
    figure = make_figure(width, height + HEAD_IN, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # pyright: ignore[reportOptionalMemberAccess, reportCallIssue]
    parts = figure.subfigures(n_rows, 1, squeeze=False)[:, 0]
    for part, charts in zip(parts, drawing.rows, strict=True):
        for axes, chart in zip(part.subplots(1, len(charts), squeeze=False)[0], charts, strict=True):
            chart.paint(axes)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=10)
    return figure


SITES_MIN_RANGE: Final = 0.01
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
        return min(low, high - SITES_MIN_RANGE), high


ASIDE: Final = 0.17
"""Distance of the two clocks of a stage from its line, where there are two."""


@dataclass(frozen=True, slots=True)
class StageBar:
    """A stage.

    Attributes:
        name: Its name.
        clocks: Median and 99th percentile on each clock, in seconds; NaN where a clock tells nothing.
        budget_s: What it may take; NaN if it has no budget.
    """

    name: str
    clocks: tuple[tuple[float, float], ...]
    budget_s: float


@dataclass(frozen=True, slots=True, eq=False)
class StagesChart:
    """Stages below one another, on a logarithmic scale of time.

    Attributes:
        title: Stands above it.
        clocks: What the clocks are called.
        stages: The stages, in the order they come.
    """

    title: str
    clocks: tuple[str, ...]
    stages: tuple[StageBar, ...]

    def paint(self, axes: Axes) -> None:
        """Paint a point at the median, a line on to the 99th percentile, and a mark at the budget."""
        names = [stage.name for stage in self.stages]
        for clock, (name, colour) in enumerate(zip(self.clocks, (DARK, OTHER), strict=False)):
            aside = ASIDE * (2 * clock - 1) if len(self.clocks) > 1 else 0.0
            self._paint_clock(axes, clock, aside, colour, name)
        with_budget = [(i, stage.budget_s) for i, stage in enumerate(self.stages) if stage.budget_s > 0]
        if with_budget:
            y, x = zip(*with_budget, strict=True)
            look: dict[str, Any] = {"color": QUOTED, "linestyle": "none", "marker": "|"}
            axes.plot(x, y, label="budget", markersize=13, markeredgewidth=1.6, zorder=4, **look)
        axes.set_xscale("log")
        axes.set_yticks(range(len(names)), list(map(plain, names)))
        axes.set_ylim(len(names) - 0.5, -0.5)
        label(axes, self.title, "time: median, line to the 99th percentile", "")
        axes.grid(visible=False, axis="y")
        axes.grid(visible=True, axis="x", color="0.92", linewidth=0.7)
        self._write_times(axes)
        axes.legend(frameon=False, fontsize=KEY_PT, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3)

    def _paint_clock(self, axes: Axes, clock: int, aside: float, colour: str, name: str) -> None:
        shown = [(i + aside, *stage.clocks[clock]) for i, stage in enumerate(self.stages)]
        shown = [one for one in shown if one[1] > 0]
        for y, p50_s, p99_s in shown:
            axes.plot(
                [p50_s, max(p50_s, p99_s)],
                [y, y],
                color=colour,
                linewidth=1.6,
                solid_capstyle="round",
                zorder=2,
            )
        points = [(p50_s, y) for y, p50_s, _ in shown]
        x, y = zip(*points, strict=True) if points else ((), ())
        axes.plot(x, y, color=colour, marker="o", markersize=5, linestyle="none", label=plain(name), zorder=3)

    def _write_times(self, axes: Axes) -> None:
        """Decades as "1 ms", with room for all that is shown."""
        from matplotlib.ticker import FuncFormatter, NullFormatter

        times = [s for stage in self.stages for s in _times(stage)]
        low, high = (min(times), max(times)) if times else (1e-3, 1.0)
        axes.set_xlim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(1.05 * high)))
        axes.xaxis.set_major_formatter(FuncFormatter(_written))
        axes.xaxis.set_minor_formatter(NullFormatter())


def _written(time_s: float, _: object) -> str:
    return format_quantity(time_s, "time").replace("us", "µs")


def _times(stage: StageBar) -> Sequence[float]:
    return [s for s in (*(value for clock in stage.clocks for value in clock), stage.budget_s) if s > 0]
