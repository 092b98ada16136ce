"""What came of a comparison, for the screen."""

from __future__ import annotations

import math
import shlex
from typing import Final

from labseq.cli.output import columns
from labseq.cli.words import percent, plural
from labseq.model.estimate import Estimate
from labseq.session.bench_curves import points_of
from labseq.session.bench_figures import Figure
from labseq.session.bench_report import Report, Row
from labseq.session.bench_spec import BARE_MOTION
from labseq.session.bench_work import loading_seed
from labseq.units import format_quantity

_TEXT_COLUMNS: Final = {"planner", "target", "grid"}


def table(report: Report) -> list[str]:
    """A line per planner and condition; conditions are named only where they differ."""
    if not report.rows:
        return ["nothing was done"]
    rows = [_cells(row, report) for row in report.rows]
    header = list(rows[0])
    right = [i for i, name in enumerate(header) if name not in _TEXT_COLUMNS]
    return columns([header, *([row[name] for name in header] for row in rows)], right)


def notes(report: Report, figure: Figure | None) -> list[str]:
    """What the table cannot say: fits, what is left out, what went wrong."""
    lines = [_extent(report)]
    if any(row.scans for row in report.rows):
        lines.append("scans: what the source of the planner counts instead of batches, and their time")
    lines += _shortages(report)
    if figure is not None:
        lines += [*_fits(report, figure), f"the paper, figure {figure.name}: {figure.paper}"]
    for row in report.rows:
        lines += _failure(report, row)
    return ["", *lines]


def _cells(row: Row, report: Report) -> dict[str, str]:
    conditions = report.comparison.conditions
    rows, cols = row.condition.shape
    cells: dict[str, str] = {"planner": row.planner_entry.label}
    if len({condition.shape for condition in conditions}) > 1:
        cells["grid"] = f"{rows}x{cols}"
    if len({condition.target for condition in conditions}) > 1:
        cells |= {"target": row.condition.target, "atoms": str(row.n_target_atoms)}
    cells |= {
        "DOP": str(row.degree_of_parallelism),
        "batches": str(row.n_batches),
        "atoms moved": str(row.n_atoms_moved),
        "distance/mm": str(row.distance_m.scaled(1e3)),
        "motion/ms": str(row.motion_s.scaled(1e3)),
    }
    if any(other.scans for other in report.rows):
        cells |= {"scans": str(row.n_scans), "scans/ms": str(row.scan_s.scaled(1e3))}
    return cells | {
        "planning": _time(row.planning_median_s),
        "99 %": _time(row.planning_p99_s),
        "filled": percent(row.filling_fraction.value, 2),
        "met": percent(row.target_met.value, 2),
        "/bound": str(row.ratio_to_bound),
    }


def _fits(report: Report, figure: Figure) -> list[str]:
    """The power laws, and what the curves come to at the last point."""
    every = [points for points in points_of(report, figure) if points.law is not None]
    if not every:
        return []
    what, unit, factor = ("time", " ms", 1e3) if figure.y == "motion_s" else ("number", "", 1.0)
    lines = [f"{points.label}: {what} ~ N^{points.law.exponent}" for points in every if points.law]
    first = every[0].y[-1]
    last = [
        f"{points.label} {Estimate(points.y[-1], points.error[-1]).scaled(factor)}{unit}"
        f" (x {points.y[-1] / first:.3g})"
        for points in every
    ]
    return [*lines, f"at {every[0].x[-1]:.0f} atoms: {', '.join(last)}"]


def _time(duration_s: float) -> str:
    return "-" if math.isnan(duration_s) else format_quantity(duration_s, "time")


def _extent(report: Report) -> str:
    comparison, n_conditions = report.comparison, len(report.comparison.conditions)
    text = plural(comparison.n_loadings, "loading")
    text += f" for each of {n_conditions} conditions" if n_conditions > 1 else ""
    if report.ended_by is not None:
        text = f"INCOMPLETE: {report.n_done} of {report.n_wanted} loadings"
    if report.rows and n_conditions == 1:
        text += f"; bound {report.rows[0].bound} batches"
    return f"{text}; seed {comparison.seed}; {format_quantity(report.duration_s, 'time')}"


def _shortages(report: Report) -> list[str]:
    short = {row.condition: row for row in report.rows if row.n_short}
    return [
        f"{row.n_short} of {row.n_loadings} loadings hold fewer atoms than {condition.target} has sites"
        for condition, row in short.items()
    ]


def _failure(report: Report, row: Row) -> list[str]:
    failure = row.first_failure
    if failure is None:
        return []
    what = f"{row.n_failed} of {row.n_loadings} plans are wrong; the first, of loading {failure.loading}"
    return [
        f"{row.planner_entry.label}: {what}: {failure.message}",
        f"  see it with: {_again(report, row, failure.loading)}",
    ]


def _again(report: Report, row: Row, loading: int) -> str:
    """How one loading is planned again."""
    condition, comparison = row.condition, report.comparison
    rows, cols = condition.shape
    seed = loading_seed(comparison.seed, loading)
    if condition.motion != BARE_MOTION:  # which takes a profile
        return f"numpy.random.default_rng({seed}).random(({rows}, {cols})) < {condition.loading:g}"
    words = ["labseq", "plan", f"random:{rows}x{cols}@{condition.loading:g}", "--seed", str(seed)]
    words += ["--target", condition.target, "--planner", row.planner_entry.planner]
    if "degree_of_parallelism" in row.settings and condition.degree_of_parallelism is not None:
        words += ["--dop", str(condition.degree_of_parallelism)]
    for key, value in (*comparison.settings, *row.planner_entry.settings):
        words += ["--set", f"{key}={value}"]
    return shlex.join(words)
