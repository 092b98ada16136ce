"""Where the mobile tweezers stand beside the sites, from the survival of pick-up, hold and drop.

A probe at a commanded offset puts a tweezer at that offset and the unknown one. So atoms survive
best at the *centre*, where both cancel: the mobile tweezers stand beside the sites by minus the
centre, which is what :func:`overlay_offset` tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.errors import DeviceError
from labseq.model import SiteGrid
from labseq.motion.survival import (
    REACH,
    SurvivalShape,
    covariance,
    deviance_residuals,
    dispersion,
    distance_m,
    unit_axes,
)
from labseq.units import format_quantity

Floats = NDArray[np.float64]

WORST_ERROR_M: Final = 50e-9
"""A centre that is known less well is no calibration."""
MIN_ATOMS: Final = 100
MIN_GAIN: Final = 30.0
"""By how much the deviance must fall, over the dispersion, for a bump to be believed."""
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
    """What a scan of the probe's offset found.

    Attributes:
        centre_m: float64 (2,), commanded offset at which survival is best, along a1 and a2.
        error_m: float64 (2,), its standard errors, the scatter of the counts included.
        shape: The bump around it.
        dispersion: Scatter of the counts over that of a binomial law, at least 1.
        n_atoms: Atoms that were probed.
    """

    centre_m: Floats
    error_m: Floats
    shape: SurvivalShape
    dispersion: float
    n_atoms: int


def overlay_offset(centre_m: ArrayLike, in_use_m: ArrayLike = (0.0, 0.0)) -> Floats:
    """How far the mobile tweezers stand beside the sites: the ``offset_m`` of an overlay calibration.

    Args:
        centre_m: float64 (2,), the commanded offset that puts them onto the sites.
        in_use_m: The ``offset_m`` that was already made up for when it was measured.

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
    """Find the centre of the bump of survival, by maximum likelihood of binomial counts.

    The bump is round and has a flat top and an edge; see :class:`SurvivalShape`. On the triangular
    lattice the axes are not at right angles: what is off along one moves the best place along the
    other, so both are fitted together.

    Args:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int (n_points, ...), atoms that were probed at each; per row or site, if you like.
        n_survived: int, of the same shape: how many of them were seen afterwards.
        grid: The grid of sites, for its axes.
        worst_error_m: Refuse a centre that is known less well.

    Raises:
        DeviceError: There is no bump, one of its edges is not in range (it says in which
            direction to scan on), or there are too few atoms.
        ValueError: The arrays do not belong together.
    """
    offset, n, k = checked_counts(offset_m, n_before, n_survived)
    n, k = n.reshape(len(n), -1).sum(axis=1), k.reshape(len(k), -1).sum(axis=1)
    if n.sum() < MIN_ATOMS:
        _refuse(f"only {int(n.sum())} atoms were probed; expected {MIN_ATOMS} at least: take more shots")
    for axis, direction in enumerate(DIRECTIONS):
        if len(np.unique(offset[:, axis].round(9))) < 5:
            _refuse(
                f"the offset {direction} has fewer than 5 values; scan it across the sites, to both sides"
            )
    fit = _best_fit(offset / UM, n, k, unit_axes(grid))
    _refuse_open_ends(fit, offset, unit_axes(grid))
    worst = float(fit.error_m.max())
    if worst > worst_error_m:
        more = math.ceil((worst / worst_error_m) ** 2)
        known, wanted = format_quantity(worst, "length"), format_quantity(worst_error_m, "length")
        _refuse(f"too few atoms: the centre is known to {known} only; for {wanted} take {more} times as many")
    return fit


