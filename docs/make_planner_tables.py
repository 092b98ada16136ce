"""Measure the planners again: the tables and pictures of their page, or one figure of the paper.

    python docs/make_planner_tables.py --loadings 10000
    python docs/make_planner_tables.py --figure 2b --loadings 1000 [--output figure-2b.png]

The first command replaces the parts of the page between ``<!-- measured: NAME -->`` and ``<!-- end -->``.
Times are those of this machine: let nothing else run. The second draws one of the paper's figures 2b, 2c,
3a and 3b. What the paper leaves open is chosen here: the size of the grid next to that of the target, and
in figure 3 the degree of parallelism; see ``docs/explanation/planners.md``.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter
from numpy.typing import ArrayLike, NDArray

from labseq.bench.comparison import (
    BARE_MOTION,
    Comparison,
    Condition,
    PlannerEntry,
    read_comparison,
)
from labseq.bench.planners import Resources, compare
from labseq.bench.report import Report, Row, draw_histogram
from labseq.model.estimate import Estimate
from labseq.units import format_quantity

DOCS = Path(__file__).parent
PAGE = DOCS / "explanation" / "planners.md"
PICTURES = DOCS / "_static" / "planners"

PLANNERS = "psca,psca:variant=paper,tetris,mta1,hca,compression,lsap,lsap_squared"
SIZES = ((20, 15), (30, 22), (64, 48))


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table."""
    return ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)]


def planners(n_loadings: int) -> list[str]:
    """All planners side by side, one after the other so that times are true."""
    comparison = read_comparison(planners=PLANNERS, dop="15", loadings=n_loadings)
    report = compare(comparison, Resources(1))
    header = (
        "planner",
        "batches",
        "atoms moved",
        "distance",
        "motion",
        "planning",
        "target met",
        "to the bound",
    )
    command = f"labseq bench planners --planners {PLANNERS} --dop 15 --loadings {n_loadings} --workers 1"
    return [*shown(command), *markdown(header, map(planner_cells, report.rows))]


def planner_cells(row: Row) -> list[str]:
    batches, motion_s = row["n_batches"], row["motion_s"]
    scans = f" ({row['n_scans']} scans)" if row.scans else ""
    scan_s = f" ({row['scan_s'].scaled(1e3)} ms)" if row.scans else ""
    return [
        f"`{row.planner_entry.label}`",
        f"{batches}{scans}",
        str(row["n_atoms_moved"]),
        f"{row['distance_m'].scaled(1e3)} mm",
        f"{motion_s.scaled(1e3)} ms{scan_s}",
        format_quantity(row["planning_s"]["median"], "time"),
        f"{100 * row['target_met'].value:.4g} %",
        str(row["ratio_to_bound"]),
    ]


def sizes(n_loadings: int) -> list[str]:
    """PSCA in growing arrays."""
    rows: list[list[str]] = []
    for grid, side in SIZES:
        target = f"{{pattern: compact, rows: {side}, cols: {side}}}"
        comparison = read_comparison(grid=f"{grid}x{grid}", target=target, dop="15", loadings=n_loadings)
        (row,) = compare(comparison, Resources(1)).rows
        times = [format_quantity(s, "time") for s in (row["planning_s"]["median"], row["planning_s"]["p99"])]
        rows.append([f"{grid} x {grid} to {side} x {side}", str(row["n_batches"]), *times])
    command = 'labseq bench planners --dop 15 --grid 64x64 --target "{pattern: compact, rows: 48, cols: 48}"'
    return [
        *shown(f"{command} --loadings {n_loadings} --workers 1"),
        *markdown(("size", "batches", "planning, median", "99 %"), rows),
    ]


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """``factor * x ** exponent``."""

    factor: float
    exponent: Estimate


