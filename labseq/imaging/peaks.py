"""Thresholds from the two peaks of each site's signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError, LimitError
from labseq.imaging.peak_shapes import Shapes, fit_shapes

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MIN_FRAMES: Final = 30
MIN_IN_PEAK: Final = 5
APART: Final = 3.0
"""Least distance of two peaks, in their joint widths; a single peak cut in two has 2."""

FAINT: Final = 0.4
"""Least distance of a site's peaks, of the usual."""

MAX_ONE_PEAK: Final = 0.2
"""Most sites with one peak, of all."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedThresholds:
    """Thresholds of the sites, and what is expected of them.

    Attributes:
        thresholds: float64 (n_rows, n_cols), in the unit of the signals.
        false_negative: float64 (n_rows, n_cols), probability that an atom is missed.
        false_positive: float64 (n_rows, n_cols), probability that an empty site is taken for full.
        loading: float64 (n_rows, n_cols), fraction of the frames above the threshold.
        never_loaded: bool (n_rows, n_cols), sites with the lower peak alone; their threshold has
            the usual distance from it.
        always_loaded: bool (n_rows, n_cols), sites with the upper peak alone; theirs stands
            between the usual lower peak and their upper.
        lost: Fraction of the signals between the peaks: atoms lost during the exposure.
    """

    thresholds: Floats
    false_negative: Floats
    false_positive: Floats
    loading: Floats
    never_loaded: Bools
    always_loaded: Bools
    lost: float

    @property
    def error(self) -> float:
        """Mean of both kinds of errors and of all sites."""
        return float((self.false_negative.mean() + self.false_positive.mean()) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _SitePeaks:
    """Where the peaks of each site are; float64 (n_sites,) but for ``two``."""

    empty: Floats
    full: Floats
    width_empty: Floats
    width_full: Floats
    n_empty: Floats
    n_full: Floats
    two: Bools


def fit_thresholds(signals: Floats, miss_cost: float = 3.0, detector: str = "detector") -> FittedThresholds:
    """Fit the two peaks of each site and put the threshold where errors cost least.

    All sites share the shape of the peaks, for the errors are in tails that a site
    shows once in thousands of frames. Places and widths are each site's own, drawn
    towards those of all by as much as chance explains (James and Stein, Proc. 4th
    Berkeley Symp. 1, 361, 1961).

    Args:
        signals: float64 (n_frames, n_rows, n_cols), what the detector compares, from
            frames of randomly loaded atoms.
        miss_cost: What a missed atom costs, in imagined ones. A second atom is sent onto a
            missed one and both are lost, which leaves a site empty; an imagined atom
            leaves one empty.
        detector: Its name, for messages.

    Raises:
        LimitError: Fewer than 30 frames, or a cost that is not above 0.
        DeviceError: More than 20 % of the sites show one peak only.
    """
    n_frames, *shape = signals.shape
    if n_frames < MIN_FRAMES:
        raise LimitError("the number of frames for thresholds", n_frames, f"{MIN_FRAMES} or more")
    if not 0 < miss_cost < np.inf:
        raise LimitError("the cost of a missed atom", miss_cost, "more than 0 imagined ones")
    by_site = np.ascontiguousarray(signals.reshape(n_frames, -1).T, np.float64)
    if not np.isfinite(by_site).all():
        raise DeviceError(detector, "some of the signals are not finite numbers; no thresholds fitted")
    peaks = _site_peaks(by_site)
    _check_enough(peaks.two, by_site, detector)
    places, never, always = _with_single_peaks(peaks, by_site)
    shapes = _common_shapes(by_site[peaks.two], places, peaks.two)
    steps, widths_empty, widths_full = places.full - places.empty, places.width_empty, places.width_full
    ratio_empty, ratio_full = (
        w / steps / np.median((w / steps)[peaks.two]) for w in (widths_empty, widths_full)
    )
    at, missed, imagined = _cheapest(shapes, ratio_empty, ratio_full, miss_cost)
    thresholds = places.empty + at * steps
    return FittedThresholds(
        thresholds.reshape(shape),
        missed.reshape(shape),
        imagined.reshape(shape),
        (by_site > thresholds[:, None]).mean(axis=1).reshape(shape),
        never.reshape(shape),
        always.reshape(shape),
        shapes.between,
    )


def _site_peaks(by_site: Floats) -> _SitePeaks:
    """Cut each site's signals in two, again and again in the middle of the two parts' middles."""
    low, high = np.quantile(by_site, [0.02, 0.98], axis=1)
    cut = (low + high) / 2
    for _ in range(12):
        empty = _middle(by_site, by_site <= cut[:, None])
        full = _middle(by_site, by_site > cut[:, None])
        cut = np.where(np.isfinite(empty + full), (empty + full) / 2, cut)
    parts = [_described(by_site, part) for part in (by_site <= cut[:, None], by_site > cut[:, None])]
    (empty, width_empty, n_empty), (full, width_full, n_full) = parts
    apart = (full - empty) / np.maximum(np.hypot(width_empty, width_full), 1e-300)
    few = np.minimum(n_empty, n_full) < max(MIN_IN_PEAK, 0.02 * by_site.shape[1])
    two = np.isfinite(apart) & (apart > APART) & ~few
    if two.any():
        two &= full - empty > FAINT * np.median((full - empty)[two])
    return _SitePeaks(empty, full, width_empty, width_full, n_empty, n_full, two)


def _middle(by_site: Floats, part: Bools) -> Floats:
    counts = part.sum(axis=1)
    ordered = np.sort(np.where(part, by_site, np.inf), axis=1)
    middle = np.take_along_axis(ordered, np.maximum(counts // 2, 0)[:, None], axis=1)[:, 0]
    return np.where(counts > 0, middle, np.nan)


def _described(by_site: Floats, part: Bools) -> tuple[Floats, Floats, Floats]:
    """Mean and standard deviation without what is far off, and how many there are."""
    middle = _middle(by_site, part)
    off = np.abs(by_site - middle[:, None])
    near = part & (off < 4 * 1.4826 * _middle(off, part)[:, None] + 1e-12)
    n = near.sum(axis=1).astype(np.float64)
    count = np.maximum(n, 1)
    mean = np.where(near, by_site, 0.0).sum(axis=1) / count
    spread = np.where(near, (by_site - mean[:, None]) ** 2, 0.0).sum(axis=1)
    return np.where(n > 0, mean, np.nan), np.sqrt(spread / np.maximum(count - 1, 1)), n


def _check_enough(two: Bools, by_site: Floats, detector: str) -> None:
    n_one = int((~two).sum())
    if n_one > MAX_ONE_PEAK * len(two):
        spread = (
            "all signals are equal: black or saturated frames"
            if np.ptp(by_site) == 0
            else ("check the loading, the light, and that the sites are where the atoms are")
        )
        raise DeviceError(detector, f"{n_one} of {len(two)} sites show one peak, not two; {spread}")


def _with_single_peaks(peaks: _SitePeaks, by_site: Floats) -> tuple[_SitePeaks, Bools, Bools]:
    """Peaks drawn towards those of all; a site with one peak gets the other from all."""
    two = peaks.two
    empty = _drawn(peaks.empty, peaks.width_empty / np.sqrt(np.maximum(peaks.n_empty, 1)), two)
    full = _drawn(peaks.full, peaks.width_full / np.sqrt(np.maximum(peaks.n_full, 1)), two)
    width_empty = _drawn(
        peaks.width_empty, peaks.width_empty * 0.85 / np.sqrt(np.maximum(peaks.n_empty, 1)), two
    )
    width_full = _drawn(peaks.width_full, peaks.width_full * 0.85 / np.sqrt(np.maximum(peaks.n_full, 1)), two)
    usual_empty, usual_full = np.median(peaks.empty[two]), np.median(peaks.full[two])
    middle = np.median(by_site, axis=1)
    always = ~two & (np.abs(middle - usual_full) < np.abs(middle - usual_empty))
    never = ~two & ~always
    empty = np.where(never, middle, empty)
    full = np.where(never, middle + usual_full - usual_empty, np.where(always, middle, full))
    return _SitePeaks(empty, full, width_empty, width_full, peaks.n_empty, peaks.n_full, two), never, always


def _drawn(values: Floats, chance: Floats, known: Bools) -> Floats:
    """Values drawn towards their mean by as much as chance explains, at most by its standard deviation."""
    mean = float(np.median(values[known]))
    spread = 1.4826 * float(np.median(np.abs(values[known] - mean)))
    real = max(0.0, spread**2 - float(np.median(chance[known] ** 2)))
    drawn = mean + (values - mean) * real / np.maximum(real + chance**2, 1e-300)
    return np.where(known, np.clip(drawn, values - 1.5 * chance, values + 1.5 * chance), mean)


def _common_shapes(by_site: Floats, places: _SitePeaks, two: Bools) -> Shapes:
    empty, step = places.empty[two], (places.full - places.empty)[two]
    signals = ((by_site - empty[:, None]) / step[:, None]).ravel()
    widths = [float(np.median(width[two] / step)) for width in (places.width_empty, places.width_full)]
    return fit_shapes(signals, float((signals > 0.5).mean()), widths[0], widths[1])


def _cheapest(
    shapes: Shapes, ratio_empty: Floats, ratio_full: Floats, miss_cost: float
) -> tuple[Floats, Floats, Floats]:
    """Threshold of each site between 0 and 1, and both probabilities of error there."""
    at = np.linspace(0.02, 0.98, 1921)
    steps = np.exp(np.linspace(np.log(0.5), np.log(2.0), 57))
    imagined = np.stack([shapes.empty.widened(step).above(at) for step in steps])
    missed = np.stack([shapes.full.widened(step).below(at) for step in steps])
    found = list[tuple[float, float, float]]()
    places = np.arange(len(steps))
    for of_empty, of_full in zip(ratio_empty, ratio_full, strict=True):
        i, j = (int(np.rint(np.interp(np.log(r), np.log(steps), places))) for r in (of_empty, of_full))
        best = int(np.argmin(imagined[i] + miss_cost * missed[j]))
        found.append((float(at[best]), float(missed[j, best]), float(imagined[i, best])))
    at_best, missed_best, imagined_best = np.array(found).T
    return at_best, missed_best, imagined_best
