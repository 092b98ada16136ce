"""Measure the planners again: the tables and pictures of their page, or one figure of the paper.

    python docs/make_planner_tables.py --loadings 10000 [--part variants]
    python docs/make_planner_tables.py --figure 2b --loadings 1000 [--loading 63.7%] [--output figure-2b.png]

The first command replaces the parts of the page between ``<!-- measured: NAME -->`` and ``<!-- end -->``,
or one of them. Times are those of this machine: let nothing else run. The second prints and draws one of
the paper's figures 2b, 2c, 3a and 3b, at the paper's loading or another one. What the paper leaves open is
chosen here: the size of the grid next to that of the target, and in figure 3 the degree of parallelism; see
``docs/develop/planner-figures.md``.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
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
    parse_loading,
    read_comparison,
)
from labseq.bench.planners import Resources, compare
from labseq.bench.report import Report, Row, draw_histogram
from labseq.model.estimate import Estimate
from labseq.units import format_quantity

DOCS = Path(__file__).parent
PAGE = DOCS / "develop" / "planner-figures.md"
PICTURES = DOCS / "_static" / "planners"

PLANNERS = "psca,psca:variant=paper,tetris,mta1,hca,compression,lsap,lsap_squared"


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table."""
    return ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)]


def planners(n_loadings: int) -> list[str]:
    """All planners side by side, one after the other so that times are true."""
    header = (
        "planner",
        "batches",
        "atoms moved",
        "distance",
        "motion",
        "planning",
        "to the bound",
    )
    return planner_table(header, PLANNERS, "15", n_loadings)


def variants(n_loadings: int) -> list[str]:
    """The generalised PSCA beside the paper's, with what each loses."""
    header = ("planner", "DOP", "batches", "atoms moved", "motion", "atoms lost", "defect-free")
    return planner_table(header, "psca,psca:variant=paper", "2,7,15", n_loadings)


def planner_table(header: Sequence[str], choice: str, dops: str, n_loadings: int) -> list[str]:
    """The command that compares planners, and its table with these of the columns."""
    report = compare(read_comparison(planners=choice, dop=dops, loadings=n_loadings), Resources(1))
    command = f"labseq bench planners --planners {choice} --dop {dops} --loadings {n_loadings} --workers 1"
    rows = ([CELLS[name](row) for name in header] for row in report.rows)
    return [*shown(command), *markdown(header, rows)]


def _batches(row: Row) -> str:
    return f"{row['n_batches']}" + (f" ({row['n_scans']} scans)" if row.scans else "")


def _motion(row: Row) -> str:
    scans = f" ({row['scan_s'].scaled(1e3)} ms)" if row.scans else ""
    return f"{row['motion_s'].scaled(1e3)} ms{scans}"


CELLS: Final[Mapping[str, Callable[[Row], str]]] = {
    "planner": lambda row: f"`{row.planner_entry.label}`",
    "DOP": lambda row: str(row["degree_of_parallelism"]),
    "batches": _batches,
    "atoms moved": lambda row: str(row["n_atoms_moved"]),
    "distance": lambda row: f"{row['distance_m'].scaled(1e3)} mm",
    "motion": _motion,
    "planning": lambda row: format_quantity(row["planning_s"]["median"], "time"),
    "atoms lost": lambda row: str(row["n_lost"]),
    "defect-free": lambda row: f"{row['p_defect_free'].scaled(100)} %",
    "to the bound": lambda row: str(row["ratio_to_bound"]),
}
"""Head of a column -> its cell in a row."""


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
        title: What is compared, and how, except for the loading.
        x: What differs between the conditions.
        y: What is drawn over it.
        planner_entries: A curve each.
        conditions: A point each.
        fitted: Whether the curves are power laws of x.
        paper: The paper's result, as text.
        paper_points: The paper's points: (x, y) each.
        histograms_at: Degrees of parallelism for which the first planner's batches are drawn as histograms.
        rows: Values of x in the table; all if empty.
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
    rows: tuple[int, ...] = ()

    @property
    def loading(self) -> float:
        """Probability that a site is loaded."""
        return self.conditions[0].loading

    @property
    def part(self) -> str:
        """Name of its part of the page."""
        return f"figure {self.name}"

    def at(self, loading: float) -> Figure:
        """The same at another loading."""
        conditions = tuple(replace(condition, loading=loading) for condition in self.conditions)
        return replace(self, conditions=conditions)


def percents(loading: float) -> str:
    """A loading as text: "63.7 %"."""
    return f"{100 * loading:g} %"


GENERALISED_PSCA: Final = PlannerEntry("psca")
PAPERS_PSCA: Final = PlannerEntry("psca", (("variant", "paper"),))
LABELS: Final = {GENERALISED_PSCA: "psca, generalised"}
"""Planners that are not called by their names and settings alone."""
LSAP_SQUARED: Final = PlannerEntry("lsap_squared")
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
_MTA1: Final = (PAPERS_PSCA, GENERALISED_PSCA, PlannerEntry("mta1"))