def fit_power_law(x: ArrayLike, y: ArrayLike, errors: ArrayLike) -> PowerLaw | None:
    """Fit a straight line to the logarithms, weighted by the errors.

    Measured means never follow a power law to within their tiny errors, so the
    exponent's error comes from the scatter about the line: the weights tell only
    how the points compare.

    Args:
        x: Positive values, such as numbers of atoms; those of points that cannot
            be used (no positive value, no error) are left out.
        y: Means.
        errors: Their standard errors.

    Returns:
        The fit; None with fewer than three usable points.

    Example:
        >>> law = fit_power_law([1, 4, 9], [2.0, 4.1, 5.9], [0.1, 0.1, 0.1])
        >>> print(law.exponent)
        0.48(2)
    """
    x, y, errors = (np.asarray(values, np.float64) for values in (x, y, errors))
    usable = (x > 0) & (y > 0) & (errors > 0)
    if np.count_nonzero(usable) < 3:
        return None
    log_x, log_y = np.log(x[usable]), np.log(y[usable])
    weight = (y[usable] / errors[usable]) ** 2
    weight /= weight.sum()
    mid_x, mid_y = weight @ log_x, weight @ log_y
    spread = weight @ (log_x - mid_x) ** 2
    if spread == 0.0:
        return None
    slope = float(weight @ ((log_x - mid_x) * (log_y - mid_y)) / spread)
    rest = log_y - mid_y - slope * (log_x - mid_x)
    scatter = float(weight @ rest**2) / (len(rest) - 2)
    exponent = Estimate(slope, math.sqrt(scatter / float(spread)))
    return PowerLaw(math.exp(float(mid_y) - slope * float(mid_x)), exponent)


