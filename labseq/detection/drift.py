"""Measures on one frame the common shift of all sites from their calibrated positions."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FURTHEST_PX: Final = 3.0
N_STEPS: Final = 12
"""Largest shift along each axis in pixels, and the number of steps in which it is found."""


class Shift(NamedTuple):
    """A common shift of all sites.

    Attributes:
        dy: Downwards, in pixels.
        dx: To the right.
        error: Standard error along each axis. If no site is lit, it is inf and the shift is 0.
    """

    dy: float
    dx: float
    error: float


def measure_shift(image: NDArray[Any], positions_px: Floats, spot_px: float) -> Shift:
    """Measure the common shift of the spots from their calibrated positions.

    The light around each site is weighted by a Gaussian as wide as the spot. The centre of the weights, the
    same for all sites, is moved until the mean moment about it is 0. A uniform background does not contribute
    there. Dark sites and sites three times as bright as the others are left out.

    Args:
        image: (height, width), one frame of the size that the sites belong to.
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site.
        spot_px: Width of the spots (1 sigma).

    Returns:
        The shift, 3 pixels at most and accurate up to 2 pixels.
    """
    sites = positions_px.reshape(-1, 2)
    half = int(np.ceil(FURTHEST_PX + 2.5 * spot_px))
    span = np.arange(-half, half + 1)
    middles = np.rint(sites).astype(np.int64)
    y, x = (np.clip(middles[:, axis, None] + span, 0, image.shape[axis] - 1) for axis in (0, 1))
    patches = image[y[:, :, None], x[:, None, :]].astype(np.float64)
    patches -= np.median(patches[:, [0, -1]])
    offsets = middles[:, :, None] + span - sites[:, :, None]
    shift, error = np.zeros(2), np.inf
    for _ in range(N_STEPS):
        light, moments = _moments(patches, offsets - shift[:, None], spot_px)
        lit = _lit(light)
        total = light[lit].sum()
        if not total > 0:
            return Shift(0.0, 0.0, float("inf"))
        step = 2 * moments[lit].sum(axis=0) / total  # a weight as wide as the spot gives half of the shift
        error = 2 * float(np.sqrt((moments[lit] ** 2).sum() / 2)) / total
        shift = np.clip(shift + np.clip(step, -1.0, 1.0), -FURTHEST_PX, FURTHEST_PX)
        if np.abs(step).max() < 1e-3:
            break
    return Shift(float(shift[0]), float(shift[1]), error)


def _moments(patches: Floats, offsets: Floats, spot_px: float) -> tuple[Floats, Floats]:
    """Weighted light of each site, (n_sites,), and its first moments along y and x, (n_sites, 2)."""
    weights = np.exp(-0.5 * (offsets / spot_px) ** 2)
    along_y, along_x = weights[:, 0], weights[:, 1]
    columns = np.matmul(along_y[:, None, :], patches)[:, 0]
    rows = np.matmul(patches, along_x[:, :, None])[:, :, 0]
    moment_y = (rows * along_y * offsets[:, 0]).sum(axis=1)
    moment_x = (columns * along_x * offsets[:, 1]).sum(axis=1)
    return (columns * along_x).sum(axis=1), np.stack([moment_y, moment_x], axis=1)


def _lit(light: Floats) -> NDArray[np.bool_]:
    dark, bright = np.quantile(light, [0.02, 0.97])
    lit = light > (dark + bright) / 2
    return lit & (light < 3 * np.median(light[lit])) if lit.any() else lit
