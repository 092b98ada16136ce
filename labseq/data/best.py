"""The best point of an adaptive scan, and the value that a parabola through the points near it suggests."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.data.points import SCANNER, ScanPoint, reporting_damage, scan_points
from labseq.data.quantities import Quantity, quantity_of
from labseq.data.reader import Run
from labseq.model import ScanRange
from labseq.model.estimate import Estimated
from labseq.units import written


@dataclass(frozen=True, slots=True, eq=False)
class BestPoint:
    """The result of an adaptive scan.

    Attributes:
        quantity: What was optimised.
        point: The point with the best mean.
        value: The mean there.
        suggested: Address -> the extremum of a parabola through the points near it, in the units of the
            sequence; the best value where the points have no extremum.
        is_fitted: Whether some value is such an extremum.
    """

    quantity: Quantity
    point: ScanPoint
    value: Estimated
    suggested: Mapping[str, str]
    is_fitted: bool

    def as_json(self) -> dict[str, Any]:
        """The result, JSON-ready."""
        return {
            "figure": self.quantity.name,
            "best": dict(self.point.written),
            "value": self.value.value,
            "interval": list(self.value.interval),
            "shots": len(self.point.shots),
            "suggested": dict(self.suggested),
        }


def best_point(run: Run) -> BestPoint | None:
    """The best point of a run's adaptive scan; None without one, or if no shot has its quantity.

    Raises:
        RecordingError: The scan's record in run.json is damaged.
    """
    scan = run.scan
    if SCANNER not in scan:
        return None
    with reporting_damage(run.path):
        quantity = quantity_of(run, str(scan["figure"]))
        ranges = [ScanRange(**one) for one in scan["ranges"]]
        units, sign = [str(unit) for unit in scan["written_units"]], 1.0 if scan["maximise"] else -1.0
    pairs = [(point, quantity.over(point.shots)) for point in scan_points(run)]
    known = [(point, value) for point, value in pairs if not math.isnan(value.value)]
    if not known:
        return None
    best = max(range(len(known)), key=lambda i: sign * known[i][1].value)
    places = np.array([[one.fraction(point.parameters[one.address]) for one in ranges] for point, _ in known])
    scores = np.array([sign * value.value for _, value in known])
    steps = extremum(places, scores, [value for _, value in known], best)
    chosen = [
        one.at(place + step) if step else known[best][0].parameters[one.address]
        for one, place, step in zip(ranges, places[best].tolist(), steps.tolist(), strict=True)
    ]
    suggested = {
        one.address: written(float(f"{value:.4g}") if step and not one.n_steps else value, unit)
        for one, value, unit, step in zip(ranges, chosen, units, steps.tolist(), strict=True)
    }
    return BestPoint(quantity, *known[best], suggested, is_fitted=bool(steps.any()))


def extremum(
    places: NDArray[np.float64], scores: NDArray[np.float64], values: Sequence[Estimated], best: int
) -> NDArray[np.float64]:
    """How far the maximum of a parabola is from the best point, along each axis.

    The parabola, without mixed terms, is fitted to the nearer half of the points, weighted with their
    errors. Where it has no maximum within these points, the answer is 0.

    Args:
        places: float64 (n_points, n_axes), from 0 to 1.
        scores: float64 (n_points,), the more the better.
        values: The same with their errors.
        best: Index of the best point.

    Example:
        >>> x = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
        >>> extremum(x[:, None], -((x - 0.5) ** 2), [], 2).round(3).tolist()
        [0.1]
    """
    n_points, n_axes = places.shape
    n_used = max(2 * n_axes + 2, -(-n_points // 2))
    if n_points < n_used:
        return np.zeros(n_axes)
    away = places - places[best]
    used = np.argsort((away**2).sum(axis=1), kind="stable")[:n_used]
    away = away[used]
    errors = np.array(
        [(high - low) / 2 for low, high in (values[i].interval for i in used)] if values else []
    )
    known = errors[np.isfinite(errors) & (errors > 0)]
    weights = 1 / np.where(np.isfinite(errors) & (errors > 0), errors, known.max()) if len(known) else 1.0
    terms = np.concatenate([np.ones((n_used, 1)), away, away**2], axis=1)
    fitted = np.linalg.lstsq((terms.T * weights).T, scores[used] * weights, rcond=None)[0]
    slope, curvature = fitted[1 : 1 + n_axes], fitted[1 + n_axes :]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -slope / (2 * curvature)
    inside = (curvature < 0) & (step >= away.min(axis=0)) & (step <= away.max(axis=0))
    return np.where(inside, step, 0.0)
