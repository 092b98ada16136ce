"""The results of a comparison of planners: a row per condition and planner, and a histogram."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.bench.comparison import Comparison, Condition, PlannerEntry
from labseq.bench.work import LOADING, RESULT, Done, Failure, PreparedCondition
from labseq.errors import LabseqError
from labseq.model.estimate import Estimate, mean
from labseq.pictures.figures import make_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """Results of one planner under one condition; the means are over the loadings with a valid plan.

    Attributes:
        settings: All settings of the planner, JSON-ready.
        degree_of_parallelism: Maximum number of tweezers on at once for which its plans were checked.
        n_short: Number of loadings with fewer atoms than the target.
        n_failed: Loadings for which the planner failed or its plan broke a rule.
        first_failure: The first of these, or None.
        n_batches: Mean number of batches, linked ones counted as one.
        n_atoms_moved: Mean number of atoms moved; one that is picked up again counts again.
        distance_m: Mean total distance of all atom moves, in metres.
        motion_s: Mean time of ramps and transport, in seconds, with the overheads
            that the condition names.
        n_scans: Mean number of scans, which the papers of some planners count
            instead of batches; NaN for all others.
        scan_s: Mean time of the scans, in seconds.
        planning_median_s: Median time of a call of ``plan()``, in seconds.
        planning_p99_s: The time within which 99 % of the calls return, in seconds.
        filling_fraction: Mean fraction of the target's sites that hold an atom after the plan.
        target_met: Fraction of the loadings whose plan ends with the target exactly met.
        bound: Mean number of lines that cover the vacancies, see
            :func:`labseq.bench.work.lines_to_cover`.
        ratio_to_bound: Mean number of batches over mean bound, both over the loadings
            whose target was filled.
        counts: int64 (n,), number of plans with 0, 1, 2, ... batches.
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
        """Whether the planner's paper counts scans."""
        return not math.isnan(self.n_scans.value)

    def as_dict(self) -> dict[str, Any]:
        """All values except the failure's message, JSON-ready, SI; None for unknown ones."""
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
        for name in (field.name for field in fields(self)):
            if isinstance(estimate := getattr(self, name), Estimate):
                values[name] = {"mean": _known(estimate.value), "error": _known(estimate.error)}
        values["planning_s"] = {"median": _known(self.planning_median_s), "p99": _known(self.planning_p99_s)}
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The results of a comparison.

    Attributes:
        rows: A row per condition and planner; none for a condition without any loading done.
        n_done: Loadings that were done, over all conditions.
        duration_s: Duration of the comparison, in seconds.
        ended_by: The error that ended it early, or None.
    """

    comparison: Comparison
    rows: tuple[Row, ...]
    n_done: int
    duration_s: float
    ended_by: LabseqError | None

    @property
    def n_wanted(self) -> int:
        """Requested loadings, over all conditions."""
        return self.comparison.n_loadings * len(self.comparison.conditions)

    def rows_of(self, planner_entry: PlannerEntry) -> list[Row]:
        """The rows of one planner, in the order of the conditions."""
        return [row for row in self.rows if row.planner_entry == planner_entry]

    @property
    def extent_text(self) -> str:
        """Number of loadings and seed, as text."""
        incomplete = "" if self.ended_by is None else f", incomplete: {self.n_done} of {self.n_wanted}"
        return f"{self.comparison.n_loadings} loadings{incomplete}, seed {self.comparison.seed}"

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
    """Collects the results of the jobs of a comparison."""

    def __init__(self, comparison: Comparison, prepared: Sequence[PreparedCondition]) -> None:
        n_planners, n_loadings = len(comparison.planner_entries), comparison.n_loadings
        self._comparison = comparison
        self._prepared = prepared
        self._results = [np.empty((n_planners, n_loadings), RESULT) for _ in prepared]
        self._loadings = [np.empty(n_loadings, LOADING) for _ in prepared]
        self._is_done = [np.zeros(n_loadings, np.bool_) for _ in prepared]
        self._failures: dict[tuple[int, int], Failure] = {}

    @property
    def n_done(self) -> int:
        """Loadings that are done, over all conditions."""
        return sum(int(np.count_nonzero(done)) for done in self._is_done)

    def add(self, done: Done) -> None:
        """Add the results of a job."""
        i, span = done.job.condition, slice(done.job.start, done.job.stop)
        self._results[i][:, span] = done.results
        self._loadings[i][span] = done.loadings
        self._is_done[i][span] = True
        for failure in done.failures:
            key = (i, failure.planner_entry)
            if key not in self._failures or failure.loading < self._failures[key].loading:
                self._failures[key] = failure

    def rows(self) -> tuple[Row, ...]:
        """A row per condition and planner, of the loadings that are done."""
        return tuple(
            self._row(i, planner_entry)
            for i, done in enumerate(self._is_done)
            if done.any()
            for planner_entry in range(len(self._comparison.planner_entries))
        )

    def _row(self, i: int, planner_entry: int) -> Row:
        condition, done = self._prepared[i], self._is_done[i]
        results, loadings = self._results[i][planner_entry, done], self._loadings[i][done]
        right = ~results["failed"]
        good, n_atoms = results[right], condition.target.n_atoms
        filled = good["n_defects"] == 0
        planning_s = good["planning_s"] if len(good) else np.array([math.nan])
        runner = condition.runners[planner_entry]
        names = ("n_batches", "n_atoms_moved", "distance_m", "motion_s", "n_scans", "scan_s")
        means = {name: mean(good[name]) for name in names}
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
            planning_median_s=float(np.median(planning_s)),
            planning_p99_s=float(np.quantile(planning_s, 0.99)),
            filling_fraction=mean(1.0 - good["n_defects"] / max(1, n_atoms)),
            target_met=mean(filled & (good["n_surplus"] == 0)),
            bound=mean(loadings["n_lines"]),
            ratio_to_bound=ratio_of_means(good["n_batches"][filled], loadings["n_lines"][right][filled]),
            counts=np.bincount(good["n_batches"]),
            **means,
        )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested values: n_batches_mean, n_batches_error, ..."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if key == "settings":
            flat[key] = " ".join(f"{name}={inner}" for name, inner in value.items())
        elif isinstance(value, dict):
            flat |= {f"{key}_{name}": inner for name, inner in value.items()}
        else:
            flat[key] = value
    return flat


def save_histogram(path: Path, report: Report) -> None:
    """Draw how many batches the planners need, for a comparison with one condition, as a PNG.

    Raises:
        ConfigError: The file cannot be written.
    """

    def draw() -> Figure:
        (condition,) = report.comparison.conditions
        figure = make_figure(5.4, 4.2, layout="constrained")
        axes = figure.add_subplot()
        for i, row in enumerate(report.rows):
            label = f"{row.planner_entry.label}: {row.n_batches}"
            draw_histogram(axes, row.counts, f"C{i % 10}", label)
        axes.set_xlabel("batches")
        axes.set_ylabel("share of the loadings")
        if any(row.counts.any() for row in report.rows):
            axes.legend(frameon=False, fontsize=8)
        rows, cols = condition.shape
        given = f"{100 * condition.loading:g} % loading"
        if condition.degree_of_parallelism is not None:
            given += f", degree of parallelism {condition.degree_of_parallelism}"
        title = f"{condition.target} out of {rows} x {cols}, {given}\n{report.extent_text}"
        figure.suptitle(title, fontsize=9)
        return figure

    save_figure(path, draw, dpi=150)


def draw_histogram(axes: Axes, counts: NDArray[np.int64], colour: str, label: str) -> None:
    """Draw the share of each number of batches; ``counts``: how often 0, 1, 2, ... were needed."""
    seen = np.flatnonzero(counts)
    if len(seen):
        first, last = int(seen[0]), int(seen[-1])
        edges, share = np.arange(first, last + 2) - 0.5, counts[first : last + 1] / counts.sum()
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.45, label=label)
        axes.stairs(share, edges, color=colour, linewidth=1)
