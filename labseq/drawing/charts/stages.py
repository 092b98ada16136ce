"""How long the stages of a shot take, against their budgets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from labseq.drawing.charts.style import KEY_PT, label
from labseq.drawing.series import DARK, OTHER, QUOTED, plain
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
