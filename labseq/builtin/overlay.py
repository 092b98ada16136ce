"""The offset of the mobile tweezers from the sites, from the survival of pick-up, hold and drop.

A probe commands an offset, which adds to the unknown offset of the tweezers. Atoms survive best at the
*centre*, where both cancel, so the tweezers are displaced from the sites by minus the centre
(:func:`overlay_offset`). Around a site, the *survival peak* is surrounded by a ring of loss. Beyond the ring
the tweezer does not capture the atom, and it survives again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.errors import DeviceError
from labseq.model import Occupancy, SiteGrid
from labseq.units import format_quantity

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

MIN_P: Final = 1e-4
"""Rate of false detections. Probabilities are kept this far from 0 and 1."""


REACH: Final = 1.5
"""In half-widths. Half survive at about a waist, and from 1.6 waists wells of 2.1 and 0.3 mK are separate."""


@dataclass(frozen=True, slots=True)
class SurvivalShape:
    """The survival peak around a site.

    An atom picked up and dropped near its site survives. An atom dropped on the slope of the site's light is
    lost. Far away from the site the mobile tweezer does not capture the atom, which survives again. This
    outer side of the ring of loss is not described here.

    Attributes:
        half_width_m: Distance at which survival is half-way between floor and ceiling.
        edge_m: Width of the peak's edge, 1 sigma of the error function.
        floor: Survival in the ring.
        ceiling: Survival at the centre.
    """

    half_width_m: float
    edge_m: float
    floor: float = 0.0
    ceiling: float = 1.0

    @property
    def reach_m(self) -> float:
        """Distance up to which the shape is valid, before the outer side of the ring."""
        return REACH * self.half_width_m

    def survival(self, distance_m: ArrayLike) -> Floats:
        """Probability that an atom survives, for tweezers at some distances from their sites.

        Example:
            >>> shape = SurvivalShape(half_width_m=0.95e-6, edge_m=0.12e-6, floor=0.02, ceiling=0.98)
            >>> shape.survival([0.0, 0.95e-6, 1.5e-6]).round(3).tolist()
            [0.98, 0.5, 0.02]
        """
        from scipy.special import ndtr

        peak = ndtr((self.half_width_m - np.asarray(distance_m, np.float64)) / self.edge_m)
        return self.floor + (self.ceiling - self.floor) * peak

    def values(self) -> dict[str, float]:
        """The values that a calibration stores."""
        return {
            "half_width_m": self.half_width_m,
            "edge_m": self.edge_m,
            "floor": self.floor,
            "ceiling": self.ceiling,
        }

    @classmethod
    def from_values(cls, values: Mapping[str, ArrayLike]) -> SurvivalShape | None:
        """The shape stored in a calibration, or None."""
        names = ("half_width_m", "edge_m", "floor", "ceiling")
        if any(name not in values for name in names):
            return None
        return cls(*(float(np.asarray(values[name])) for name in names))


def unit_axes(grid: SiteGrid) -> Floats:
    """Directions of a1 and a2, float64 (2, 2). Times an offset, they give the displacement from the site.

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
    """Signed roots of the binomial deviance. Their sum of squares is minimal at the maximum likelihood."""
    from scipy.special import xlog1py

    p = np.clip(p, MIN_P, 1 - MIN_P)
    share = np.divide(n_survived, n_before, out=p.copy(), where=n_before > 0)
    over = share - p
    deviance = 2 * n_before * (xlog1py(share, over / p) + xlog1py(1 - share, -over / (1 - p)))
    return np.sign(over) * np.sqrt(np.maximum(deviance, 0.0))


def covariance(theta: Floats, n_before: Floats, model: Callable[[Floats], Floats], prior: Floats) -> Floats:
    """Covariance of parameters fitted to binomial counts, as the inverse of the Fisher information.

    Args:
        theta: float64 (n,), the parameters.
        n_before: float64 (n_points,), atoms that were probed.
        model: Parameters -> probability of survival, float64 (n_points,).
        prior: float64 (n,), prior uncertainty of each parameter, 1 sigma. It keeps the inverse finite for
            parameters that the counts do not determine.
    """
    jacobian = slopes(theta, model, 1e-4 * prior)
    p = np.clip(model(theta), MIN_P, 1 - MIN_P)
    information = (jacobian.T * (n_before / (p * (1 - p)))) @ jacobian
    scaled = information * np.outer(prior, prior) + np.eye(len(theta))
    return np.linalg.inv(scaled) * np.outer(prior, prior)


def slopes(theta: Floats, model: Callable[[Floats], Floats], step: Floats) -> Floats:
    """Derivatives of a model by its parameters, float64 (n_points, n)."""
    return np.stack(
        [
            (model(theta + change) - model(theta - change)) / (2 * np.abs(change).sum())
            for change in np.diag(step)
        ],
        axis=1,
    )


