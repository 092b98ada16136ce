"""The overlay from four groups of sites in one shot, where the bump of survival is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model import Occupancy, SiteGrid
from labseq.motion.overlay import checked_counts
from labseq.motion.survival import SurvivalShape, covariance, deviance_residuals, distance_m, unit_axes

Floats = NDArray[np.float64]

DRIFT: Final = 0.1
"""How far the half-width may have changed since it was measured, relative, 1 sigma: with temperature."""
WORST_DEVIANCE: Final = 25.0
"""With four groups and three parameters, one in a million is greater; but a common loss adds to it."""
UM: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class FastOffset:
    """How far the mobile tweezers stand beside the sites.

    Attributes:
        offset_m: float64 (2,), beside what is already made up for, along a1 and a2.
        error_m: float64 (2,), its standard errors.
        n_atoms: Atoms that were probed.
        deviance: How badly the counts go with the bump at the best offset; about 1 if they do.
    """

    offset_m: Floats
    error_m: Floats
    n_atoms: int
    deviance: float = 0.0

    @property
    def fits(self) -> bool:
        """Whether the counts go with the bump at all."""
        return self.deviance < WORST_DEVIANCE

    @property
    def length_m(self) -> float:
        """The greater of both parts, in metres; nan if they are not known."""
        return float(np.abs(self.offset_m).max())


def fast_offset(
    offset_m: ArrayLike,
    n_before: ArrayLike,
    n_survived: ArrayLike,
    shape: SurvivalShape,
    grid: SiteGrid,
) -> FastOffset:
    """Find where the mobile tweezers stand from a few offsets on the edge of a known bump.

    The likelihood is greatest at the answer; the half-width may have drifted by :data:`DRIFT`.
    With offsets of +x and -x, +y and -y on the edge, a shift by a small part of its width makes one
    group of each pair survive more often and the other less. A shift by half the half-width and
    more cannot be measured in this way: it comes out wrong, but not small, or as one that does not
    fit.

    Args:
        offset_m: float64 (n_groups, 2), commanded offsets along a1 and a2.
        n_before: int (n_groups,), atoms that were probed.
        n_survived: int (n_groups,), how many of them were seen afterwards.
        shape: The bump, from the last overlay calibration.
        grid: The grid of sites, for its axes.

    Raises:
        ValueError: The arrays do not belong together.
    """
    offset, n, k = checked_counts(offset_m, n_before, n_survived)
    if not n.any():
        return FastOffset(np.full(2, np.nan), np.full(2, np.inf), 0)
    offset, axes = offset / UM, unit_axes(grid)
    half_width = shape.half_width_m / UM
    in_um = replace(shape, half_width_m=half_width, edge_m=shape.edge_m / UM)

    def survival(theta: Floats) -> Floats:
        bump = replace(in_um, half_width_m=half_width * float(np.exp(theta[2])))
        return bump.survival(distance_m(offset - theta[:2], axes))

    def residuals(theta: Floats) -> Floats:
        return np.append(deviance_residuals(k, n, survival(theta)), theta[2] / DRIFT)

    theta = _least(residuals, half_width)
    spread = covariance(theta, n, survival, np.array([half_width, half_width, DRIFT]))
    deviance = float((residuals(theta) ** 2).sum())
    return FastOffset(-theta[:2] * UM, np.sqrt(np.diag(spread)[:2]) * UM, int(n.sum()), deviance)


def group_counts(
    offset_m: ArrayLike, before: Occupancy, after: Occupancy
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Count survivors by the offset at which they were probed.

    Args:
        offset_m: float64 (n_rows, n_cols, 2), offset of each site, or (2,) for all.
        before: bool (n_rows, n_cols), the atoms that were probed.
        after: bool (n_rows, n_cols), those seen afterwards.

    Returns:
        The offsets, float64 (n_groups, 2), and the atoms before and after, int64 (n_groups,).

    Example:
        >>> before, after = np.array([[1, 1, 0]], bool), np.array([[0, 1, 1]], bool)
        >>> [each.tolist() for each in group_counts((0.5, 0.0), before, after)]
        [[[0.5, 0.0]], [2], [1]]
    """
    offsets = np.broadcast_to(np.asarray(offset_m, np.float64), (*before.shape, 2))
    kinds, group = np.unique(offsets.reshape(-1, 2), axis=0, return_inverse=True)
    n_before = np.bincount(group.ravel(), before.ravel(), len(kinds)).astype(np.int64)
    n_survived = np.bincount(group.ravel(), (before & after).ravel(), len(kinds)).astype(np.int64)
    return kinds, n_before, n_survived


def _least(residuals: Callable[[Floats], Floats], reach: float) -> Floats:
    """Centre and drift with the least sum of squares; begun at the best of a grid of centres."""
    from scipy.optimize import least_squares

    places = reach * np.arange(-7, 8) / 7  # 0 is exact: from a dust of it the first step would be as small
    starts = [np.array([along, across, 0.0]) for along in places for across in places]
    start = min(starts, key=lambda theta: float((residuals(theta) ** 2).sum()))
    bounds = np.array([1.5 * reach, 1.5 * reach, 5 * DRIFT])
    return least_squares(residuals, start, bounds=(-bounds, bounds), x_scale=[0.1, 0.1, DRIFT]).x