Quantity = Literal["n_target_atoms", "degree_of_parallelism", "n_batches", "motion_s"]


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the paper.

    Attributes:
        name: Its name in the paper.
        title: What is compared, and how.
        x: What differs between the conditions.
        y: What is drawn over it.
        planner_entries: A curve each.
        conditions: A point each.
        fitted: Whether the curves are power laws of x.
        paper: The paper's result, as text.
        paper_points: The paper's points: (x, y) each.
        histograms_at: Degrees of parallelism for which the first planner's batches are drawn as histograms.
    """

    name: str
    title: str
    x: Quantity
    y: Quantity
    planner_entries: tuple[PlannerEntry, ...]
    conditions: tuple[Condition, ...]
    fitted: bool
    paper: str
    paper_points: tuple[tuple[float, float], ...] = ()
    histograms_at: tuple[int, ...] = ()


PSCA: Final = PlannerEntry("psca")
PSCA_OF_THE_PAPER: Final = PlannerEntry("psca", (("variant", "paper"),))
ROWS_X_COLUMNS: Final = PlannerEntry("grid")

EBADI: Final = (("speed", "75 um/ms"), ("pick_up", "15 us"), ("drop_off", "15 us"))
"""Transport speed and capture time of S. Ebadi et al., Nature 595, 227 (2021)."""


def _compact(side: int) -> Condition:
    """A centred square, four sites of the grid for three of the target along each side, as 20 for 15."""
    grid = round(side * 4 / 3)
    return Condition((grid, grid), f"{{pattern: compact, rows: {side}, cols: {side}}}", 0.75, 15)


def _interleaved(side: int) -> Condition:
    """Target rows with a reservoir row after each, and a tenth of the columns more on both sides.

    At 55 % loading that makes 1.32 atoms per target site, nearly as many as 20 x 20
    for 15 x 15 at 75 %. All atoms of a line may move at once.
    """
    rows, cols = 2 * side, round(1.2 * side)
    limits = ("max_tweezers", "max_row_tones", "max_column_tones")
    motion = (*BARE_MOTION, *EBADI, *((limit, str(rows)) for limit in limits))
    return Condition(
        (rows, cols), f"{{pattern: interleaved, rows: {side}, cols: {side}}}", 0.55, rows, motion
    )


_COMPACT: Final = tuple(_compact(side) for side in (6, 9, 12, 15))
_INTERLEAVED: Final = tuple(_interleaved(side) for side in (5, 7, 10, 13, 15, 18, 20))
_MTA1: Final = (PSCA, PSCA_OF_THE_PAPER, PlannerEntry("mta1"))

FIGURES: Final[Mapping[str, Figure]] = MappingProxyType(
    {
        figure.name: figure
        for figure in (
            Figure(
                name="2b",
                title="compact targets, 75 % loading, degree of parallelism 15",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=(PSCA, PSCA_OF_THE_PAPER, ROWS_X_COLUMNS, PlannerEntry("lsap_squared")),
                conditions=_COMPACT,
                fitted=True,
                paper="PSCA 0.48(2), modified LSAP 1.16(1)",
            ),
            Figure(
                name="2c",
                title="15 x 15 out of 20 x 20, 75 % loading",
                x="degree_of_parallelism",
                y="n_batches",
                planner_entries=(PSCA, PSCA_OF_THE_PAPER, ROWS_X_COLUMNS),
                conditions=tuple(
                    Condition((20, 20), "{pattern: compact, rows: 15, cols: 15}", 0.75, dop)
                    for dop in range(2, 16)
                ),
                fitted=False,
                paper="PSCA 160.0(2) batches at 2, 29.61(3) at 15",
                paper_points=((2, 160.0), (15, 29.61)),
                histograms_at=(2, 3, 5, 7, 15),
            ),
            Figure(
                name="3a",
                title="interleaved targets, 55 % loading, any degree of parallelism",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="PSCA 0.388(2), MTA1 0.47(1)",
            ),
            Figure(
                name="3b",
                title="interleaved targets, 55 % loading, any degree of parallelism",
                x="n_target_atoms",
                y="motion_s",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="at 400 atoms PSCA takes a quarter of MTA1's time",
            ),
        )
    }
)
"""Name -> figure."""


AXES: Final[Mapping[Quantity, str]] = {
    "n_target_atoms": "atoms in the target, N",
    "degree_of_parallelism": "degree of parallelism",
    "n_batches": "mean number of batches",
    "motion_s": "mean time of ramps and transport (ms)",
}
"""Labels of the axes."""
BOUND: Final = "bound"
"""Label of the number of rows and columns that cover the vacancies."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """One curve of a figure.

    Attributes:
        label: The planner, and what is counted if not batches; or the bound.
        x: float64 (n,).
        y: float64 (n,), means.
        error: float64 (n,), their standard errors.
        law: The power law through them; None if the figure has none or the points are too few.
    """

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    error: NDArray[np.float64]
    law: PowerLaw | None


def points_of(report: Report, figure: Figure) -> list[Points]:
    """Each planner's points, and the bound where batches are counted."""
    found: list[Points] = []
    for planner_entry in report.comparison.planner_entries:
        rows = report.rows_of(planner_entry)
        label = f"{planner_entry.label} (scans)" if any(row.scans for row in rows) else planner_entry.label
        found.append(_points(label, rows, figure, [_y(row, figure.y) for row in rows]))
    if figure.y == "n_batches":
        rows = report.rows_of(report.comparison.planner_entries[0])
        found.append(_points(BOUND, rows, figure, [row["bound"] for row in rows]))
    return found


def _points(label: str, rows: list[Row], figure: Figure, y: list[Estimate]) -> Points:
    x = np.array([_x(row, figure.x) for row in rows], np.float64)
    means = np.array([one.value for one in y], np.float64)
    errors = np.array([one.error for one in y], np.float64)
    return Points(label, x, means, errors, fit_power_law(x, means, errors) if figure.fitted else None)


def _x(row: Row, quantity: Quantity) -> float:
    return row["n_target_atoms"] if quantity == "n_target_atoms" else row["degree_of_parallelism"]


