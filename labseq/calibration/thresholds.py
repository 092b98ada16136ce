"""Calibration of the detector's thresholds, from the two peaks of each site's signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.calibration.method import AnalysisResult, CalibrationData
from labseq.calibration.pictures import draw_thresholds
from labseq.errors import ConfigError, DeviceError, LimitError, Problem
from labseq.roles import ReportsSignals

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

N_BINS: Final = 1000
OUTER: Final = 0.5
"""Signals beyond this distance on the outer side of a peak are only counted. In widths of the peak."""
FLATTEST: Final = 1e-5
"""Skewness below which a peak is treated as a Gaussian."""
MIN_FRAMES: Final = 30


@dataclass(frozen=True, slots=True)
class Peak:
    """Pearson type III distribution, a shifted and scaled gamma distribution, mirrored for negative skewness.

    The counts of k photoelectrons after an EM register follow a gamma distribution. For a Poisson number of
    photoelectrons, the counts have its skewness and, within an eighth, its excess kurtosis.
    ``scipy.stats.pearson3`` is ten times slower and less exact for small skewness.

    Attributes:
        mean: Mean.
        width: Standard deviation.
        skewness: Third standardized moment.
    """

    mean: float
    width: float
    skewness: float

    def log_density(self, at: Floats) -> Floats:
        """Logarithm of the density, or -700 where the density is 0."""
        from scipy.special import gammaln

        z = (at - self.mean) / self.width
        if abs(self.skewness) < FLATTEST:
            return -0.5 * z**2 - np.log(self.width * np.sqrt(2 * np.pi))
        order = 4 / self.skewness**2
        # distance from the mean, in units of the gamma distribution's mean
        part = z * np.sign(self.skewness) / np.sqrt(order)
        inside = np.maximum(part, -1 + 1e-12)
        norm = (order - 0.5) * np.log(order) - order - gammaln(order)
        if order > 1e4:
            norm = -0.5 * np.log(2 * np.pi) - 1 / (12 * order)  # Stirling, because the line above cancels
        log_p = order * (np.log1p(inside) - inside) - np.log1p(inside) + norm - np.log(self.width)
        return np.where(part > -1, np.maximum(log_p, -700.0), -700.0)

    def below(self, at: Floats) -> Floats:
        """Probability of a smaller signal."""
        from scipy.special import gammainc, gammaincc, ndtr

        z = (at - self.mean) / self.width
        if abs(self.skewness) < FLATTEST:
            return ndtr(z)
        order = 4 / self.skewness**2
        rising = np.maximum(order + z * np.sqrt(order) * np.sign(self.skewness), 0.0)
        return gammainc(order, rising) if self.skewness > 0 else gammaincc(order, rising)

    def above(self, at: Floats) -> Floats:
        """Probability of a larger signal."""
        return Peak(-self.mean, self.width, -self.skewness).below(-at)

    def widened(self, factor: float) -> Peak:
        """A copy of the peak with another width."""
        return Peak(self.mean, self.width * factor, self.skewness)


@dataclass(frozen=True, slots=True)
class Shapes:
    """The distribution of signals scaled to 0 at a site's lower peak and 1 at its upper peak.

    Attributes:
        empty: The lower peak.
        full: The upper peak.
        between: Fraction of signals spread evenly between the peaks, from atoms lost during the exposure.
    """

    empty: Peak
    full: Peak
    between: float


def fit_shapes(signals: Floats, loading: float, width_empty: float, width_full: float) -> Shapes:
    """Fit two peaks and a constant between them by maximum likelihood.

    Atoms lost during the exposure fluoresce for a part of it. The constant describes them, because otherwise
    they would lengthen the tails of the peaks. On the outer side of each peak signals are only counted,
    because the errors depend on the inner sides.

    Args:
        signals: float64 (n,), scaled to 0 and 1 at the peaks.
        loading: Approximate fraction in the upper peak.
        width_empty: Approximate width of the lower peak.
        width_full: Approximate width of the upper peak.
    """
    from scipy.optimize import minimize

    low, high = -OUTER * width_empty, 1 + OUTER * width_full
    counts, edges = np.histogram(signals, N_BINS, (low, high))
    n_low, n_high = (float(np.count_nonzero(side)) for side in (signals < low, signals > high))
    occupied = counts > 0
    at, counts = ((edges[:-1] + edges[1:]) / 2)[occupied], counts[occupied].astype(np.float64)
    ends, floor = np.array([low, high]), ((at >= 0) & (at <= 1)).astype(np.float64)

    def unlikelihood(x: Floats) -> float:
        shapes, full = _shapes(x)
        log_empty, log_full = (peak.log_density(at) for peak in (shapes.empty, shapes.full))
        peaks = (1 - full) * np.exp(log_empty) + full * np.exp(log_full)
        density = (1 - shapes.between) * peaks + shapes.between * floor
        below = (1 - full) * shapes.empty.below(ends)[0] + 1e-12
        above = full * shapes.full.above(ends)[1] + 1e-12
        outer = n_low * np.log((1 - shapes.between) * below) + n_high * np.log((1 - shapes.between) * above)
        # 1e-7, because a stray signal far from both peaks must not decide the fit
        return -float(counts @ np.log(density + 1e-7) + outer)

    full = np.clip(loading, 0.02, 0.98)
    start = np.array(
        [0.0, np.log(width_empty), 0.3, 1.0, np.log(width_full), 0.3, np.log(full / (1 - full)), -6.0]
    )
    # the minimiser expects steps of about 1 in each parameter
    unit = np.array([width_empty / 3, 0.1, 0.3, width_full / 3, 0.1, 0.3, 0.3, 1.0])
    bounds = _bounds(start) / unit[:, None]
    options = {"maxiter": 500, "ftol": 1e-13, "gtol": 1e-3}

    def in_units(x: Floats) -> float:
        return unlikelihood(x * unit)

    result = minimize(in_units, start / unit, method="L-BFGS-B", bounds=bounds, options=options)
    return _shapes(result.x * unit)[0]


def _bounds(start: Floats) -> Floats:
    log_width, log_full = ((x + np.log(0.4), x + np.log(2.5)) for x in start[[1, 4]])
    skewness = (-1.8, 1.8)
    empty, full = ((-0.3, 0.3), log_width, skewness), ((0.7, 1.3), log_full, skewness)
    return np.array([*empty, *full, (-6.0, 6.0), (-12.0, -2.0)])


def _shapes(x: Floats) -> tuple[Shapes, float]:
    """The shapes for parameters of the fit, and the fraction in the upper peak."""
    # any number is allowed, because widths are given as logarithms and fractions as log-odds
    empty = Peak(float(x[0]), float(np.exp(x[1])), float(x[2]))
    full = Peak(float(x[3]), float(np.exp(x[4])), float(x[5]))
    return Shapes(empty, full, float(1 / (1 + np.exp(-x[7])))), float(1 / (1 + np.exp(-x[6])))


@dataclass(frozen=True, slots=True, eq=False)
class FittedThresholds:
    """Thresholds of the sites, and their expected errors.

    Attributes:
        thresholds: float64 (n_rows, n_cols), in the unit of the signals.
        false_negative: float64 (n_rows, n_cols), probability that an atom is missed.
        false_positive: float64 (n_rows, n_cols), probability that an empty site is taken for full.
        loading: float64 (n_rows, n_cols), fraction of the frames above the threshold.
        never_loaded: bool (n_rows, n_cols), sites with only the lower peak. Their upper peak is assumed as
            far from it as for their neighbours.
        always_loaded: bool (n_rows, n_cols), sites with only the upper peak. Their lower peak is taken from
            their neighbours.
        lost: Fraction of the signals between the peaks, from atoms lost during the exposure.
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
        """Mean of both error probabilities over all sites."""
        return float((self.false_negative.mean() + self.false_positive.mean()) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _SitePeaks:
    """Positions, widths and numbers of signals of each site's two peaks, float64 (n_sites,).

    ``two`` is true for the sites that show both peaks, bool (n_sites,).
    """

    empty: Floats
    full: Floats
    width_empty: Floats
    width_full: Floats
    n_empty: Floats
    n_full: Floats
    two: Bools


def fit_thresholds(signals: Floats, miss_cost: float = 3.0) -> FittedThresholds:
    """Fit the two peaks of each site and choose the threshold with the lowest cost of errors.

    All sites share the shape of the peaks, because errors come from tails that a site shows once in thousands
    of frames. Each site has its own positions and widths, shrunk towards the mean of all sites as far as
    chance explains (James and Stein, Proc. 4th Berkeley Symp. 1, 361, 1961).

    Args:
        signals: float64 (n_frames, n_rows, n_cols), the detector's signals, from
            frames of randomly loaded atoms.
        miss_cost: Cost of a missed atom, relative to a false detection. A second atom is moved onto a missed
            atom and both are lost, but a false detection only leaves a site empty.

    Raises:
        LimitError: There are fewer than 30 frames, or the cost is not above 0.
        DeviceError: A signal is not finite, or too many sites show only one peak. Too many are all sites, or
            more than 20 % and more than one.
    """
    n_frames, *shape = signals.shape
    if n_frames < MIN_FRAMES:
        raise LimitError("the number of frames for thresholds", n_frames, f"{MIN_FRAMES} or more")
    if not 0 < miss_cost < np.inf:
        raise LimitError("the cost of a missed atom", miss_cost, "more than 0 false detections")
    by_site = np.ascontiguousarray(signals.reshape(n_frames, -1).T, np.float64)
    if not np.isfinite(by_site).all():
        raise DeviceError("detector", "some of the signals are not finite numbers; no thresholds fitted")
    peaks = _site_peaks(by_site)
    _check_enough(peaks.two, by_site)
    places, never, always = _with_single_peaks(peaks, by_site, (shape[0], shape[1]))
    shapes = _common_shapes(by_site[peaks.two], places, peaks.two)
    steps, widths_empty, widths_full = places.full - places.empty, places.width_empty, places.width_full
    ratio_empty, ratio_full = (
        w / steps / np.median((w / steps)[peaks.two]) for w in (widths_empty, widths_full)
    )
    at, missed, imagined = _cheapest(shapes, ratio_empty, ratio_full, miss_cost)
    thresholds = places.empty + at * steps
    loading = (by_site > thresholds[:, None]).mean(axis=1)
    return FittedThresholds(
        *(values.reshape(shape) for values in (thresholds, missed, imagined, loading)),
        never_loaded=never.reshape(shape),
        always_loaded=always.reshape(shape),
        lost=shapes.between,
    )


def _site_peaks(by_site: Floats) -> _SitePeaks:
    """Divide each site's signals in two, iteratively, midway between the medians of both parts."""
    low, high = np.quantile(by_site, [0.02, 0.98], axis=1)
    cut = (low + high) / 2
    for _ in range(12):
        empty = _middle(by_site, by_site <= cut[:, None])
        full = _middle(by_site, by_site > cut[:, None])
        cut = np.where(np.isfinite(empty + full), (empty + full) / 2, cut)
    parts = [_moments(by_site, part) for part in (by_site <= cut[:, None], by_site > cut[:, None])]
    (empty, width_empty, n_empty), (full, width_full, n_full) = parts
    apart = (full - empty) / np.maximum(np.hypot(width_empty, width_full), 1e-300)
    few = np.minimum(n_empty, n_full) < 5
    two = np.isfinite(apart) & (apart > 3.0) & ~few  # a single peak cut in two has 2.0
    if two.any():  # peaks much closer than usual are not from an empty and a full site
        two &= full - empty > 0.4 * np.median((full - empty)[two])
    return _SitePeaks(empty, full, width_empty, width_full, n_empty, n_full, two)


def _middle(by_site: Floats, part: Bools) -> Floats:
    counts = part.sum(axis=1)
    ordered = np.sort(np.where(part, by_site, np.inf), axis=1)
    middle = np.take_along_axis(ordered, np.maximum(counts // 2, 0)[:, None], axis=1)[:, 0]
    return np.where(counts > 0, middle, np.nan)


def _moments(by_site: Floats, part: Bools) -> tuple[Floats, Floats, Floats]:
    """Mean and standard deviation without outliers, and the number of signals."""
    middle = _middle(by_site, part)
    off = np.abs(by_site - middle[:, None])
    # 1.4826: a Gaussian's standard deviation in median absolute deviations
    near = part & (off < 4 * 1.4826 * _middle(off, part)[:, None] + 1e-12)
    n = near.sum(axis=1).astype(np.float64)
    count = np.maximum(n, 1)
    mean = np.where(near, by_site, 0.0).sum(axis=1) / count
    spread = np.where(near, (by_site - mean[:, None]) ** 2, 0.0).sum(axis=1)
    return np.where(n > 0, mean, np.nan), np.sqrt(spread / np.maximum(count - 1, 1)), n


def _check_enough(two: Bools, by_site: Floats) -> None:
    n_one = int((~two).sum())
    # one site of a small array may always be broken, and one in five of a large array
    if n_one > max(1.0, 0.2 * len(two)) or not two.any():
        remedy = "check the loading, the light, and that the sites are where the atoms are"
        if np.ptp(by_site) == 0:
            remedy = "all signals are equal, so the frames may be black or saturated"
        raise DeviceError(
            "detector",
            f"{n_one} of {len(two)} sites show only one peak in the histogram of the counts; {remedy}",
        )


def _with_single_peaks(
    peaks: _SitePeaks, by_site: Floats, shape: tuple[int, int]
) -> tuple[_SitePeaks, Bools, Bools]:
    """Shrink the peaks towards the mean of all. A site with one peak gets the other from its neighbours."""
    two = peaks.two
    error_empty, error_full = (
        width / np.sqrt(np.maximum(n, 1))
        for width, n in ((peaks.width_empty, peaks.n_empty), (peaks.width_full, peaks.n_full))
    )
    empty, full = _shrunk(peaks.empty, error_empty, two), _shrunk(peaks.full, error_full, two)
    # the standard error of a width is 0.71 times that of the mean for a Gaussian, more for a skewed peak
    width_empty = _shrunk(peaks.width_empty, 0.85 * error_empty, two)
    width_full = _shrunk(peaks.width_full, 0.85 * error_full, two)
    near_empty, near_full = (_of_neighbours(values, two, shape) for values in (empty, full))
    middle = np.median(by_site, axis=1)
    always = ~two & (np.abs(middle - near_full) < np.abs(middle - near_empty))
    never = ~two & ~always
    empty = np.where(never, middle, np.where(always, near_empty, empty))
    full = np.where(never, middle + near_full - near_empty, np.where(always, middle, full))
    return _SitePeaks(empty, full, width_empty, width_full, peaks.n_empty, peaks.n_full, two), never, always


def _of_neighbours(values: Floats, known: Bools, shape: tuple[int, int]) -> Floats:
    """The median of the eight nearest sites with known values, for each site."""
    from scipy.spatial import KDTree

    site = np.stack(np.unravel_index(np.arange(len(values)), shape), axis=1)
    n = min(8, int(known.sum()))
    _, nearest = KDTree(site[known]).query(site, k=n)
    return np.median(values[known][np.asarray(nearest).reshape(-1, n)], axis=1)


def _shrunk(values: Floats, chance: Floats, known: Bools) -> Floats:
    """Shrink values towards their median as far as chance explains, by 1.5 standard errors at most."""
    mean = float(np.median(values[known]))
    spread = 1.4826 * float(np.median(np.abs(values[known] - mean)))
    real = max(0.0, spread**2 - float(np.median(chance[known] ** 2)))
    shrunk = mean + (values - mean) * real / np.maximum(real + chance**2, 1e-300)
    return np.where(known, np.clip(shrunk, values - 1.5 * chance, values + 1.5 * chance), mean)


def _common_shapes(by_site: Floats, places: _SitePeaks, two: Bools) -> Shapes:
    empty, step = places.empty[two], (places.full - places.empty)[two]
    signals = ((by_site - empty[:, None]) / step[:, None]).ravel()
    widths = [float(np.median(width[two] / step)) for width in (places.width_empty, places.width_full)]
    return fit_shapes(signals, float((signals > 0.5).mean()), widths[0], widths[1])


def _cheapest(
    shapes: Shapes, ratio_empty: Floats, ratio_full: Floats, miss_cost: float
) -> tuple[Floats, Floats, Floats]:
    """Threshold of each site between 0 and 1, and probabilities of a missed atom and a false detection."""
    at = np.linspace(0.02, 0.98, 1921)
    # widths in steps of 2.5 %, so that sites of nearly the same width share a curve
    steps = np.exp(np.linspace(np.log(0.5), np.log(2.0), 57))
    imagined = np.stack([shapes.empty.widened(step).above(at) for step in steps])
    missed = np.stack([shapes.full.widened(step).below(at) for step in steps])
    rows = list[tuple[float, float, float]]()
    places = np.arange(len(steps))
    for ratio_of_empty, ratio_of_full in zip(ratio_empty, ratio_full, strict=True):
        i, j = (
            int(np.rint(np.interp(np.log(r), np.log(steps), places))) for r in (ratio_of_empty, ratio_of_full)
        )
        best = int(np.argmin(imagined[i] + miss_cost * missed[j]))
        rows.append((float(at[best]), float(missed[j, best]), float(imagined[i, best])))
    at_best, missed_best, imagined_best = np.array(rows).T
    return at_best, missed_best, imagined_best


ENOUGH_SIGNALS: Final = 4000
"""Number of signals of all sites below which thresholds may cost more than 1.3 times the best."""


def analyse_thresholds(data: CalibrationData) -> AnalysisResult:
    """Find the thresholds from the signals that the profile's detector computes from the run's frames.

    Raises:
        DeviceError: The frames have another size than for the sites, or too many sites show only one peak.
        LimitError: There are too few frames.
        ConfigError: The detector does not report its signals, or the run has no frames.
    """
    detector, choice = data.detector(), data.hardware.chosen["detector"]
    if not isinstance(detector, ReportsSignals):
        problem = f"the detector '{choice.entry.name}' does not report the signals that it compares"
        raise ConfigError(Problem(problem, expected="'threshold', 'weighted', or another such detector"))
    signals = np.stack([detector.signals(frame) for frame in data.frames()])
    fitted, unit = fit_thresholds(signals), detector.signal_unit
    quality = {
        "error": fitted.error,
        "false_negative": float(fitted.false_negative.mean()),
        "false_positive": float(fitted.false_positive.mean()),
        "loading": float(fitted.loading.mean()),
        "n_one_peak": float(_n_not_by_chance(fitted, len(signals))),
    }
    return AnalysisResult(
        {"thresholds": fitted.thresholds},
        quality,
        _summary_lines(fitted, len(signals), unit),
        {"unit": unit, "detector": choice.dump()},
        lambda: draw_thresholds(signals, fitted.thresholds, unit),
    )


def _n_not_by_chance(fitted: FittedThresholds, n_frames: int) -> int:
    """Number of sites with one peak whose loading differs from the usual by more than chance explains."""
    from scipy.special import bdtr, bdtrc  # importing scipy.stats would take a second

    n_full, usual = np.rint(fitted.loading * n_frames), float(np.median(fitted.loading))
    chance = np.minimum(bdtr(n_full, n_frames, usual), bdtrc(n_full - 1, n_frames, usual))
    one_peak = fitted.never_loaded | fitted.always_loaded
    # in one array of a thousand, this counts a site that is never or always loaded by chance
    return int(np.count_nonzero(one_peak & (chance < 1e-3 / one_peak.size)))


def _summary_lines(fitted: FittedThresholds, n_frames: int, unit: str) -> tuple[str, ...]:
    low, high = fitted.thresholds.min(), fitted.thresholds.max()
    missed, imagined = fitted.false_negative.mean(), fitted.false_positive.mean()
    loading = f"{100 * fitted.loading.mean():.1f} % of the sites hold atoms"
    lines = [
        f"thresholds from {low:.4g} to {high:.4g} {unit}, from {n_frames} frames; {loading}",
        f"expected: {missed:.1e} of the atoms missed, {imagined:.1e} of the empty sites taken for full",
    ]
    if n_frames * fitted.loading.size < ENOUGH_SIGNALS:
        n_shots = -(-ENOUGH_SIGNALS // fitted.loading.size)
        text = "with few signals, thresholds and expected errors may be far off; take"
        lines.append(f"warning: {text} --shots {n_shots}")
    for sites, word in ((fitted.never_loaded, "never"), (fitted.always_loaded, "always")):
        if sites.any():
            lines.append(
                f"warning: {_named(sites)} {word} loaded, so the missing peak is taken from the neighbours"
            )
    return tuple(lines)


def _named(sites: NDArray[np.bool_]) -> str:
    places = [f"({row}, {col})" for row, col in np.argwhere(sites)]
    if len(places) > 8:
        return f"{len(places)} sites were"
    return f"site {places[0]} was" if len(places) == 1 else f"sites {', '.join(places)} were"
