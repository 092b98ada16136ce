"""Survival of pick-up, hold and drop against the distance of the mobile tweezer from its site."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model import SiteGrid

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

MIN_P: Final = 1e-4
"""Probabilities this near to 0 or 1 are not told apart: a single false detection in so many atoms."""


REACH: Final = 1.5
"""In half-widths: half survive at about a waist; from 1.6 waists on, wells of 2.1 and 0.3 mK are two."""


@dataclass(frozen=True, slots=True)
class SurvivalShape:
    """The bump of survival around a site.

    An atom picked up and dropped near its site survives; one that is dropped on the slope of
    the site's light is lost. Far beside the site the mobile tweezer does not take the atom at all,
    and it survives again: the bump stands in a ring of loss, whose far side is not described here.

    Attributes:
        half_width_m: Distance at which half of the atoms that the bump makes a difference to survive.
        edge_m: Width of its edge, 1 sigma of the error function.
        floor: Survival in the ring.
        ceiling: Survival at the centre.
    """

    half_width_m: float
    edge_m: float
    floor: float = 0.0
    ceiling: float = 1.0

    @property
    def reach_m(self) -> float:
        """Distance up to which the shape holds: short of the far side of the ring."""
        return REACH * self.half_width_m

    def survival(self, distance_m: ArrayLike) -> Floats:
        """Probability that an atom survives, for tweezers at some distances from their sites.

        Example:
            >>> shape = SurvivalShape(half_width_m=0.95e-6, edge_m=0.12e-6, floor=0.02, ceiling=0.98)
            >>> shape.survival([0.0, 0.95e-6, 1.5e-6]).round(3).tolist()
            [0.98, 0.5, 0.02]
        """
        from scipy.special import ndtr

        bump = ndtr((self.half_width_m - np.asarray(distance_m, np.float64)) / self.edge_m)
        return self.floor + (self.ceiling - self.floor) * bump

    def values(self) -> dict[str, float]:
        """What a calibration keeps of it."""
        return {
            "half_width_m": self.half_width_m,
            "edge_m": self.edge_m,
            "floor": self.floor,
            "ceiling": self.ceiling,
        }

    @classmethod
    def from_values(cls, values: Mapping[str, ArrayLike]) -> SurvivalShape | None:
        """The shape that a calibration kept; None if it kept none."""
        names = ("half_width_m", "edge_m", "floor", "ceiling")
        if any(name not in values for name in names):
            return None
        return cls(*(float(np.asarray(values[name])) for name in names))


def unit_axes(grid: SiteGrid) -> Floats:
    """Directions of a1 and a2, float64 (2, 2): an offset times them is the place beside the site.

    Example:
        >>> unit_axes(SiteGrid(2, 2)).round(3).tolist()
        [[1.0, 0.0], [0.5, 0.866]]
    """
    return grid.axes / grid.spacing_m


def distance_m(offset_m: Floats, axes: Floats) -> Floats:
    """Distance of tweezers from their sites, float64 (...,).

    Args:
        offset_m: float64 (..., 2), along a1 and a2.
        axes: float64 (2, 2), of :func:`unit_axes`.
    """
    place = offset_m @ axes
    return np.hypot(place[..., 0], place[..., 1])


def deviance_residuals(n_survived: Floats, n_before: Floats, p: Floats) -> Floats:
    """Signed roots of the binomial deviance; their sum of squares is least at the greatest likelihood."""
    from scipy.special import xlog1py

    p = np.clip(p, MIN_P, 1 - MIN_P)
    share = np.divide(n_survived, n_before, out=p.copy(), where=n_before > 0)
    over = share - p
    deviance = 2 * n_before * (xlog1py(share, over / p) + xlog1py(1 - share, -over / (1 - p)))
    return np.sign(over) * np.sqrt(np.maximum(deviance, 0.0))


def covariance(theta: Floats, n_before: Floats, model: Callable[[Floats], Floats], prior: Floats) -> Floats:
    """Covariance of parameters fitted to binomial counts: the inverse of the Fisher information.

    Args:
        theta: float64 (n,), the parameters.
        n_before: float64 (n_points,), atoms that were probed.
        model: Parameters -> probability of survival, float64 (n_points,).
        prior: float64 (n,), how well each parameter was known before, 1 sigma; it keeps
            those that the counts say nothing about from spoiling the inverse.
    """
    jacobian = slopes(theta, model, 1e-4 * prior)
    p = np.clip(model(theta), MIN_P, 1 - MIN_P)
    information = (jacobian.T * (n_before / (p * (1 - p)))) @ jacobian
    scaled = information * np.outer(prior, prior) + np.eye(len(theta))
    return np.linalg.inv(scaled) * np.outer(prior, prior)


def slopes(theta: Floats, model: Callable[[Floats], Floats], step: Floats) -> Floats:
    """Derivatives of a model by its parameters, float64 (n_points, n)."""
    return np.stack(
        [(model(theta + one) - model(theta - one)) / (2 * np.abs(one).sum()) for one in np.diag(step)], axis=1
    )


def dispersion(n_survived: Floats, n_before: Floats, p: Floats, n_parameters: int) -> float:
    """How much more counts scatter than binomial ones: Pearson's chi squared over its degrees, at least 1.

    Losses that are common to the atoms of a shot make it greater.
    """
    asked = n_before > 0
    n, k = n_before[asked], n_survived[asked]
    p = np.clip(p[asked], np.minimum(0.5, 0.5 / n), 1 - np.minimum(0.5, 0.5 / n))
    chi_squared = float((((k - n * p) ** 2) / (n * p * (1 - p))).sum())
    return max(1.0, chi_squared / max(1, len(n) - n_parameters))