def _y(row: Row, quantity: Quantity) -> Estimate:
    """As the planner's paper counts it."""
    if quantity == "motion_s":
        return row["scan_s"] if row.scans else row["motion_s"]
    return row["n_scans"] if row.scans else row["n_batches"]


def draw_figure(path: Path, report: Report, figure: Figure) -> None:
    """Draw a figure: histograms on the left if it has any, curves with their power laws on the right."""
    first = report.comparison.planner_entries[0]
    rows = [row for row in report.rows_of(first) if row["degree_of_parallelism"] in figure.histograms_at]
    n_panels = 2 if rows else 1
    drawing, panels = plt.subplots(
        1, n_panels, figsize=(5.4 * n_panels, 4.2), layout="constrained", squeeze=False
    )
    for i, row in enumerate(rows):
        draw_histogram(panels[0, 0], row.counts, f"C{i}", f"DOP {row['degree_of_parallelism']}")
    if rows:
        panels[0, 0].set(xlabel=f"batches of {first.label}", ylabel="share of the loadings")
        panels[0, 0].legend(frameon=False, fontsize=8)
    draw_curves(panels[0, -1], points_of(report, figure), figure)
    note = f"{report.extent_text}\nthe paper: {figure.paper}"
    drawing.suptitle(f"figure {figure.name}: {figure.title}\n{note}", fontsize=9)
    drawing.savefig(path, dpi=150, metadata={"Software": None})
    plt.close(drawing)


def draw_curves(axes: Axes, curves: Sequence[Points], figure: Figure) -> None:
    """Draw means with errors, their power laws, the bound dashed, and the paper's points as stars."""
    unit = 1e3 if figure.y == "motion_s" else 1.0
    for i, points in enumerate(curves):
        look: dict[str, Any] = {"color": f"C{i}", "marker": "os^DvPX"[i % 7], "markersize": 5, "linewidth": 1}
        line = "-"
        if points.label == BOUND:
            look |= {"color": "0.5", "marker": "_", "markersize": 6}
            line = "--"
        there = points.y > 0.0 if figure.fitted else np.isfinite(points.y)
        x, y, error = points.x[there], unit * points.y[there], unit * np.nan_to_num(points.error[there])
        label = points.label if points.law is None else f"{points.label}: $N^{{{points.law.exponent}}}$"
        axes.errorbar(x, y, error, label=label, linestyle="none" if points.law else line, **look)
        if points.law is not None and len(x):
            along = np.geomspace(x[0], x[-1], 50)
            law = unit * points.law.factor * along**points.law.exponent.value
            style: Any = {**look, "linestyle": line, "marker": ""}
            axes.plot(along, law, **style)
    if figure.paper_points:
        x, y = zip(*figure.paper_points, strict=True)
        axes.errorbar(x, y, fmt="*", color="0.2", markersize=9, label="the paper", zorder=4)
    if figure.fitted:
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(LogFormatter())
            axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    else:
        axes.set_ylim(bottom=0.0)
    axes.set(xlabel=AXES[figure.x], ylabel=AXES[figure.y])
    axes.legend(frameon=False, fontsize=8)


def measure_figure(
    figure: Figure, n_loadings: int, motion: Sequence[tuple[str, str]] = (), n_workers: int | None = None
) -> Report:
    """Let the planners of a figure plan its loadings.

    Args:
        figure: The figure.
        n_loadings: Number of loadings of each point.
        motion: Settings of the mobile tweezers to change, such as ("speed", "130 um/ms").
        n_workers: Number of processes; None for one per core.
    """
    conditions = tuple(replace(one, motion=(*one.motion, *motion)) for one in figure.conditions)
    called = f"figure {figure.name}"
    comparison = Comparison(figure.planner_entries, conditions, n_loadings, 1, (), called)
    return compare(comparison, Resources(n_workers))


