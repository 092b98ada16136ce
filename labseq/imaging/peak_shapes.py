"""The shape of the two peaks that the signals of all sites have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

N_BINS: Final = 1000
OUTER: Final = 0.5
"""Widths from the middle of a peak, on its outer side, beyond which signals are only counted."""

FLATTEST: Final = 1e-5
"""Skewness below which a peak is a Gaussian."""


@dataclass(frozen=True, slots=True)
class Peak:
    """A Pearson type III law: a gamma law moved, scaled, and mirrored if its skewness is below 0.

    The counts of k photoelectrons behind an EM register follow a gamma law, and those
    of a Poisson number of them have its skewness and, within an eighth, its excess kurtosis.

    Attributes:
        mean: Mean.
        width: Standard deviation.
        skewness: Third standardized moment.
    """

    mean: float
    width: float
    skewness: float

    def log_density(self, at: Floats) -> Floats:
        """Logarithm of the density; -700 where there is none."""
        from scipy.special import gammaln

        z = (at - self.mean) / self.width
        if abs(self.skewness) < FLATTEST:
            return -0.5 * z**2 - np.log(self.width * np.sqrt(2 * np.pi))
        order = 4 / self.skewness**2
        part = z * np.sign(self.skewness) / np.sqrt(order)  # of the gamma law's mean, from there on
        inside = np.maximum(part, -1 + 1e-12)
        norm = (order - 0.5) * np.log(order) - order - gammaln(order)
        if order > 1e4:
            norm = -0.5 * np.log(2 * np.pi) - 1 / (12 * order)  # Stirling: the line above cancels
        log_p = order * (np.log1p(inside) - inside) - np.log1p(inside) + norm - np.log(self.width)
        return np.where(part > -1, np.maximum(log_p, -700.0), -700.0)

    def below(self, at: Floats) -> Floats:
        """Probability of less."""
        from scipy.special import gammainc, gammaincc, ndtr

        z = (at - self.mean) / self.width
        if abs(self.skewness) < FLATTEST:
            return ndtr(z)
        order = 4 / self.skewness**2
        rising = np.maximum(order + z * np.sqrt(order) * np.sign(self.skewness), 0.0)
        return gammainc(order, rising) if self.skewness > 0 else gammaincc(order, rising)

    def above(self, at: Floats) -> Floats:
        """Probability of more."""
        return Peak(-self.mean, self.width, -self.skewness).below(-at)

    def widened(self, factor: float) -> Peak:
        """The same with another width."""
        return Peak(self.mean, self.width * factor, self.skewness)


@dataclass(frozen=True, slots=True)
class Shapes:
    """The law of signals that are 0 in the middle of a site's lower peak and 1 in that of its upper.

    Attributes:
        empty: The lower peak.
        full: The upper peak.
        between: Fraction of the signals that lie anywhere between: atoms lost during the exposure.
    """

    empty: Peak
    full: Peak
    between: float


def fit_shapes(signals: Floats, loading: float, width_empty: float, width_full: float) -> Shapes:
    """Fit two peaks and a floor between them by maximum likelihood.

    The floor keeps the atoms that are lost during the exposure, which shine for a
    part of it, from making the tails of the peaks too long. On the outer side of each
    peak signals are only counted, for it is the inner sides that must be right.

    Args:
        signals: float64 (n,), 0 and 1 in the middle of the peaks.
        loading: Fraction in the upper peak, roughly.
        width_empty: Width of the lower peak, roughly.
        width_full: Width of the upper peak, roughly.
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
        return -float(counts @ np.log(density + 1e-7) + outer)

    full = np.clip(loading, 0.02, 0.98)
    start = np.array(
        [0.0, np.log(width_empty), 0.3, 1.0, np.log(width_full), 0.3, np.log(full / (1 - full)), -6.0]
    )
    unit = np.array([width_empty / 3, 0.1, 0.3, width_full / 3, 0.1, 0.3, 0.3, 1.0])
    bounds = [(low / one, high / one) for (low, high), one in zip(_bounds(start), unit, strict=True)]

    def in_units(x: Floats) -> float:
        return unlikelihood(x * unit)

    options = {"maxiter": 500, "ftol": 1e-13, "gtol": 1e-3}
    found = minimize(in_units, start / unit, method="L-BFGS-B", bounds=bounds, options=options)
    return _shapes(found.x * unit)[0]


def _bounds(start: Floats) -> list[tuple[float, float]]:
    narrow, wide = np.log(0.4), np.log(2.5)
    return [
        (-0.3, 0.3),
        (start[1] + narrow, start[1] + wide),
        (-1.8, 1.8),
        (0.7, 1.3),
        (start[4] + narrow, start[4] + wide),
        (-1.8, 1.8),
        (-6.0, 6.0),
        (-12.0, -2.0),
    ]


def _shapes(x: Floats) -> tuple[Shapes, float]:
    empty = Peak(float(x[0]), float(np.exp(x[1])), float(x[2]))
    full = Peak(float(x[3]), float(np.exp(x[4])), float(x[5]))
    return Shapes(empty, full, float(1 / (1 + np.exp(-x[7])))), float(1 / (1 + np.exp(-x[6])))
