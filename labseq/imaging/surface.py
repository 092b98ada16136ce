"""Places on a frame as a smooth function of row and column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TUKEY: Final = 4.685
"""Where Tukey's biweight ends, in standard deviations: 95 % efficient for Gaussian errors."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A polynomial in (row, column) for y and one for x.

    Attributes:
        powers: int64 (n_terms, 2), powers of row and column in each term.
        centre: float64 (2,), (row, column) that is taken off first.
        scale: What the rest is divided by.
        coefficients: float64 (n_terms, 2), for y and for x, in pixels.
    """

    powers: NDArray[np.int64]
    centre: Floats
    scale: float
    coefficients: Floats

    def at(self, indices: Floats | NDArray[np.int64]) -> Floats:
        """(y, x) in pixels of (row, column), float64 (..., 2)."""
        return _terms((indices - self.centre) / self.scale, self.powers) @ self.coefficients

    def axes(self, index: Floats) -> Floats:
        """(y, x) from one row to the next and from one column to the next, float64 (2, 2), at a place."""
        steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        down, up, right, left = self.at(index + steps)
        return np.stack([down - up, right - left])


def fit_surface(
    indices: Floats | NDArray[np.int64], places: Floats, degree: int, trust: Floats | None = None
) -> tuple[Surface, Floats]:
    """Fit places by robust least squares (Tukey's biweight).

    Powers of a coordinate are at most half the number of its values, and there are three
    points for each term at least, but for a degree of 1.

    Args:
        indices: (n, 2), row and column of each point; three points not on a line.
        places: float64 (n, 2), (y, x) of each.
        degree: Highest degree of a term.
        trust: float64 (n,), weight of each point; None is 1.

    Returns:
        The surface, and the weights of the points in the end, float64 (n,): 0 for
        those that lie far beside it.
    """
    centre = (indices.max(axis=0) + indices.min(axis=0)) / 2
    scale = max(1.0, float(np.abs(indices - centre).max()))
    powers = _powers(indices, degree)
    matrix = _terms((indices - centre) / scale, powers)
    weights = base = np.ones(len(indices)) if trust is None else trust / trust.max()
    coefficients: Floats = np.zeros((len(powers), 2))
    for _ in range(12):
        root = np.sqrt(weights)[:, None]
        coefficients = np.asarray(np.linalg.lstsq(matrix * root, places * root, rcond=None)[0], np.float64)
        off = np.hypot(*(places - matrix @ coefficients).T)
        width = max(float(np.median(off[base > 0])) / 1.1774, 1e-9)
        weights = base * np.clip(1 - (off / (TUKEY * width)) ** 2, 0, None) ** 2
        if np.count_nonzero(weights) < len(powers):
            weights = base
    return Surface(powers, centre, scale, coefficients), weights


def _powers(indices: Floats | NDArray[np.int64], degree: int) -> NDArray[np.int64]:
    highest = [len(np.unique(values)) // 2 for values in indices.T]
    for most in range(degree, 0, -1):
        powers = np.array(
            [
                (i, j)
                for i in range(most + 1)
                for j in range(most + 1 - i)
                if i <= highest[0] and j <= highest[1]
            ]
        )
        if most == 1 or len(indices) >= 3 * len(powers):
            return powers
    return np.zeros((1, 2), np.int64)


def _terms(at: Floats, powers: NDArray[np.int64]) -> Floats:
    return np.prod(at[..., None, :] ** powers, axis=-1)