def figure_lines(figure: Figure, report: Report, n_loadings: int) -> list[str]:
    """A figure of the paper: a column per curve, a row per point."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    picture = PICTURES / f"figure-{figure.name}.png"
    draw_figure(picture, report, figure)
    curves = points_of(report, figure)
    factor = 1e3 if figure.y == "motion_s" else 1.0
    name = "N" if figure.x == "n_target_atoms" else "DOP"
    rows = [
        [f"{x:.0f}", *(str(Estimate(c.y[i], c.error[i]).scaled(factor)) for c in curves)]
        for i, x in enumerate(curves[0].x)
    ]
    if figure.fitted:
        rows.append(["exponent", *(str(c.law.exponent) if c.law else "-" for c in curves)])
    command = f"python docs/make_planner_tables.py --figure {figure.name} --loadings {n_loadings}"
    table = markdown([name, *(c.label for c in curves)], rows)
    what = "milliseconds" if factor > 1.0 else "batches, or scans where the source counts those"
    return [
        *shown(command, not_run=True),
        *table,
        "",
        f"In {what}.",
        "",
        f"![Figure {figure.name}](../_static/planners/{picture.name})",
    ]


def shown(command: str, *, not_run: bool = False) -> list[str]:
    note = ["<!-- not run: tests/docs/test_planner_tables.py runs the script -->"] if not_run else []
    return [*note, "```console", command, "```", ""]


def figures(names: Sequence[str], n_loadings: int) -> dict[str, list[str]]:
    """The figures; those of the same loadings are measured together."""
    reports: dict[object, Report] = {}
    for figure in (FIGURES[name] for name in names):
        key = (figure.planner_entries, figure.conditions)
        if key not in reports:
            reports[key] = measure_figure(figure, n_loadings)
    return {
        f"figure {name}": figure_lines(
            FIGURES[name], reports[FIGURES[name].planner_entries, FIGURES[name].conditions], n_loadings
        )
        for name in names
    }


def replaced(page: str, name: str, lines: Sequence[str]) -> str:
    """The page with new content in one of its measured parts.

    Raises:
        LookupError: The page has no such part.
    """
    part = re.compile(rf"(<!-- measured: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not part.search(page):
        raise LookupError(f"{PAGE.name} has no part <!-- measured: {name} -->")
    return part.sub(lambda match: match[1] + "\n" + "\n".join(lines) + "\n\n" + match[2], page)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Measure the planners, and draw the paper's figures.")
    parser.add_argument("--loadings", type=int, default=10_000)
    parser.add_argument("--figure", choices=[*FIGURES], help="draw this figure of the paper only")
    parser.add_argument("--set", action="append", default=[], help="such as speed='130 um/ms'")
    parser.add_argument("--output", type=Path, help="picture of --figure; by default figure-2b.png, ...")
    given = parser.parse_args(arguments)
    if given.figure is not None:
        figure = FIGURES[given.figure]
        motion = [(key, value) for key, _, value in (one.partition("=") for one in given.set)]
        report = measure_figure(figure, given.loadings, motion)
        picture = given.output or Path(f"figure-{figure.name}.png")
        draw_figure(picture, report, figure)
        fits = [f"{one.label}: N^{one.law.exponent}" for one in points_of(report, figure) if one.law]
        sys.stdout.write("\n".join([*fits, f"the paper: {figure.paper}", f"written: {picture}", ""]))
        return
    parts: dict[str, Callable[[int], list[str]]] = {"planners": planners, "sizes": sizes}
    measured = {name: measure(given.loadings) for name, measure in parts.items()} | figures(
        [*FIGURES], given.loadings
    )
    page = PAGE.read_text(encoding="utf-8")
    for name, lines in measured.items():
        page = replaced(page, name, lines)
    PAGE.write_text(page, encoding="utf-8")
    sys.stdout.write(f"written: {PAGE.relative_to(DOCS)}, {', '.join(measured)}\n")


if __name__ == "__main__":
    main()