def checked_counts(
    offset_m: ArrayLike, n_before: ArrayLike, n_survived: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Offsets and counts as float64.

    Raises:
        ValueError: They do not belong together.
    """
    offset, n, k = (np.asarray(values, np.float64) for values in (offset_m, n_before, n_survived))
    if offset.ndim != 2 or offset.shape[1] != 2 or n.shape != k.shape or n.shape[:1] != offset.shape[:1]:
        raise ValueError(f"offsets {offset.shape} and counts {n.shape}, {k.shape} do not belong together")
    if not (np.isfinite(offset).all() and np.isfinite(n).all() and np.all((k >= 0) & (k <= n))):
        raise ValueError("offsets are numbers, and no more atoms survive than there were")
    return offset, n, k


def _best_fit(offset: Floats, n: Floats, k: Floats, axes: Floats) -> OverlayFit:
    """Fit the bump to the points in its reach; offsets are in micrometres."""
    n_atoms, share = int(n.sum()), format_quantity(k.sum() / n.sum(), "fraction")
    theta, within = _start(offset, n, k, axes), np.empty(0, np.bool_)
    for _ in range(ROUNDS):
        before, within = within, distance_m(offset - theta[:2], axes) < REACH * theta[2]
        if np.array_equal(before, within) or np.count_nonzero(within) <= len(theta):
            break
        theta = _fitted(theta, offset[within], n[within], k[within], axes)
    offset, n, k = offset[within], n[within], k[within]
    even, p = np.full(len(n), k.sum() / max(1.0, n.sum())), _survival(theta, offset, axes)
    gain = sum(sign * float((deviance_residuals(k, n, q) ** 2).sum()) for sign, q in ((1, even), (-1, p)))
    excess = dispersion(k, n, p, len(theta))
    if gain < MIN_GAIN * excess or theta[5] - theta[4] < MIN_CONTRAST:
        _refuse(
            f"no bump: at no offset in range clearly more atoms survive than around it ({share} in all); "
            "scan further, and see whether the mobile tweezers are on"
        )
    spread = covariance(theta, n, lambda t: _survival(t, offset, axes), _KNOWN_BEFORE) * excess
    return OverlayFit(theta[:2] * UM, np.sqrt(np.diag(spread)[:2]) * UM, _shape(theta, UM), excess, n_atoms)


def _fitted(start: Floats, offset: Floats, n: Floats, k: Floats, axes: Floats) -> Floats:
    """The parameters of the greatest likelihood."""
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
    """Where the fit begins: the best of many bumps, with and without the far side of the ring of loss."""
    low, high = offset.min(axis=0), offset.max(axis=0)
    span = float((high - low).max())
    centres = np.stack(np.meshgrid(*np.linspace(low, high, 17).T), axis=-1).reshape(-1, 2)
    distance = distance_m(offset - centres[:, None], axes)
    share = np.divide(k, n, out=np.zeros_like(n), where=n > 0)
    surplus = n * (share - k.sum() / n.sum())
    best, start = -math.inf, np.zeros(0)
    for half_width in span * np.array([0.12, 0.2, 0.28, 0.36, 0.44]):
        for outer in half_width * np.array([1.5, 1.8, 2.2, math.inf]):
            bump = ((distance < half_width) | (distance > outer)).astype(np.float64)
            bump -= (bump @ n / n.sum())[:, None]
            gain = np.maximum(bump @ surplus, 0.0) ** 2 / np.maximum(bump**2 @ n, 1e-12)
            i = int(gain.argmax())
            if gain[i] > best:
                best = float(gain[i])
                start = np.r_[centres[i], half_width, half_width / 6, 0.05, 0.95]
    return start


def _refuse_open_ends(fit: OverlayFit, offset: Floats, axes: Floats) -> None:
    """Refuse a bump whose edges are not both in range, on the lines that were scanned."""
    cosine = float(axes[0] @ axes[1])
    middle = np.median(offset, axis=0)
    about = np.clip(fit.centre_m, offset.min(axis=0), offset.max(axis=0))
    for axis, direction in enumerate(DIRECTIONS):
        aside = middle[1 - axis] - fit.centre_m[1 - axis]
        squared = fit.shape.half_width_m**2 - aside**2 * (1 - cosine**2)
        where = " and ".join(
            f"{format_quantity(float(at), 'length')} {name}"
            for at, name in zip(about, DIRECTIONS, strict=True)
        )
        if squared <= 0:
            _refuse(f"the scan {direction} passes beside the bump; scan about {where}")
        best, half = fit.centre_m[axis] - aside * cosine, math.sqrt(squared)
        low, high = offset[:, axis].min(), offset[:, axis].max()
        if best - half < low or best + half > high:
            end, sign = (low, "-") if best - half < low else (high, "+")
            _refuse(
                f"only one edge of the bump is in range {direction}: survival has not fallen at "
                f"{format_quantity(float(end), 'length')}; scan on in the direction {sign}, or about {where}"
            )


def _refuse(why: str) -> NoReturn:
    raise DeviceError("mobile_tweezers", f"no overlay found: {why}")
