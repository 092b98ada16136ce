"""The results of a comparison of planners, per condition and planner, as text, CSV, JSON and histogram."""

from __future__ import annotations

import csv
import io
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.assembly.lab import choice_of
from labseq.bench.comparison import BARE_MOTION, Comparison, Condition, PlannerEntry
from labseq.bench.work import Failure, JobResults, PreparedCondition, loading_seed
from labseq.console.report import Column, table
from labseq.console.text import percent, plural, time_text
from labseq.errors import LabseqError
from labseq.model.estimate import Estimate, mean
from labseq.pictures.figures import make_figure, save_figure
from labseq.plain import to_plain
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def ratio_of_means(numerator: ArrayLike, denominator: ArrayLike) -> Estimate:
    """The ratio of two means over the same loadings, and its error to first order.

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
    """Results of one planner under one condition.

    Attributes:
        values: The values for export, see :func:`summarise`. Also available as ``row[name]``.
        first_failure: The first loading for which the planner failed or its plan broke a rule, or None.
        counts: int64 (n,), number of plans with 0, 1, 2, ... batches.
    """

    planner_entry: PlannerEntry
    condition: Condition
    values: Mapping[str, Any]
    first_failure: Failure | None
    counts: NDArray[np.int64]

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    @property
    def scans(self) -> bool:
        """Whether the planner's paper counts scans."""
        return not math.isnan(self["n_scans"].value)


def _milli(value: Estimate) -> str:
    return str(value.scaled(1e3))


def _percent(value: Estimate) -> str:
    return percent(value.value, 2)


