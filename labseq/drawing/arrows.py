"""Arrows that hop from site to site."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

HOP: Final = 0.34
"""Height of a hop, in units of the spacing: arrows along one line lie beside one another."""
GAP: Final = 0.16
"""Distance of an arrow's ends from the centres of its sites, in the same unit."""
HEAD: Final = (0.42, 0.2)
"""Length and half width of an arrow's head, in the same unit."""

N_POINTS: Final = 12


def hops(
    start: NDArray[np.float64], end: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw each arrow as a flat arc to the left of its way, so that opposite ways differ.

    The arc is a quadratic Bezier curve.

    Args:
        start: float64 (n, 2), in units of the spacing.
        end: float64 (n, 2); no arrow may have length 0.

    Returns:
        The shafts, float64 (n, points, 2), and the heads, float64 (n, 3, 2).

    Example:
        >>> shafts, heads = hops(np.zeros((1, 2)), np.array([[3.0, 0.0]]))
        >>> shafts.shape, heads.shape
        ((1, 12, 2), (1, 3, 2))
    """
    way = end - start
    length = np.hypot(way[:, 0], way[:, 1])[:, None]
    along = way / length
    aside = np.stack([along[:, 1], -along[:, 0]], axis=1)
    start, end = start + GAP * along, end - GAP * along
    bend = (start + end) / 2 + 2 * np.minimum(HOP, 0.3 * length) * aside
    landing = end - bend
    landing /= np.hypot(landing[:, 0], landing[:, 1])[:, None]
    size = np.minimum(1.0, 0.8 * length)
    neck = end - HEAD[0] * size * landing
    side = HEAD[1] * size * np.stack([landing[:, 1], -landing[:, 0]], axis=1)
    t = np.linspace(0.0, 1.0, N_POINTS)[None, :, None]
    shafts = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * bend[:, None] + t**2 * neck[:, None]
    return shafts, np.stack([end, neck + side, neck - side], axis=1)
