"""The weighted detector, which uses log-odds of an atom, corrected for the light of its neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from labseq.detection.sites import (
    KnownSites,
    PositiveLength,
    SiteSettings,
    Thresholds,
    checked_image,
)
from labseq.detection.spots import spot_light
from labseq.detection.threshold import ComparingDetector
from labseq.model import Frame
from labseq.roles import Context
from labseq.settings import Fraction

Floats = NDArray[np.float64]


class WeightedSettings(SiteSettings):
    """The likelihood of an atom from spot-shaped weights, corrected for the neighbours' light.

    It makes fewer errors than `threshold`, but needs more properties of the camera. The defaults fit the
    virtual lab.
    """

    region: PositiveInt = Field(
        default=9,
        description="width of the square of pixels that is weighed around each site, an odd number, at least "
        "six times the width of the spot",
    )
    spot: PositiveLength = Field(
        default=0.42e-6, description="width (1 sigma of a Gaussian) of an atom's image in the atom plane"
    )
    photoelectrons: Annotated[float, Field(gt=0, le=5000)] = Field(
        default=60.0, description="mean photoelectrons of an atom in an exposure"
    )
    background: Annotated[float, Field(ge=1e-4, le=1000)] = Field(
        default=0.375,
        description="mean photoelectrons of a pixel without atoms (stray light, dark current, clock-induced "
        "charge)",
    )
    filling: Fraction = Field(
        default=0.75,
        description="fraction of the sites that hold atoms, which sets the expected light of neighbours",
    )
    offset: float = Field(default=500.0, description="counts of a dark pixel")
    counts_per_photoelectron: PositiveFloat = Field(
        default=60.0,
        description="mean counts of one photoelectron, which are the EM gain over the electrons per count",
    )
    read_noise: NonNegativeFloat = Field(
        default=16.0, description="read noise in counts r.m.s., to which rounding to whole counts is added"
    )
    em_register: bool = Field(
        default=True,
        description="whether photoelectrons are multiplied with the excess noise of an EM register (true for "
        "an EMCCD with a high gain, false for a CMOS camera or a gain that is off)",
    )
    threshold: Thresholds = Field(
        default=0.0,
        description="log-odds above which there is an atom, unless a calibration of thresholds is in use "
        "(lower misses fewer atoms and imagines more); one number, rows of numbers (one per site), or the "
        "path of a .npy file with one per site",
    )
    width: PositiveFloat = Field(
        default=2.0,
        description="distance of the log-odds from the threshold at which the confidence reaches 0.76; "
        "with 2 the confidence follows the likelihood",
    )


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Values computed once for a detector.

    Attributes:
        pixels: float32 (n_sites, region, region), weight of each pixel.
        curve: float32 (65536,), value of counts in photoelectrons.
        constant: float64 (n_sites,), log-odds of a site whose pixels are at the offset
            and whose neighbours have their mean light.
        starts: int64 (n_sites + 1,), where a site's neighbours start in the lists.
        neighbours: int64 (n,), sites whose light reaches it.
        effects: float64 (n,), log-odds added by an atom on the neighbour.
        expected: float64 (n_sites,), mean log-odds added by its neighbours.
    """

    pixels: NDArray[np.float32]
    curve: NDArray[np.float32]
    constant: Floats
    starts: NDArray[np.int64]
    neighbours: NDArray[np.int64]
    effects: Floats
    expected: Floats