COLUMNS: Final[Sequence[Column[Row]]] = (
    Column("planner", lambda row: row["label"]),
    Column("DOP", lambda row: row["degree_of_parallelism"], right=True),
    Column("batches", lambda row: row["n_batches"], right=True),
    Column("atoms moved", lambda row: row["n_atoms_moved"], right=True),
    Column("distance/mm", lambda row: _milli(row["distance_m"]), right=True),
    Column("motion/ms", lambda row: _milli(row["motion_s"]), right=True),
    Column("moving/ms", lambda row: _milli(row["moving_s"]), right=True),
    Column("scans", lambda row: row["n_scans"], right=True),
    Column("scans/ms", lambda row: _milli(row["scan_s"]), right=True),
    Column("planning", lambda row: time_text(row["planning_s"]["median"]), right=True),
    Column("99 %", lambda row: time_text(row["planning_s"]["p99"]), right=True),
    Column("filled", lambda row: _percent(row["filling_fraction"]), right=True),
    Column("met", lambda row: _percent(row["target_met"]), right=True),
    Column("/bound", lambda row: row["ratio_to_bound"], right=True),
    Column("atoms lost", lambda row: row["n_lost"], right=True),
    Column("defect-free", lambda row: _percent(row["p_defect_free"]), right=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The results of a comparison.

    Attributes:
        rows: A row per condition and planner, without conditions that have no finished loading.
        n_done: Number of finished loadings, over all conditions.
        duration_s: Duration of the comparison, in seconds.
        ended_by: The error that ended it early, or None.
    """

    comparison: Comparison
    rows: tuple[Row, ...]
    n_done: int
    duration_s: float
    ended_by: LabseqError | None

    def rows_of(self, planner_entry: PlannerEntry) -> list[Row]:
        """The rows of one planner, in the order of the conditions."""
        return [row for row in self.rows if row.planner_entry == planner_entry]

    @property
    def n_wanted(self) -> int:
        """Requested loadings, over all conditions."""
        return self.comparison.n_loadings * len(self.comparison.conditions)

    @property
    def extent_text(self) -> str:
        """Number of loadings and seed, as text."""
        incomplete = "" if self.ended_by is None else f", incomplete: {self.n_done} of {self.n_wanted}"
        return f"{self.comparison.n_loadings} loadings{incomplete}, seed {self.comparison.seed}"

    def as_json(self) -> dict[str, Any]:
        """The rows and the extent."""
        return {
            "complete": self.ended_by is None,
            "seed": self.comparison.seed,
            "n_loadings": self.comparison.n_loadings,
            "duration_s": self.duration_s,
            "rows": [row.values for row in self.rows],
        }

    def as_text(self) -> list[str]:
        """A table with a row per condition and planner, and notes."""
        return [*_table(self), *notes(self)]

    def as_csv(self) -> str:
        """The rows as CSV, in SI units."""
        rows = [_flat(to_plain(row.values)) for row in self.rows]
        buffer = io.StringIO()
        writer = csv.DictWriter(buffer, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return buffer.getvalue()


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested values: n_batches_mean, n_batches_error, ..."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if key == "settings":
            flat[key] = " ".join(f"{name}={inner}" for name, inner in value.items())
        elif key == "choice":
            flat[key] = value[0] if value else ""
        elif isinstance(value, dict):
            flat |= {f"{key}_{name}": inner for name, inner in value.items()}
        else:
            flat[key] = value
    return flat


def make_rows(
    comparison: Comparison, prepared: Sequence[PreparedCondition], jobs_done: Sequence[JobResults]
) -> tuple[Row, ...]:
    """Make a row per condition and planner from the finished jobs, which may be in any order."""
    rows: list[Row] = []
    for i, condition in enumerate(comparison.conditions):
        parts = [part for part in jobs_done if part.job.condition == i]
        parts.sort(key=lambda part: part.job.start)
        if not parts:
            continue
        results = np.concatenate([part.results for part in parts], axis=1)
        loadings = np.concatenate([part.loadings for part in parts])
        failures = [failure for part in parts for failure in part.failures]
        for k, entry in enumerate(comparison.planner_entries):
            values = _identity(entry, condition, prepared[i], k)
            values |= summarise(results[k], loadings, prepared[i].target.n_atoms)
            first = next((failure for failure in failures if failure.planner_entry == k), None)
            # plans that break a rule are not counted
            counts = np.bincount(results[k]["n_batches"][~results[k]["failed"]])
            rows.append(Row(entry, condition, values, first, counts))
    return tuple(rows)


def _identity(
    entry: PlannerEntry, condition: Condition, prepared: PreparedCondition, k: int
) -> dict[str, Any]:
    """Planner ``k`` with all its settings, and the condition."""
    runner = prepared.runners[k]
    return {
        "planner": entry.planner,
        "label": entry.label,
        "settings": dict(runner.settings),
        "choice": list(choice_of(runner.planner, prepared.target)),
        "degree_of_parallelism": runner.degree_of_parallelism,
        "grid": dict(zip(("rows", "cols"), condition.shape, strict=True)),
        "target": condition.target,
        "target_name": prepared.target.name,
        "n_target_atoms": prepared.target.n_atoms,
        "loading": condition.loading,
    }


def summarise(results: NDArray[Any], loadings: NDArray[Any], n_atoms: int) -> dict[str, Any]:
    """Numbers of loadings, and means with errors over the loadings with a valid plan, in SI units.

    Args:
        results: :data:`labseq.bench.work.RESULT` (n,) of one planner.
        loadings: :data:`labseq.bench.work.LOADING` (n,).
        n_atoms: Number of sites of the target.

    Returns:
        ``n_short`` loadings have fewer atoms than the target, and ``n_failed`` no valid plan. Linked batches
        count as one. An atom that is picked up again counts again. ``n_scans`` and ``scan_s`` are NaN for
        a planner whose paper counts batches. ``n_lost`` and ``p_defect_free`` are predicted. ``bound`` is
        the number of lines that cover the vacancies, see :func:`labseq.bench.work.lines_to_cover`, and
        ``ratio_to_bound`` the mean number of batches over the mean bound, both over the loadings whose
        target was filled.
    """
    valid = ~results["failed"]
    valid_results = results[valid]
    filled = valid_results["n_defects"] == 0
    planning_s = valid_results["planning_s"] if len(valid_results) else np.array([math.nan])
    means = ("n_batches", "n_atoms_moved", "distance_m", "motion_s", "moving_s", "n_scans", "scan_s")
    return {
        "n_loadings": len(results),
        "n_short": int(np.count_nonzero(loadings["n_atoms"] < n_atoms)),
        "n_failed": int(np.count_nonzero(~valid)),
        **{name: mean(valid_results[name]) for name in means},
        "filling_fraction": mean(1.0 - valid_results["n_defects"] / max(1, n_atoms)),
        **{name: mean(valid_results[name]) for name in ("n_lost", "p_defect_free")},
        "target_met": mean(filled & (valid_results["n_surplus"] == 0)),
        "bound": mean(loadings["n_lines"]),
        "ratio_to_bound": ratio_of_means(
            valid_results["n_batches"][filled], loadings["n_lines"][valid][filled]
        ),
        "planning_s": {
            "median": float(np.median(planning_s)),
            "p99": float(np.quantile(planning_s, 0.99)),
        },
    }


def _table(report: Report) -> list[str]:
    if not report.rows:
        return ["no plan was made"]
    hidden: set[str] = set()
    if not any(row.scans for row in report.rows):
        hidden |= {"scans", "scans/ms"}
    if all(row["moving_s"] == row["motion_s"] for row in report.rows):
        hidden.add("moving/ms")
    return table(report.rows, [column for column in COLUMNS if column.heading not in hidden])


def notes(report: Report) -> list[str]:
    """Notes below the table on numbers of loadings, missing atoms and wrong plans."""
    comparison = report.comparison
    extent = plural(comparison.n_loadings, "loading")
    if report.ended_by is not None:
        extent = f"INCOMPLETE: {report.n_done} of {report.n_wanted} loadings"
    if report.rows:
        extent += f", bound {report.rows[0]['bound']} batches"
    lines = ["", f"{extent}, seed {comparison.seed}, {format_quantity(report.duration_s, 'time')}"]
    if any(row.scans for row in report.rows):
        lines.append("scans (with their duration) are counted in the planner's paper instead of batches")
    for row in report.rows[:1]:
        if row["n_short"]:
            few = f"{row['n_short']} of {row['n_loadings']} loadings hold fewer atoms"
            lines.append(f"{few} than {row['target_name']} has sites")
    for row in report.rows:
        lines += [f"{row['label']} chose {text}" for text in row["choice"][:1]]
        if row.first_failure is not None:
            lines += _failure(comparison, row, row.first_failure)
    return lines


def _failure(comparison: Comparison, row: Row, failure: Failure) -> list[str]:
    count = (
        f"{row['n_failed']} of {row['n_loadings']} plans are wrong, the first of loading {failure.loading}"
    )
    return [
        f"{row['label']}: {count}: {failure.message}",
        f"  see it with: {_again(comparison, row, failure.loading)}",
    ]


def _again(comparison: Comparison, row: Row, loading: int) -> str:
    """The command that plans one loading again."""
    condition = row.condition
    rows, cols = condition.shape
    seed = loading_seed(comparison.seed, loading)
    if condition.motion != BARE_MOTION:  # `labseq plan` would need a profile for it
        return f"numpy.random.default_rng({seed}).random(({rows}, {cols})) < {condition.loading:g}"
    command = ["labseq", "plan", f"random:{rows}x{cols}@{condition.loading:g}", "--seed", str(seed)]
    command += ["--target", condition.target, "--planner", row.planner_entry.planner]
    if "degree_of_parallelism" in row["settings"] and condition.degree_of_parallelism is not None:
        command += ["--dop", str(condition.degree_of_parallelism)]
    for key, value in (*comparison.settings, *row.planner_entry.settings):
        command += ["--set", f"{key}={value}"]
    return shlex.join(command)


def save_histogram(path: Path, report: Report) -> None:
    """Draw how many batches the planners need, for conditions that differ only in parallelism, as a PNG.

    Args:
        path: The file.
        report: The comparison, with at least one row.

    Raises:
        ConfigError: The file cannot be written.
    """

    def draw() -> Figure:
        condition, *other_conditions = report.comparison.conditions
        figure = make_figure(5.4, 4.2, layout="constrained")
        axes = figure.add_subplot()
        for i, row in enumerate(report.rows):
            parallel = f", {row['degree_of_parallelism']} tweezers" if other_conditions else ""
            label = f"{row['label']}{parallel}: {row['n_batches']}"
            draw_histogram(axes, row.counts, f"C{i % 10}", label)
        axes.set_xlabel("batches")
        axes.set_ylabel("share of the loadings")
        if any(row.counts.any() for row in report.rows):
            axes.legend(frameon=False, fontsize=8)
        rows, cols = condition.shape
        conditions = f"{100 * condition.loading:g} % loading"
        if condition.degree_of_parallelism is not None and not other_conditions:
            conditions += f", degree of parallelism {condition.degree_of_parallelism}"
        target = report.rows[0]["target_name"]
        title = f"{target} out of {rows} x {cols}, {conditions}\n{report.extent_text}"
        figure.suptitle(title, fontsize=9)
        return figure

    save_figure(path, draw, dpi=150)


def draw_histogram(axes: Axes, counts: NDArray[np.int64], colour: str, label: str) -> None:
    """Draw the share of each number of batches. ``counts`` has how often 0, 1, 2, ... were needed."""
    occurring = np.flatnonzero(counts)
    if len(occurring):
        first, last = int(occurring[0]), int(occurring[-1])
        edges, share = np.arange(first, last + 2) - 0.5, counts[first : last + 1] / counts.sum()
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.45, label=label)
        axes.stairs(share, edges, color=colour, linewidth=1)
