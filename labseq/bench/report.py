"""The results of a comparison: rows, ratios, power laws and curves.

What the paper leaves open is chosen here and said in ``docs/explanation/planners.md``:
the size of the grid beside that of the target, and in figure 3 the degree of
parallelism.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.bench.comparison import (
    BARE_MOTION,
    LOADING,
    RESULT,
    Comparison,
    Condition,
    Done,
    Failure,
    PlannerEntry,
    PreparedCondition,
    Words,
)
from labseq.bench.pictures import ComparisonDrawing, Curve, Histogram
from labseq.errors import ConfigError, LabseqError, Problem, one_of
from labseq.messages import clean, did_you_mean
from labseq.model.estimate import Estimate, mean


def ratio_of_means(numerator: ArrayLike, denominator: ArrayLike) -> Estimate:
    """The ratio of two means of the same loadings, and its error to first order.

    Example:
        >>> ratio_of_means([4.0, 6.0], [2.0, 3.0])
        Estimate(value=2.0, error=0.0)
    """
    above, below = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    if len(below) == 0 or not below.any():
        return Estimate(math.nan, math.nan)
    ratio = float(above.mean() / below.mean())
    return Estimate(ratio, mean(above - ratio * below).error / float(below.mean()))


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


ESTIMATES: Final = (
    "n_batches",
    "n_atoms_moved",
    "distance_m",
    "motion_s",
    "n_scans",
    "scan_s",
    "filling_fraction",
    "target_met",
    "bound",
    "ratio_to_bound",
)
"""The means of a :class:`Row`."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """What one planner made of the loadings of one condition.

    The means are over the loadings whose plan was right.

    Attributes:
        entrant: The planner.
        condition: What it was given.
        settings: All its settings, JSON-ready.
        degree_of_parallelism: Most tweezers on at once that its plans were checked for.
        n_target_atoms: Atoms in the target.
        n_loadings: Number of loadings.
        n_short: How many of them hold fewer atoms than the target.
        n_failed: For how many of them the planner raised or its plan broke a rule.
        first_failure: The first of these, or None.
        n_batches: Mean number of batches, linked ones counted as one.
        n_atoms_moved: Mean number of atoms moved; one that is picked up again counts again.
        distance_m: Mean of the distances of all atom moves together, in metres.
        motion_s: Mean time of ramps and transport, in seconds, with the overheads
            that the condition names.
        n_scans: Mean number of scans, which the source of some planners counts
            instead of batches; NaN for all others.
        scan_s: Mean time of the scans, in seconds.
        planning_median_s: Median time of a call of ``plan()``, in seconds.
        planning_p99_s: The time within which 99 % of the calls return, in seconds.
        filling_fraction: Mean fraction of the target's sites that hold an atom after the plan.
        target_met: Fraction of the loadings whose plan ends with the target exactly met.
        bound: Mean number of lines that cover the vacancies, see
            :func:`labseq.bench.comparison.lines_to_cover`.
        ratio_to_bound: Mean number of batches over mean bound, both over the loadings
            whose target was filled.
        counts: int64 (most batches + 1,), number of plans with so many batches.
    """

    planner_entry: PlannerEntry
    condition: Condition
    settings: Mapping[str, Any]
    degree_of_parallelism: int
    n_target_atoms: int
    n_loadings: int
    n_short: int
    n_failed: int
    first_failure: Failure | None
    n_batches: Estimate
    n_atoms_moved: Estimate
    distance_m: Estimate
    motion_s: Estimate
    n_scans: Estimate
    scan_s: Estimate
    planning_median_s: float
    planning_p99_s: float
    filling_fraction: Estimate
    target_met: Estimate
    bound: Estimate
    ratio_to_bound: Estimate
    counts: NDArray[np.int64]

    @property
    def scans(self) -> bool:
        """Whether the planner's source counts scans."""
        return not math.isnan(self.n_scans.value)

    def as_dict(self) -> dict[str, Any]:
        """Everything but the failure's words, JSON-ready, SI; None for what is not known."""
        rows, cols = self.condition.shape
        values: dict[str, Any] = {
            "planner": self.planner_entry.planner,
            "label": self.planner_entry.label,
            "settings": dict(self.settings),
            "degree_of_parallelism": self.degree_of_parallelism,
            "grid": {"rows": rows, "cols": cols},
            "target": self.condition.target,
            "n_target_atoms": self.n_target_atoms,
            "loading": self.condition.loading,
            "n_loadings": self.n_loadings,
            "n_short": self.n_short,
            "n_failed": self.n_failed,
        }
        for name in ESTIMATES:
            estimate: Estimate = getattr(self, name)
            values[name] = {"mean": _known(estimate.value), "error": _known(estimate.error)}
        values["planning_s"] = {"median": _known(self.planning_median_s), "p99": _known(self.planning_p99_s)}
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What came of a comparison.

    Attributes:
        comparison: What was asked for.
        rows: A row per condition and planner; a condition of which nothing was done has none.
        n_done: Loadings that were done, over all conditions.
        duration_s: How long it took, in seconds.
        ended_by: What ended it before all was done, or None.
    """

    comparison: Comparison
    rows: tuple[Row, ...]
    n_done: int
    duration_s: float
    ended_by: LabseqError | None

    @property
    def n_wanted(self) -> int:
        """Loadings that were asked for, over all conditions."""
        return self.comparison.n_loadings * len(self.comparison.conditions)

    def rows_of(self, planner_entry: PlannerEntry) -> list[Row]:
        """The rows of one planner, in the order of the conditions."""
        return [row for row in self.rows if row.planner_entry == planner_entry]

    def as_dict(self) -> dict[str, Any]:
        """Everything, JSON-ready."""
        return {
            "complete": self.ended_by is None,
            "seed": self.comparison.seed,
            "n_loadings": self.comparison.n_loadings,
            "duration_s": self.duration_s,
            "rows": [row.as_dict() for row in self.rows],
        }

    def as_csv(self) -> str:
        """The rows as CSV, SI, a line per row."""
        flat = [_flat(row.as_dict()) for row in self.rows]
        text = io.StringIO()
        writer = csv.DictWriter(text, list(flat[0]) if flat else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat)
        return text.getvalue()


class Tally:
    """Gathers what comes of the jobs of a comparison."""

    def __init__(self, comparison: Comparison, courses: Sequence[PreparedCondition]) -> None:
        n_entrants, n_loadings = len(comparison.planner_entries), comparison.n_loadings
        self._comparison = comparison
        self._courses = courses
        self._results = [np.empty((n_entrants, n_loadings), RESULT) for _ in courses]
        self._loadings = [np.empty(n_loadings, LOADING) for _ in courses]
        self._is_done = [np.zeros(n_loadings, np.bool_) for _ in courses]
        self._failures: dict[tuple[int, int], Failure] = {}

    @property
    def n_done(self) -> int:
        """Loadings that are done, over all conditions."""
        return sum(int(np.count_nonzero(done)) for done in self._is_done)

    def add(self, done: Done) -> None:
        """Take in what came of a job."""
        i, span = done.job.condition, slice(done.job.start, done.job.stop)
        self._results[i][:, span] = done.results
        self._loadings[i][span] = done.loadings
        self._is_done[i][span] = True
        for failure in done.failures:
            key = (i, failure.planner_entry)
            if key not in self._failures or failure.loading < self._failures[key].loading:
                self._failures[key] = failure

    def rows(self) -> tuple[Row, ...]:
        """A row per condition and planner, of what is done."""
        return tuple(
            self._row(i, planner_entry)
            for i, done in enumerate(self._is_done)
            if done.any()
            for planner_entry in range(len(self._comparison.planner_entries))
        )

    def _row(self, i: int, planner_entry: int) -> Row:
        course, done = self._courses[i], self._is_done[i]
        results, loadings = self._results[i][planner_entry, done], self._loadings[i][done]
        right = ~results["failed"]
        good, n_atoms = results[right], course.target.n_atoms
        filled = good["n_defects"] == 0
        planning_s = good["planning_s"] if len(good) else np.array([math.nan])
        runner = course.runners[planner_entry]
        return Row(
            planner_entry=self._comparison.planner_entries[planner_entry],
            condition=self._comparison.conditions[i],
            settings=runner.settings,
            degree_of_parallelism=runner.degree_of_parallelism,
            n_target_atoms=n_atoms,
            n_loadings=len(results),
            n_short=int(np.count_nonzero(loadings["n_atoms"] < n_atoms)),
            n_failed=int(np.count_nonzero(~right)),
            first_failure=self._failures.get((i, planner_entry)),
            n_batches=mean(good["n_batches"]),
            n_atoms_moved=mean(good["n_atoms_moved"]),
            distance_m=mean(good["distance_m"]),
            motion_s=mean(good["motion_s"]),
            n_scans=mean(good["n_scans"]),
            scan_s=mean(good["scan_s"]),
            planning_median_s=float(np.median(planning_s)),
            planning_p99_s=float(np.quantile(planning_s, 0.99)),
            filling_fraction=mean(1.0 - good["n_defects"] / max(1, n_atoms)),
            target_met=mean((good["n_defects"] == 0) & (good["n_surplus"] == 0)),
            bound=mean(loadings["n_lines"]),
            ratio_to_bound=ratio_of_means(good["n_batches"][filled], loadings["n_lines"][right][filled]),
            counts=np.bincount(good["n_batches"]),
        )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values beside one another: n_batches_mean, n_batches_error, ..."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if key == "settings":
            flat[key] = " ".join(f"{name}={inner}" for name, inner in value.items())
        elif isinstance(value, dict):
            flat |= {f"{key}_{name}": inner for name, inner in value.items()}
        else:
            flat[key] = value
    return flat


Quantity = Literal["n_target_atoms", "degree_of_parallelism", "n_batches", "motion_s"]


@dataclass(frozen=True, slots=True)
class Figure:
    """What a figure shows.

    Attributes:
        name: Its name in the paper.
        title: What is compared, and how.
        x: What differs between the conditions.
        y: What is drawn over it.
        entrants: A curve each.
        conditions: A point each.
        fitted: Whether the curves are power laws of x.
        paper: What the paper states of it, in words.
        paper_points: What the paper states of it: (x, y) each.
        histograms_at: Values of x for which the first planner's batches are drawn as histograms.
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

    def with_motion(self, motion: Words) -> list[Condition]:
        """The conditions with some settings of the motion changed."""
        return [replace(condition, motion=(*condition.motion, *motion)) for condition in self.conditions]