def dispersion(n_survived: Floats, n_before: Floats, p: Floats, n_parameters: int) -> float:
    """Pearson's chi squared per degree of freedom of binomial counts, at least 1.

    Losses common to the atoms of a shot increase it.
    """
    probed = n_before > 0
    n, k = n_before[probed], n_survived[probed]
    p = np.clip(p[probed], np.minimum(0.5, 0.5 / n), 1 - np.minimum(0.5, 0.5 / n))
    chi_squared = float((((k - n * p) ** 2) / (n * p * (1 - p))).sum())
    return max(1.0, chi_squared / max(1, len(n) - n_parameters))


WORST_ERROR_M: Final = 50e-9
"""Maximum error of the centre."""
MIN_ATOMS: Final = 100
ROUNDS: Final = 6
MIN_CONTRAST: Final = 0.2
UM: Final = 1e-6

_KNOWN_BEFORE: Final = np.array([2.0, 2.0, 1.0, 0.5, 0.3, 0.3])
_LEAST: Final = np.array([-20.0, -20.0, 0.05, 0.01, 0.0, 0.0])
_MOST: Final = np.array([20.0, 20.0, 5.0, 1.0, 1.0, 1.0])
"""Centre, half-width and edge in um, floor, ceiling."""

DIRECTIONS: Final = ("along a row", "from row to row")


@dataclass(frozen=True, slots=True, eq=False)
class OverlayFit:
    """The result of a scan of the probe's offset.

    Attributes:
        centre_m: float64 (2,), commanded offset at which survival is best, along a1 and a2.
        error_m: float64 (2,), its standard errors, including the scatter of the counts.
        shape: The survival peak around the centre.
        dispersion: Scatter of the counts relative to a binomial distribution, at least 1.
        n_atoms: Number of probed atoms.
    """

    centre_m: Floats
    error_m: Floats
    shape: SurvivalShape
    dispersion: float
    n_atoms: int


def overlay_offset(centre_m: ArrayLike, in_use_m: ArrayLike = (0.0, 0.0)) -> Floats:
    """The offset of the mobile tweezers from the sites, which is ``offset_m`` of an overlay calibration.

    Args:
        centre_m: float64 (2,), the commanded offset that puts the tweezers onto the sites.
        in_use_m: The ``offset_m`` that was corrected in the measurement.

    Example:
        >>> overlay_offset([-0.25, 0.125]).tolist(), overlay_offset([0.125, 0.0], [0.25, 0.0]).tolist()
        ([0.25, -0.125], [0.125, 0.0])
    """
    return np.asarray(in_use_m, np.float64) - np.asarray(centre_m, np.float64)


def fit_overlay(
    offset_m: ArrayLike,
    n_before: ArrayLike,
    n_survived: ArrayLike,
    grid: SiteGrid,
    worst_error_m: float = WORST_ERROR_M,
) -> OverlayFit:
    """Find the centre of the survival peak, by maximum likelihood of binomial counts.

    The peak is round and has a flat top and an edge (see :class:`SurvivalShape`). On the triangular lattice
    the axes are not orthogonal. An offset along one axis moves the best place along the other, so both are
    fitted together.

    Args:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int (n_points, ...), number of probed atoms at each offset, in total or per row or site.
        n_survived: int, of the same shape, number of these atoms seen afterwards.
        grid: The grid of sites, for its axes.
        worst_error_m: Maximum error of the centre.

    Raises:
        DeviceError: There is no survival peak, one of its edges is out of range (the message says in which
            direction to continue), or there are too few atoms.
        ValueError: The arrays have different shapes.
    """
    offset, n, k = checked_counts(offset_m, n_before, n_survived)
    n, k = n.reshape(len(n), -1).sum(axis=1), k.reshape(len(k), -1).sum(axis=1)
    if n.sum() < MIN_ATOMS:
        _refuse(f"only {int(n.sum())} atoms were probed, but {MIN_ATOMS} are needed; increase `repeats`")
    for axis, direction in enumerate(DIRECTIONS):
        if len(np.unique(offset[:, axis].round(9))) < 5:
            _refuse(f"the offset {direction} has fewer than 5 values; scan it to both sides of the sites")
    fit = _best_fit(offset / UM, n, k, unit_axes(grid))
    if fit.error_m.max() > worst_error_m:  # a peak in the middle of the scan can look like a narrower one
        other = _best_fit(offset / UM, n, k, unit_axes(grid), 1.6)
        fit = min(fit, other, key=lambda candidate: float(candidate.error_m.max()))
    _refuse_open_ends(fit, offset, unit_axes(grid))
    worst = float(fit.error_m.max())
    if worst > worst_error_m:
        more = math.ceil((worst / worst_error_m) ** 2)
        error, error_limit = format_quantity(worst, "length"), format_quantity(worst_error_m, "length")
        remedy = f"for {error_limit} take {more} times as many `repeats`"
        _refuse(f"there are too few atoms, as the centre is only known to {error}; {remedy}")
    return fit


