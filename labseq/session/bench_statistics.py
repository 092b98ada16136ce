"""Ratios of means, and power laws."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

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