PSCA: Final = PlannerEntry("psca")
PSCA_OF_THE_PAPER: Final = PlannerEntry("psca", (("variant", "paper"),))

EBADI: Final[Words] = (("speed", "75 um/ms"), ("pick_up", "15 us"), ("drop_off", "15 us"))
"""Transport speed and capture time of S. Ebadi et al., Nature 595, 227 (2021)."""


def _compact(side: int) -> Condition:
    """A centred square, four sites of the grid for three of the target along each side, as 20 for 15."""
    grid = round(side * 4 / 3)
    return Condition((grid, grid), f"compact:{side}x{side}", 0.75, 15)


def _interleaved(side: int) -> Condition:
    """Target rows with a reservoir row after each, and a tenth of the columns more on both sides.

    At 55 % loading that makes 1.32 atoms per target site, nearly as many as 20 x 20
    for 15 x 15 at 75 %. All atoms of a line may move at once.
    """
    rows, cols = 2 * side, round(1.2 * side)
    limits = ("max_tweezers", "max_row_tones", "max_column_tones")
    motion = (*BARE_MOTION, *EBADI, *((limit, str(rows)) for limit in limits))
    return Condition((rows, cols), f"interleaved:{side}x{side}", 0.55, rows, motion)


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
                planner_entries=(PSCA, PSCA_OF_THE_PAPER, PlannerEntry("lsap_squared")),
                conditions=_COMPACT,
                fitted=True,
                paper="PSCA 0.48(2), modified LSAP 1.16(1)",
            ),
            Figure(
                name="2c",
                title="15 x 15 out of 20 x 20, 75 % loading",
                x="degree_of_parallelism",
                y="n_batches",
                planner_entries=(PSCA, PSCA_OF_THE_PAPER),
                conditions=tuple(Condition((20, 20), "compact:15x15", 0.75, dop) for dop in range(2, 16)),
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


def find_figure(name: str) -> Figure:
    """The figure of that name.

    Raises:
        ConfigError: There is none.
    """
    figure = FIGURES.get(name)
    if figure is None:
        hint = did_you_mean(name, FIGURES)
        expected = one_of(list(FIGURES))
        raise ConfigError(
            Problem("there is no such figure", clean(f"--figure {name}"), expected=expected, hint=hint)
        )
    return figure


AXES: Final[Mapping[Quantity, str]] = {
    "n_target_atoms": "atoms in the target, N",
    "degree_of_parallelism": "degree of parallelism",
    "n_batches": "mean number of batches",
    "motion_s": "mean time of ramps and transport (ms)",
}
"""What axes are called."""
BOUND: Final = "bound"
"""What the rows and columns that cover the vacancies are called."""


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
    """Each planner's points, as far as they are done, and the bound where batches are counted."""
    found: list[Points] = []
    for planner_entry in report.comparison.planner_entries:
        rows = report.rows_of(planner_entry)
        label = f"{planner_entry.label} (scans)" if any(row.scans for row in rows) else planner_entry.label
        found.append(_points(label, rows, figure, [_y(row, figure.y) for row in rows]))
    if figure.y == "n_batches":
        rows = report.rows_of(report.comparison.planner_entries[0])
        found.append(_points(BOUND, rows, figure, [row.bound for row in rows]))
    return found


def _points(label: str, rows: list[Row], figure: Figure, y: list[Estimate]) -> Points:
    x = np.array([_x(row, figure.x) for row in rows], np.float64)
    means = np.array([one.value for one in y], np.float64)
    errors = np.array([one.error for one in y], np.float64)
    return Points(label, x, means, errors, fit_power_law(x, means, errors) if figure.fitted else None)


def figure_drawing(report: Report, figure: Figure) -> ComparisonDrawing:
    """A figure of the paper, as measured."""
    unit = 1e3 if figure.y == "motion_s" else 1.0
    curves = [_curve(points, unit) for points in points_of(report, figure)]
    if figure.paper_points:
        x, y = np.array(figure.paper_points, np.float64).T
        curves.append(Curve("the paper", x, y, np.zeros(len(x)), is_quoted=True))
    first = report.comparison.planner_entries[0]
    histograms = [
        Histogram(f"DOP {row.degree_of_parallelism}", row.counts)
        for row in report.rows_of(first)
        if row.degree_of_parallelism in figure.histograms_at
    ]
    return ComparisonDrawing(
        title=f"figure {figure.name}: {figure.title}",
        note=f"{_extent(report)}\nthe paper: {figure.paper}",
        x_label=AXES[figure.x],
        y_label=AXES[figure.y],
        counted=f"batches of {_plain(first.label)}",
        curves=tuple(curves),
        histograms=tuple(histograms),
        logarithmic=figure.fitted,
    )


def histogram_drawing(report: Report) -> ComparisonDrawing:
    """A comparison that is no figure of the paper: how many batches the planners need."""
    (condition,) = report.comparison.conditions
    rows, cols = condition.shape
    dop = condition.degree_of_parallelism
    given = f"{100 * condition.loading:g} % loading"
    given += f", degree of parallelism {dop}" if dop is not None else ""
    return ComparisonDrawing(
        title=f"{_plain(condition.target)} out of {rows} x {cols}, {given}",
        note=_extent(report),
        x_label="",
        y_label="",
        counted="batches",
        histograms=tuple(
            Histogram(f"{row.planner_entry.label}: {row.n_batches}", row.counts) for row in report.rows
        ),
    )


def fits_as_dicts(points: list[Points]) -> list[dict[str, Any]]:
    """The power laws, JSON-ready."""
    return [
        {
            "label": one.label,
            "factor": one.law.factor,
            "exponent": {"value": one.law.exponent.value, "error": one.law.exponent.error},
        }
        for one in points
        if one.law is not None
    ]


def _x(row: Row, quantity: Quantity) -> float:
    return row.n_target_atoms if quantity == "n_target_atoms" else row.degree_of_parallelism


def _y(row: Row, quantity: Quantity) -> Estimate:
    """As the algorithm's source counts it."""
    if quantity == "motion_s":
        return row.scan_s if row.scans else row.motion_s
    return row.n_scans if row.scans else row.n_batches


def _curve(points: Points, unit: float) -> Curve:
    law, label = points.law, _plain(points.label)
    if law is not None:
        label = f"{label}: $N^{{{law.exponent}}}$"
    fitted = None if law is None else (law.factor * unit, law.exponent.value)
    limit = points.label == BOUND
    return Curve(label, points.x, points.y * unit, points.error * unit, fitted, is_limit=limit)


def _plain(text: str) -> str:
    """A text in which mathtext finds nothing to set."""
    return text.replace("$", r"\$")


def _extent(report: Report) -> str:
    incomplete = "" if report.ended_by is None else f", incomplete: {report.n_done} of {report.n_wanted}"
    return f"{report.comparison.n_loadings} loadings{incomplete}, seed {report.comparison.seed}"