def checked_counts(
    offset_m: ArrayLike, n_before: ArrayLike, n_survived: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Offsets and counts as float64.

    Raises:
        ValueError: The arrays do not belong together.
    """
    offset, n, k = (np.asarray(values, np.float64) for values in (offset_m, n_before, n_survived))
    if offset.ndim != 2 or offset.shape[1] != 2 or n.shape != k.shape or n.shape[:1] != offset.shape[:1]:
        raise ValueError(f"the shapes of offsets {offset.shape} and counts {n.shape}, {k.shape} do not match")
    if not (np.isfinite(offset).all() and np.isfinite(n).all() and np.all((k >= 0) & (k <= n))):
        raise ValueError("offsets must be finite, and no more atoms may survive than there were")
    return offset, n, k


def _best_fit(offset: Floats, n: Floats, k: Floats, axes: Floats, wider: float = 1.0) -> OverlayFit:
    """Fit the peak to the points in its reach, in micrometres. ``wider`` scales the width at the start."""
    n_atoms, share = int(n.sum()), format_quantity(k.sum() / n.sum(), "fraction")
    theta, within = _start(offset, n, k, axes), np.empty(0, np.bool_)
    theta[2:4] *= wider
    for _ in range(ROUNDS):
        before, within = within, distance_m(offset - theta[:2], axes) < REACH * theta[2]
        if np.array_equal(before, within) or np.count_nonzero(within) <= len(theta):
            break
        theta = _fitted(theta, offset[within], n[within], k[within], axes)
    offset, n, k = offset[within], n[within], k[within]
    even, p = np.full(len(n), k.sum() / max(1.0, n.sum())), _survival(theta, offset, axes)
    gain = sum(sign * float((deviance_residuals(k, n, q) ** 2).sum()) for sign, q in ((1, even), (-1, p)))
    excess = dispersion(k, n, p, len(theta))
    # a survival peak must explain the counts better by this much, relative to their scatter
    if gain < 30.0 * excess or theta[5] - theta[4] < MIN_CONTRAST:
        _refuse(
            f"there is no survival peak, because no offset has clearly more survivors ({share} in all); "
            "scan further, and check that the mobile tweezers are on"
        )
    spread = covariance(theta, n, lambda t: _survival(t, offset, axes), _KNOWN_BEFORE) * excess
    return OverlayFit(theta[:2] * UM, np.sqrt(np.diag(spread)[:2]) * UM, _shape(theta, UM), excess, n_atoms)


def _fitted(start: Floats, offset: Floats, n: Floats, k: Floats, axes: Floats) -> Floats:
    """The parameters of maximum likelihood."""
    from scipy.optimize import least_squares

    def residuals(theta: Floats) -> Floats:
        return deviance_residuals(k, n, _survival(theta, offset, axes))

    inside = np.clip(start, _LEAST + 1e-6, _MOST - 1e-6)
    scale = _KNOWN_BEFORE / 10
    return least_squares(residuals, inside, bounds=(_LEAST, _MOST), x_scale=scale, max_nfev=100).x


def _shape(theta: Floats, unit_m: float = 1.0) -> SurvivalShape:
    half_width, edge, floor, ceiling = (float(value) for value in theta[2:])
    return SurvivalShape(half_width * unit_m, edge * unit_m, floor, ceiling)


def _survival(theta: Floats, offset: Floats, axes: Floats) -> Floats:
    return _shape(theta).survival(distance_m(offset - theta[:2], axes))


def _start(offset: Floats, n: Floats, k: Floats, axes: Floats) -> Floats:
    """Start of the fit, the best of many peaks with and without the outer side of the ring of loss."""
    low, high = offset.min(axis=0), offset.max(axis=0)
    span = float((high - low).max())
    centres = np.stack(np.meshgrid(*np.linspace(low, high, 17).T), axis=-1).reshape(-1, 2)
    distance = distance_m(offset - centres[:, None], axes)
    share = np.divide(k, n, out=np.zeros_like(n), where=n > 0)
    surplus = n * (share - k.sum() / n.sum())
    best, start = -math.inf, np.zeros(0)
    for half_width in span * np.array([0.12, 0.2, 0.28, 0.36, 0.44]):
        for outer in half_width * np.array([1.5, 1.8, 2.2, math.inf]):
            peak = ((distance < half_width) | (distance > outer)).astype(np.float64)
            peak -= (peak @ n / n.sum())[:, None]
            gain = np.maximum(peak @ surplus, 0.0) ** 2 / np.maximum(peak**2 @ n, 1e-12)
            i = int(gain.argmax())
            if gain[i] > best:
                best = float(gain[i])
                start = np.r_[centres[i], half_width, half_width / 6, 0.05, 0.95]
    return start


def _refuse_open_ends(fit: OverlayFit, offset: Floats, axes: Floats) -> None:
    """Refuse a peak whose edges are not both in range, on the scanned lines."""
    cosine = float(axes[0] @ axes[1])
    middle = np.median(offset, axis=0)
    about = np.clip(fit.centre_m, offset.min(axis=0), offset.max(axis=0))
    for axis, direction in enumerate(DIRECTIONS):
        aside = middle[1 - axis] - fit.centre_m[1 - axis]
        squared = fit.shape.half_width_m**2 - aside**2 * (1 - cosine**2)
        centre = " and ".join(
            f"{format_quantity(float(at), 'length')} {name}"
            for at, name in zip(about, DIRECTIONS, strict=True)
        )
        if squared <= 0:
            _refuse(f"the scan {direction} misses the survival peak; scan about {centre}")
        best, half = fit.centre_m[axis] - aside * cosine, math.sqrt(squared)
        low, high = offset[:, axis].min(), offset[:, axis].max()
        if best - half < low or best + half > high:
            end, sign = (low, "-") if best - half < low else (high, "+")
            _refuse(
                f"only one edge of the survival peak is in range {direction}, as survival has not fallen at "
                f"{format_quantity(float(end), 'length')}; continue in direction {sign}, or about {centre}"
            )


def _refuse(why: str) -> NoReturn:
    raise DeviceError("mobile_tweezers", f"no overlay found: {why}")


DRIFT: Final = 0.1
"""Relative change of the half-width since its measurement, 1 sigma, for example with temperature."""


@dataclass(frozen=True, slots=True, eq=False)
class FastOffset:
    """The offset of the mobile tweezers from the sites, from a few groups of atoms.

    Attributes:
        offset_m: float64 (2,), in addition to the active correction, along a1 and a2.
        error_m: float64 (2,), its standard errors.
        n_atoms: Number of probed atoms.
        deviance: Deviance of the counts from the peak at the best offset. About 1 if they agree.
    """

    offset_m: Floats
    error_m: Floats
    n_atoms: int
    deviance: float = 0.0

    @property
    def fits(self) -> bool:
        """Whether the counts agree with the survival peak."""
        # with four groups and three parameters, one in a million is larger, but common losses increase it
        return self.deviance < 25.0

    @property
    def length_m(self) -> float:
        """The larger of both components, in metres. nan if they are not known."""
        return float(np.abs(self.offset_m).max())


def fast_offset(
    offset_m: ArrayLike,
    n_before: ArrayLike,
    n_survived: ArrayLike,
    shape: SurvivalShape,
    grid: SiteGrid,
) -> FastOffset:
    """Find the offset of the mobile tweezers from a few probes on the edge of a known survival peak.

    The fit is by maximum likelihood, and the half-width may have drifted by :data:`DRIFT`. With offsets of +x
    and -x, +y and -y on the edge, a shift by a small fraction of its width makes one group of each pair
    survive more often and the other less often. A shift by half the half-width or more cannot be measured in
    this way. The result is then wrong but not small, or does not fit.

    Args:
        offset_m: float64 (n_groups, 2), commanded offsets along a1 and a2.
        n_before: int (n_groups,), number of probed atoms.
        n_survived: int (n_groups,), number of these atoms seen afterwards.
        shape: The survival peak, from the last overlay calibration.
        grid: The grid of sites, for its axes.

    Raises:
        ValueError: The arrays have different shapes.
    """
    offset, n, k = checked_counts(offset_m, n_before, n_survived)
    if not n.any():
        return FastOffset(np.full(2, np.nan), np.full(2, np.inf), 0)
    offset, axes = offset / UM, unit_axes(grid)
    half_width = shape.half_width_m / UM
    in_um = replace(shape, half_width_m=half_width, edge_m=shape.edge_m / UM)

    def survival(theta: Floats) -> Floats:
        peak = replace(in_um, half_width_m=half_width * float(np.exp(theta[2])))
        return peak.survival(distance_m(offset - theta[:2], axes))

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
        after: bool (n_rows, n_cols), the atoms seen afterwards.

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
    """Centre and drift with the least sum of squares, starting from the best of a grid of centres."""
    from scipy.optimize import least_squares

    places = reach * np.arange(-7, 8) / 7  # exactly 0, as rounding errors would make the first step tiny
    starts = [np.array([along, across, 0.0]) for along in places for across in places]
    start = min(starts, key=lambda theta: float((residuals(theta) ** 2).sum()))
    bounds = np.array([1.5 * reach, 1.5 * reach, 5 * DRIFT])
    return least_squares(residuals, start, bounds=(-bounds, bounds), x_scale=[0.1, 0.1, DRIFT]).x
