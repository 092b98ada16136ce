"""From the rows of a comparison to the curves and histograms of a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing import ComparisonDrawing, Curve, Histogram
from labseq.model.estimate import Estimate
from labseq.session.bench_figures import Figure, Quantity
from labseq.session.bench_report import Report, Row
from labseq.session.bench_statistics import PowerLaw, fit_power_law

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