FIGURES: Final[Mapping[str, Figure]] = MappingProxyType(
    {
        figure.name: figure
        for figure in (
            Figure(
                name="2b",
                title="compact targets, degree of parallelism 15",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=(PAPERS_PSCA, GENERALISED_PSCA, ROWS_X_COLUMNS, LSAP_SQUARED),
                conditions=_COMPACT,
                fitted=True,
                paper="PSCA 0.48(2), modified LSAP 1.16(1)",
            ),
            Figure(
                name="2c",
                title="15 x 15 out of 20 x 20",
                x="degree_of_parallelism",
                y="n_batches",
                planner_entries=(PAPERS_PSCA, GENERALISED_PSCA, ROWS_X_COLUMNS),
                conditions=tuple(
                    Condition((20, 20), "{pattern: compact, rows: 15, cols: 15}", 0.75, dop)
                    for dop in range(2, 16)
                ),
                fitted=False,
                paper="PSCA 160.0(2) batches at 2, 29.61(3) at 15",
                paper_points=((2, 160.0), (15, 29.61)),
                histograms_at=(2, 3, 5, 7, 15),
                rows=(2, 3, 5, 7, 10, 15),
            ),
            Figure(
                name="3a",
                title="interleaved targets, any degree of parallelism",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="PSCA 0.388(2), MTA1 0.47(1)",
                rows=(25, 100, 225, 400),
            ),
            Figure(
                name="3b",
                title="interleaved targets, any degree of parallelism",
                x="n_target_atoms",
                y="motion_s",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="at 400 atoms PSCA takes a quarter of MTA1's time",
                rows=(25, 100, 225, 400),
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
        label = LABELS.get(planner_entry, planner_entry.label)
        label += " (scans)" if any(row.scans for row in rows) else ""
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
        panels[0, 0].set(
            xlabel=f"batches of {LABELS.get(first, first.label)}", ylabel="share of the loadings"
        )
        panels[0, 0].legend(frameon=False, fontsize=8)
    draw_curves(panels[0, -1], points_of(report, figure), figure)
    note = f"{report.extent_text}\nthe paper: {figure.paper}"
    title = f"{figure.title}, {percents(figure.loading)} loading"
    drawing.suptitle(f"figure {figure.name}: {title}\n{note}", fontsize=9)
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


@cache
def measured(
    planner_entries: tuple[PlannerEntry, ...], conditions: tuple[Condition, ...], n_loadings: int
) -> Report:
    """Let planners plan loadings; figures with the same ones share the report."""
    return compare(Comparison(planner_entries, conditions, n_loadings, 1, (), "the figure"))


def table_of(figure: Figure, report: Report) -> list[str]:
    """The table of a figure: a column per curve, a row per point."""
    curves = points_of(report, figure)
    factor = 1e3 if figure.y == "motion_s" else 1.0
    name = "N" if figure.x == "n_target_atoms" else "DOP"
    rows = [
        [f"{x:.0f}", *(str(Estimate(c.y[i], c.error[i]).scaled(factor)) for c in curves)]
        for i, x in enumerate(curves[0].x)
        if not figure.rows or x in figure.rows
    ]
    if figure.fitted:
        rows.append(["exponent", *(str(c.law.exponent) if c.law else "-" for c in curves)])
    what = "milliseconds" if factor > 1.0 else "batches, or scans where the source counts those"
    return [*markdown([name, *(c.label for c in curves)], rows), "", f"In {what}."]


def figure_lines(figure: Figure, n_loadings: int) -> list[str]:
    """A figure of the paper on the page: its command, its table and its picture."""
    report = measured(figure.planner_entries, figure.conditions, n_loadings)
    options = f"--figure {figure.name} --loadings {n_loadings}"
    lines = [
        *shown(f"python docs/make_planner_tables.py {options}", not_run=True),
        *table_of(figure, report),
    ]
    PICTURES.mkdir(parents=True, exist_ok=True)
    picture = PICTURES / f"figure-{figure.name}.png"
    draw_figure(picture, report, figure)
    return [*lines, "", f"![Figure {figure.name}](../_static/planners/{picture.name})"]


HYPOTHESIS: Final = 0.637
"""A loading at which the paper's text gives nearly as many batches as the paper states."""
STATED: Final[Mapping[str, Estimate]] = {
    "exponent of PSCA, figure 2(b)": Estimate(0.48, 0.02),
    "exponent of modified LSAP, figure 2(b)": Estimate(1.16, 0.01),
    "batches at DOP 2, figure 2(c)": Estimate(160.0, 0.2),
    "batches at DOP 15, figure 2(c)": Estimate(29.61, 0.03),
}
"""All numbers that the paper states of these figures."""
SPREADS: Final[Mapping[str, str]] = {
    "s.d. of the batches at DOP 2": "15 to 25",
    "s.d. of the batches at DOP 15": "2.5 to 3.5",
}
"""What the errors of the means, 0.2 and 0.03, imply if figure 2(c) has 10,000 loadings as 2(b) has."""


def statements(n_loadings: int) -> list[str]:
    """What the paper states of figures 2(b) and 2(c), and what its text gives at two loadings."""
    loadings = FIGURES["2b"].loading, HYPOTHESIS
    columns = [results_at(loading, n_loadings) for loading in loadings]
    rows = [
        [
            name,
            str(paper),
            *(cell for c in columns for cell in (str(c[name]), f"{away(c[name], paper):+.1f}")),
        ]
        for name, paper in STATED.items()
    ]
    sums = (sum(away(c[name], paper) ** 2 for name, paper in STATED.items()) for c in columns)
    rows.append(["sum of squares", "", *(x for one in sums for x in ("", f"{one:.0f}"))])
    for name, paper in (*SPREADS.items(), (SHORT, "")):
        rows.append([name, paper, *(x for c in columns for x in (str(c[name]), ""))])
    header = ["", "the paper", *(x for p in loadings for x in (f"its text at {percents(p)}", "away"))]
    command = f"python docs/make_planner_tables.py --part statements --loadings {n_loadings}"
    return [*shown(command, not_run=True), *markdown(header, rows)]


SHORT: Final = "loadings with too few atoms, N = 36 / 81 / 144 / 225"


def away(value: Estimate, paper: Estimate) -> float:
    """How far a value is from the paper's, in standard errors of both."""
    return (value.value - paper.value) / math.hypot(value.error, paper.error)


def results_at(loading: float, n_loadings: int) -> dict[str, Any]:
    """What the paper's text gives at a loading: name in :data:`STATED` or :data:`SPREADS` -> estimate."""
    sizes = replace(FIGURES["2b"].at(loading), planner_entries=(PAPERS_PSCA, LSAP_SQUARED))
    of_sizes = measured(sizes.planner_entries, sizes.conditions, n_loadings)
    exponents = [points.law and points.law.exponent for points in points_of(of_sizes, sizes)[:2]]
    dops = FIGURES["2c"].at(loading).conditions
    rows = measured((PAPERS_PSCA,), (dops[0], dops[-1]), n_loadings).rows
    batches = [row["n_batches"] for row in rows]
    spreads = [one.scaled(math.sqrt(n_loadings)) for one in batches]
    spreads = [Estimate(one.error, one.error / math.sqrt(2 * n_loadings)) for one in spreads]
    values = [*exponents, *batches, *spreads]
    short = " / ".join(str(row["n_short"]) for row in of_sizes.rows_of(PAPERS_PSCA))
    return {**dict(zip((*STATED, *SPREADS), values, strict=True)), SHORT: short}


def shown(command: str, *, not_run: bool = False) -> list[str]:
    note = ["<!-- not run: tests/docs/test_planner_tables.py runs the script -->"] if not_run else []
    return [*note, "```console", command, "```", ""]


PARTS: Final[Mapping[str, Callable[[int], list[str]]]] = MappingProxyType(
    {
        "planners": planners,
        "variants": variants,
        **{figure.part: partial(figure_lines, figure) for figure in FIGURES.values()},
        "statements": statements,
    }
)
"""Name of a measured part of the page -> makes its lines for a number of loadings."""


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
    parser.add_argument("--part", choices=[*PARTS], help="measure only this part of the page")
    parser.add_argument("--figure", choices=[*FIGURES], help="print and draw this figure of the paper only")
    parser.add_argument("--loading", type=parse_loading, help="loading of --figure, if not the paper's")
    parser.add_argument("--set", action="append", default=[], help="such as speed='130 um/ms'")
    parser.add_argument("--output", type=Path, help="picture of --figure; by default figure-2b.png, ...")
    given = parser.parse_args(arguments)
    if given.figure is not None:
        figure = FIGURES[given.figure]
        figure = figure if given.loading is None else figure.at(given.loading)
        motion = [(key, value) for key, _, value in (one.partition("=") for one in given.set)]
        conditions = tuple(replace(one, motion=(*one.motion, *motion)) for one in figure.conditions)
        report = measured(figure.planner_entries, conditions, given.loadings)
        picture = given.output or Path(f"figure-{figure.name}.png")
        draw_figure(picture, report, figure)
        lines = [*table_of(figure, report), f"the paper: {figure.paper}", f"written: {picture}", ""]
        sys.stdout.write("\n".join(lines))
        return
    names = [*PARTS] if given.part is None else [given.part]
    for name in names:
        lines = PARTS[name](given.loadings)
        page = PAGE.read_text(encoding="utf-8")  # after the measurement, which takes long
        PAGE.write_text(replaced(page, name, lines), encoding="utf-8")
    sys.stdout.write(f"written: {PAGE.relative_to(DOCS)}, {', '.join(names)}\n")


if __name__ == "__main__":
    main()
