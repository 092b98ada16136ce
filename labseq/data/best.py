"""The best shot of a run, and the best point of an adaptive scan with the extremum of a parabola."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.data.points import ScanPoint, reporting_damage, scan_points
from labseq.data.quantities import Quantity, quantity_of
from labseq.data.reader import Run
from labseq.model import ScanRange
from labseq.model.estimate import Estimated
from labseq.recording.run_file import SCANNER
from labseq.units import written


@dataclass(frozen=True, slots=True, eq=False)
class BestPoint:
    """The result of an adaptive scan.

    Attributes:
        quantity: The quantity that was optimised.
        point: The point with the best mean.
        value: The mean there.
        suggested: Address -> the extremum of a parabola through the points near it, in the units of the
            sequence. The best value where the points have no extremum.
        is_fitted: True if at least one value is such an extremum.
    """

    quantity: Quantity
    point: ScanPoint
    value: Estimated
    suggested: Mapping[str, str]
    is_fitted: bool

    def as_json(self) -> dict[str, Any]:
        """The result as JSON-ready values."""
        return {
            "figure": self.quantity.name,
            "best": dict(self.point.written),
            "value": self.value.value,
            "interval": list(self.value.interval),
            "shots": len(self.point.shots),
            "suggested": dict(self.suggested),
        }


@dataclass(frozen=True, slots=True)
class BestShot:
    """The shot that came nearest to the target.

    Attributes:
        shot: Index of the shot.
        success: Whether it met the target on its last image. None if this is unknown.
        filling: Fraction of the target's sites that held an atom on its last image.
        n_cycles: Number of rearrangement cycles that it took.
        duration_s: Sum of the durations of its steps.
    """

    shot: int
    success: bool | None
    filling: float
    n_cycles: int
    duration_s: float


def best_shot(run: Run) -> BestShot | None:
    """A shot that met the target, otherwise the fullest one. Among equals, the one with the fewest cycles.

    Returns:
        None if the run has no target, or no shot could be judged.
    """
    judged = [
        BestShot(row.shot, row.success, row.filling_fraction, row.n_cycles, row.duration_s)
        for row in (shot.row for shot in run.shots)
        if not math.isnan(row.filling_fraction)
    ]

    def rank(one: BestShot) -> tuple[float, ...]:
        return not one.success, -one.filling, one.n_cycles, one.duration_s, one.shot

    return min(judged, key=rank, default=None)


def best_point(run: Run) -> BestPoint | None:
    """The best point of a run's adaptive scan. None without such a scan, or if no shot has its quantity.

    Raises:
        RecordingError: The scan's record in run.json is damaged.
    """
    scan = run.scan
    if SCANNER not in scan:
        return None
    with reporting_damage(run.path):
        quantity = quantity_of(run, str(scan["figure"]))
        ranges = [ScanRange(**values) for values in scan["ranges"]]
        units, sign = [str(unit) for unit in scan["written_units"]], 1.0 if scan["maximise"] else -1.0
    pairs = [(point, quantity.over(point.shots)) for point in scan_points(run)]
    measured = [(point, value) for point, value in pairs if not math.isnan(value.value)]
    if not measured:
        return None
    best = max(range(len(measured)), key=lambda i: sign * measured[i][1].value)
    places = np.array(
        [[axis.fraction(point.parameters[axis.address]) for axis in ranges] for point, _ in measured]
    )
    scores = np.array([sign * value.value for _, value in measured])
    steps = extremum(places, scores, [value for _, value in measured], best)
    values = [
        axis.at(place + step) if step else measured[best][0].parameters[axis.address]
        for axis, place, step in zip(ranges, places[best].tolist(), steps.tolist(), strict=True)
    ]
    suggested = {  # a fit gets four digits because it is no better, a taken point is exact
        axis.address: written(float(f"{value:.4g}") if step and not axis.n_steps else value, unit)
        for axis, value, unit, step in zip(ranges, values, units, steps.tolist(), strict=True)
    }
    return BestPoint(quantity, *measured[best], suggested, is_fitted=bool(steps.any()))


def extremum(
    places: NDArray[np.float64], scores: NDArray[np.float64], values: Sequence[Estimated], best: int
) -> NDArray[np.float64]:
    """Distance of a parabola's maximum from the best point, along each axis.

    A parabola without mixed terms is fitted to the nearer half of the points, weighted with their
    errors. Where it has no maximum within these points, the distance is 0.

    Args:
        places: float64 (n_points, n_axes), from 0 to 1.
        scores: float64 (n_points,). Higher is better.
        values: The same with their errors.
        best: Index of the best point.

    Example:
        >>> x = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
        >>> extremum(x[:, None], -((x - 0.5) ** 2), [], 2).round(3).tolist()
        [0.1]
    """
    n_points, n_axes = places.shape
    n_used = max(2 * n_axes + 2, -(-n_points // 2))  # one more than the parabola's 2 n_axes + 1 coefficients
    if n_points < n_used:
        return np.zeros(n_axes)
    offsets = places - places[best]
    nearest = np.argsort((offsets**2).sum(axis=1), kind="stable")[:n_used]
    offsets = offsets[nearest]
    errors = np.array(
        [(high - low) / 2 for low, high in (values[i].interval for i in nearest)] if values else []
    )
    known_errors = errors[np.isfinite(errors) & (errors > 0)]
    # a point without an error, such as a single shot, counts as the worst of the others
    weights = (
        1 / np.where(np.isfinite(errors) & (errors > 0), errors, known_errors.max())
        if len(known_errors)
        else 1.0
    )
    terms = np.concatenate([np.ones((n_used, 1)), offsets, offsets**2], axis=1)
    coefficients = np.linalg.lstsq((terms.T * weights).T, scores[nearest] * weights, rcond=None)[0]
    slope, curvature = coefficients[1 : 1 + n_axes], coefficients[1 + n_axes :]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -slope / (2 * curvature)
    inside = (curvature < 0) & (step >= offsets.min(axis=0)) & (step <= offsets.max(axis=0))
    return np.where(inside, step, 0.0)
