"""Weighted least squares: fits the parameters of a function and gives their errors.

Uses numpy alone because it also runs while shots arrive and at each ``labseq show --fit``. Importing
scipy.optimize takes longer than everything else in that command, and lmfit three times as long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

MAX_STEPS: Final = 500

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """A minimum of chi-square.

    Attributes:
        parameters: float64 (n,).
        covariance: float64 (n, n), for residuals with a standard deviation of 1.
        chi2: Sum of the squared residuals.
    """

    parameters: Floats
    covariance: Floats
    chi2: float


def minimise(
    residuals: Callable[[Floats], Floats],
    start: Floats,
    at_least: Floats,
    scales: Floats,
    relative_step: float,
) -> Minimum | None:
    """Find the nearest minimum of the sum of squared residuals, as Levenberg and Marquardt do.

    Args:
        residuals: Parameters -> residuals in units of their errors. Not finite outside the function's range.
        start: Parameters to start at.
        at_least: Their smallest values.
        scales: Their typical sizes. 0 if unknown.
        relative_step: Step of the derivatives, relative to size or value, whichever is larger.

    Returns:
        None if the start has no residuals, or there is no minimum within 500 steps.
    """
    at = np.maximum(start, at_least)
    current, damping = residuals(at), 1e-3
    # the smallest relative decrease of chi-square worth a step, because jumps of residuals hide small ones
    tolerance = max(1e-12, 0.1 * relative_step**2)
    for _ in range(MAX_STEPS if np.isfinite(current).all() else 0):
        slopes = _slopes(residuals, at, current, relative_step * np.maximum(np.abs(at), scales))
        # in units of the columns' lengths, parameters of all sizes are damped alike
        lengths = np.linalg.norm(slopes, axis=0)
        lengths[lengths == 0] = 1.0
        damping, chi2 = damping / 10, float(current @ current)
        while True:
            step = _damped_step(slopes / lengths, current, damping) / lengths
            predicted = current + slopes @ step
            if chi2 - predicted @ predicted <= tolerance * chi2:
                return Minimum(at, _covariance(slopes / lengths) / np.outer(lengths, lengths), chi2)
            # a parameter that reached its smallest value, such as a width of 0, would never leave it again
            trial = np.maximum(at + step, at_least + 0.1 * (at - at_least).clip(max=1e300))
            after = residuals(trial)
            if np.isfinite(after).all() and after @ after < chi2:
                break
            damping *= 10
        at, current = trial, after
    return None


def _slopes(residuals: Callable[[Floats], Floats], at: Floats, current: Floats, steps: Floats) -> Floats:
    """The derivatives of the residuals, float64 (n_points, n_parameters)."""
    steps = np.maximum(steps, 1e-18)  # of a parameter of unknown size that starts at 0
    columns = [(residuals(at + step) - current) / step.sum() for step in np.diag(steps)]
    return np.nan_to_num(np.stack(columns, axis=1))


def _damped_step(slopes: Floats, current: Floats, damping: float) -> Floats:
    n = slopes.shape[1]
    rows: Any = np.vstack([slopes, np.sqrt(damping) * np.eye(n)])
    return np.linalg.lstsq(rows, -np.concatenate([current, np.zeros(n)]), rcond=None)[0]


def _covariance(slopes: Floats) -> Floats:
    """The inverse of the slopes' products. Very large for a combination that changes nothing."""
    _, sizes, directions = np.linalg.svd(slopes, full_matrices=False)
    return (directions.T / np.maximum(sizes, 1e-12) ** 2) @ directions
