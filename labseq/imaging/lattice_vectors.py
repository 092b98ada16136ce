"""The two vectors of a lattice, from how a frame resembles itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import SiteGrid

Floats = NDArray[np.float64]

SHORTEST_PX: Final = 3.5
LONGEST_PX: Final = 55.0
ROW_SLANT_RAD: Final = np.deg2rad(17)
SCALES_PX: Final = (0.7, 1.2, 2.0, 3.3)
"""Widths of filters: one of them suits the spots."""

ALIKE: Final = 0.4
"""Least height of a vector's peak, of the highest."""

CLEAR: Final = 4.0
"""Least height of the highest, in standard deviations of what noise alone gives."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """A lattice seen on a frame.

    Attributes:
        along: float64 (2,), (y, x) from a site to the next of its row, in pixels.
        down: float64 (2,), from a site to the one below it, in the next row.
        width_px: Rough width of a spot (1 sigma).
    """

    along: Floats
    down: Floats
    width_px: float


def find_vectors(flat: Floats, grid: SiteGrid) -> Vectors | None:
    """Find the lattice's vectors in the autocorrelation of a frame.

    Moved by a vector of the lattice, the frame resembles itself, whatever the
    offset and whichever sites are dark. Of all such vectors the shortest within 17
    degrees of the image's x axis leads along a row; the one nearest to where
    ``grid`` then has its second axis leads from row to row.

    Args:
        flat: float64 (height, width), see :func:`labseq.imaging.flattening.flattened`.
        grid: Lattice and shear.

    Returns:
        The vectors, or None if the frame resembles itself nowhere.
    """
    clearest, lags, heights, width = CLEAR, np.empty((0, 2)), np.empty(0), 0.0
    for scale in SCALES_PX:
        likeness = autocorrelation(_filtered(flat, scale))
        some_lags, some_heights = _peaks(likeness)
        noise = np.sqrt(8 * np.pi / flat.size) * scale
        if some_heights.max(initial=0.0) / noise > clearest:
            clearest, lags, heights = some_heights.max() / noise, some_lags, some_heights
            width = scale
    if len(lags) == 0:
        return None
    lags = lags[heights >= ALIKE * heights.max()]
    flat_enough = np.abs(np.arctan2(lags[:, 0], lags[:, 1])) < ROW_SLANT_RAD
    if not flat_enough.any():
        return None
    row_lags = lags[flat_enough]
    along = row_lags[np.argmin(np.hypot(*row_lags.T))]
    expected = _turned(along, grid)
    off = np.hypot(*(lags - expected).T)
    if off.min() > 0.35 * np.hypot(*along):
        return None
    return Vectors(along, lags[np.argmin(off)], width)


def autocorrelation(flat: Floats) -> Floats:
    """Autocorrelation for lags up to 55 pixels, float64 (2 m + 1, 2 m + 1), 1 without a lag.

    Args:
        flat: float64 (height, width); its mean is taken off.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    reach = int(min(LONGEST_PX, *(n - 1 for n in flat.shape)))
    shape = tuple(next_fast_len(n + reach, real=True) for n in flat.shape)
    spectrum = np.asarray(rfft2(flat - flat.mean(), s=shape))
    whole = np.asarray(irfft2(np.abs(spectrum) ** 2, s=shape))
    near = np.roll(whole, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return near / max(near[reach, reach], 1e-300)


def _filtered(flat: Floats, scale: float) -> Floats:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(flat, scale, mode="nearest") - gaussian_filter(flat, 2 * scale, mode="nearest")


def _peaks(likeness: Floats) -> tuple[Floats, Floats]:
    """(y, x) of the maxima beside the central one to a part of a pixel, and their heights."""
    from scipy.ndimage import maximum_filter

    middle = len(likeness) // 2
    y, x = np.indices(likeness.shape) - middle
    ring = np.rint(np.hypot(y, x)).astype(int).ravel()
    profile = np.bincount(ring, likeness.ravel()) / np.bincount(ring)
    shortest = max(SHORTEST_PX, float(np.argmax(profile < 0)))
    inner = np.zeros(likeness.shape, np.bool_)
    inner[1:-1, 1:-1] = True
    y, x = np.nonzero((likeness == maximum_filter(likeness, 5)) & inner)
    far = np.hypot(y - middle, x - middle) >= shortest
    y, x = y[far], x[far]
    return np.stack([y, x], axis=1) - middle + _to_the_top(likeness, y, x), likeness[y, x]


def _to_the_top(smooth: Floats, y: NDArray[np.int64], x: NDArray[np.int64]) -> Floats:
    """Of parabolas through three pixels on each axis."""
    here = smooth[y, x]
    steps = list[Floats]()
    for before, after in ((smooth[y - 1, x], smooth[y + 1, x]), (smooth[y, x - 1], smooth[y, x + 1])):
        bend = np.minimum(before - 2 * here + after, -1e-300)
        steps.append(np.clip((before - after) / (2 * bend), -0.5, 0.5))
    return np.stack(steps, axis=1)


def _turned(along: Floats, grid: SiteGrid) -> Floats:
    """Where the second axis is if the first is there and nothing is distorted."""
    a1, a2 = grid.axes / grid.spacing_m
    cos, sin = a1 @ a2, a1[0] * a2[1] - a1[1] * a2[0]
    y, x = along
    return np.array([cos * y + sin * x, cos * x - sin * y])