class WeightedDetector(ComparingDetector):
    """Adds up the log-odds of an atom, pixel by pixel, and compares with a threshold.

    Among all detectors with the same rate of false positives, the likelihood ratio misses the fewest atoms
    (Neyman and Pearson, Phil. Trans. R. Soc. A 231, 289, 1933). A curve converts the counts of a pixel. It is
    linear for a few photoelectrons and flatter for many, because the EM register makes large counts less
    informative. The weight of each pixel of a site is the difference of the log-likelihoods of the pixel's
    light with and without the site's atom, at the site's true position between the pixels (see
    :func:`labseq.detection.weighted.evidence`).

    Both cases contain the mean light of the neighbours, so a pixel in their light weighs less. A second pass
    subtracts the mean effect of each neighbour found in the first, as in the detection of many senders on one
    channel (Verdu, Multiuser Detection, 1998, chapter 7). Neighbours are all sites within the reach of spot
    and region, on any lattice.

    The confidence is ``tanh(|log-odds - T_ij| / width)``. At T = 0 and a width of 2 it is the probability of
    being right, scaled to 0..1, if half of the sites hold atoms.

    Args:
        settings: A threshold given as text is the path of a .npy file of floats (n_rows, n_cols).
        context: Grid, calibrations and name.

    Raises:
        LimitError: A region extends over the edge of the frame, or the thresholds do
            not have one value per site.
        ConfigError: A file cannot be read, or the calibrated thresholds are not log-odds.
    """

    signal_unit = "log-odds"

    def __init__(self, settings: WeightedSettings, context: Context) -> None:
        super().__init__(settings, settings.threshold, settings.width, context)
        self._settings, self._grid = settings, context.grid
        self._weights: Weights | None = None
        self._kernels: Any = None

    def warm(self) -> None:
        """Compute the weights, and compile the kernels or load them from the cache."""
        self._ready()

    def signals(self, frame: Frame) -> Floats:
        """Log-odds of an atom against none, float64 (n_rows, n_cols).

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = checked_image(frame, self._known, self._name)
        weights = self._ready()
        odds = np.empty(len(self._corners))
        self._kernels.weigh_sites(image, self._corners, weights.pixels, weights.curve, weights.constant, odds)
        if len(weights.neighbours):
            first, odds = odds, np.empty_like(odds)
            self._kernels.undo_neighbours(weights.starts, weights.neighbours, weights.effects, first, odds)
            odds += weights.expected
        return odds.reshape(self._grid.shape)

    def _ready(self) -> Weights:
        if self._weights is None:
            from labseq.detection import kernels  # compiled only where this detector is used

            self._kernels = kernels
            self._weights = site_weights(self._settings, self._known, self._corners)
        return self._weights


def site_weights(settings: WeightedSettings, known: KnownSites, corners: NDArray[np.int64]) -> Weights:
    """Compute the weights of all sites, whose regions have their first pixels at ``corners`` (n_sites, 2)."""
    sites = known.positions_px.reshape(-1, 2)
    spot_px, region, filling = settings.spot / settings.pixel_size, settings.region, settings.filling
    own_light = settings.photoelectrons * spot_light(sites, corners, region, spot_px)
    # light further than 4 widths from a spot does not count
    pairs = pairs_within(sites, (region / 2 + 4.0 * spot_px) * np.sqrt(2))
    neighbour_light = settings.photoelectrons * spot_light(
        sites[pairs[:, 1]], corners[pairs[:, 0]], region, spot_px
    )
    dark = np.full_like(own_light, settings.background)
    np.add.at(dark, pairs[:, 0], filling * neighbour_light)
    likelihood = evidence(
        settings, settings.background, float((dark + own_light).max() + neighbour_light.max(initial=0.0))
    )

    def gained(values: Floats, before: Floats, light: Floats) -> Floats:
        return np.interp(before + light, likelihood.light, values) - np.interp(
            before, likelihood.light, values
        )

    pixels = gained(likelihood.weight, dark, own_light)
    effects = np.zeros(len(pairs))
    without = dark[pairs[:, 0]] - filling * neighbour_light
    for before in (without, without + own_light[pairs[:, 0]]):  # without and with an atom on the site
        effects += (pixels[pairs[:, 0]] * gained(likelihood.mean, before, neighbour_light)).sum(
            axis=(1, 2)
        ) / 2
    is_relevant = effects > 1e-3
    pairs, effects = pairs[is_relevant], effects[is_relevant]
    return Weights(
        pixels=pixels.astype(np.float32),
        curve=likelihood.curve,
        constant=gained(likelihood.constant, dark, own_light).sum(axis=(1, 2)),
        starts=np.searchsorted(pairs[:, 0], np.arange(len(sites) + 1)),
        neighbours=np.ascontiguousarray(pairs[:, 1]),
        effects=effects,
        expected=np.asarray(filling * np.bincount(pairs[:, 0], effects, len(sites)), np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class LightLikelihood:
    """The log-likelihood of counts x under light lam, as ``weight(lam) * curve(x) + constant(lam)``.

    Terms that depend on x alone are left out.

    Attributes:
        light: float64 (n,), mean photoelectrons of a pixel, rising.
        weight: float64 (n,), at each light.
        constant: float64 (n,), at each light.
        mean: float64 (n,), mean of the curve at each light.
        curve: float32 (65536,), by counts. 0 at the offset, 1 higher for the counts of one photoelectron.
    """

    light: Floats
    weight: Floats
    constant: Floats
    mean: Floats
    curve: NDArray[np.float32]


def evidence(sensor: WeightedSettings, darkest: float, brightest: float) -> LightLikelihood:
    """Compute the log-likelihood of light between two limits, for all counts.

    The number of photoelectrons is Poisson, and read noise is Gaussian. With an EM register of high gain each
    is multiplied by an exponentially distributed gain, so that k of them follow a gamma distribution of order
    k (Basden, Haniff, Mackay, MNRAS 345, 985, 2003). The ratio of the likelihood to the likelihood of the
    darkest light is a function of light and counts. The best approximation of its logarithm by one product
    and a constant is the first term of its singular value decomposition, with counts weighted by how often
    they occur. Without EM register and read noise it is exact, with the product k log(light).

    Args:
        sensor: Settings of the detector. Its camera settings are used.
        darkest: Minimum mean photoelectrons of a pixel, more than 0.
        brightest: Maximum mean photoelectrons of a pixel.
    """
    light = np.concatenate([[darkest], darkest + np.geomspace(1e-3, 1.0, 64 - 1) * (brightest - darkest)])
    noise = np.hypot(sensor.read_noise, np.sqrt(1 / 12)) / sensor.counts_per_photoelectron  # rounding
    n_most = int(np.ceil(brightest + 8 * np.sqrt(brightest) + 10))
    signal = _signals(sensor.em_register, noise, n_most)
    log_p = _log_likelihoods(light, _log_responses(sensor.em_register, noise, n_most, signal))
    p = np.exp(log_p) * np.gradient(signal)
    p /= p.sum(axis=1, keepdims=True)
    frequency = p.mean(axis=0)
    ratio = log_p - log_p[0]
    constant = ratio @ frequency
    ratio -= constant[:, None]
    left_vectors, values, _ = np.linalg.svd(ratio * np.sqrt(frequency), full_matrices=False)
    weight = left_vectors[:, 0] * values[0]
    curve = weight @ ratio / (weight @ weight)
    at_zero, at_one = np.interp([0.0, 1.0], signal, curve)
    constant += weight * at_zero
    curve, weight = (curve - at_zero) / (at_one - at_zero), weight * (at_one - at_zero)
    counts = (np.arange(65_536) - sensor.offset) / sensor.counts_per_photoelectron
    table = np.interp(counts, signal, curve).astype(np.float32)
    return LightLikelihood(light, weight, constant, p @ curve, table)


def _signals(em_register: bool, noise: float, n_most: int) -> Floats:
    """Signals in photoelectrons, finely spaced where read noise matters, up to the largest that occurs."""
    low = 5 * noise
    if em_register:
        high = n_most + 6 * np.sqrt(2 * n_most) + low
        return np.concatenate([np.linspace(-low, low, 61), np.geomspace(low, high, 120)[1:]])
    n = int(np.clip((n_most + 2 * low) / noise * 4, 200, 1500))
    return np.linspace(-low, n_most + low, n)


def _log_responses(em_register: bool, noise: float, n_most: int, signal: Floats) -> Floats:
    """Log density of each signal if there were k photoelectrons, (n_most + 1, n_signals)."""
    k = np.arange(n_most + 1.0)
    if not em_register:
        return _log_normal(signal - k[:, None], noise)
    nodes, parts = np.polynomial.legendre.leggauss(48 * max(1, int(np.ceil(noise))))
    low = np.maximum(signal - 6 * noise, 0.0)
    half = (signal + 6 * noise - low) / 2
    before = low + half * (1 + nodes[:, None])  # signal before the read noise, (n_nodes, n_signals)
    kernel = _log_normal(signal - before, noise) + np.log(parts[:, None] * half) - before
    log_before = np.log(before)
    log_p = np.empty((n_most + 1, len(signal)))
    log_p[0] = _log_normal(signal, noise)
    log_factorial = 0.0
    for order in range(1, n_most + 1):
        log_p[order] = _log_sum(kernel + (order - 1) * log_before, axis=0) - log_factorial
        log_factorial += np.log(order)
    return log_p


def _log_likelihoods(light: Floats, log_responses: Floats) -> Floats:
    """Log density of each signal at each light, (n_lights, n_signals)."""
    k = np.arange(len(log_responses))
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(k[1:]))])
    log_poisson = k * np.log(light[:, None]) - light[:, None] - log_factorial
    return np.stack([_log_sum(row[:, None] + log_responses, axis=0) for row in log_poisson])


def _log_normal(distance: Floats, width: float) -> Floats:
    return -0.5 * (distance / width) ** 2 - np.log(width * np.sqrt(2 * np.pi))


def _log_sum(log_terms: Floats, axis: int) -> Floats:
    highest = log_terms.max(axis=axis)
    return highest + np.log(np.exp(log_terms - highest).sum(axis=axis))


def pairs_within(positions: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Ordered pairs of different points within a distance, int64 (n_pairs, 2), sorted by the first.

    Args:
        positions: float64 (n, 2).
        distance: The distance, in the same unit.

    Example:
        >>> import numpy as np
        >>> pairs_within(np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 3.0]]), 1.5).tolist()
        [[0, 1], [1, 0]]
    """
    from scipy.spatial import KDTree

    pairs = KDTree(positions).query_pairs(distance, output_type="ndarray").astype(np.int64)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return both[np.lexsort((both[:, 1], both[:, 0]))]
