"""Arrows that hop from site to site."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

HEIGHT: Final = (0.28, 0.85)
"""Least and largest height of a hop, in units of the spacing."""
STEP: Final = 0.17
"""Height between lanes, in the same unit, while there is room for all of them."""
GAP: Final = 0.16
"""Distance of an arrow's ends from the centres of its sites, in the same unit."""
HEAD: Final = (0.42, 0.2)
"""Length and half width of an arrow's head, in the same unit."""

N_POINTS: Final = 16


def lanes(moves: NDArray[np.integer]) -> NDArray[np.intp]:
    """Part the ways that share a stretch of a line, so that they can be drawn beside one another.

    Short ways get the low lanes. Opposite ways along a line need not be parted:
    they are drawn on opposite sides of it.

    Args:
        moves: (n, 4), from row, from column, to row, to column; each along a row or a column.

    Returns:
        The lane of each, from 0.

    Example:
        >>> lanes(np.array([[0, 0, 0, 3], [0, 1, 0, 2], [0, 5, 0, 6], [1, 0, 1, 3]])).tolist()
        [1, 0, 0, 0]
    """
    way = moves[:, 2:] - moves[:, :2]
    axis = (way[:, 0] != 0).astype(np.intp)  # 1 along a column, whose moves count rows
    each = np.arange(len(moves))
    line, start, end = moves[each, axis], moves[each, 1 - axis], moves[each, 3 - axis]
    found = np.zeros(len(moves), np.intp)
    taken: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for i in np.argsort(np.abs(end - start), kind="stable"):
        low, high = sorted((int(start[i]), int(end[i])))
        where = int(axis[i]), int(line[i]), int(end[i] > start[i])
        lane = 0
        while any(a < high and low < b for a, b in taken.get((*where, lane), ())):
            lane += 1
        taken.setdefault((*where, lane), []).append((low, high))
        found[i] = lane
    return found


def heights(lane: NDArray[np.intp]) -> NDArray[np.float64]:
    """Heights of hops, in units of the spacing: lanes lie closer together if there are many.

    Example:
        >>> heights(np.array([0, 1])).round(2).tolist()
        [0.28, 0.45]
    """
    low, high = HEIGHT
    step = min(STEP, (high - low) / max(1, int(lane.max(initial=0))))
    return low + step * lane.astype(np.float64)


def hops(
    start: NDArray[np.float64], end: NDArray[np.float64], height: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw each arrow as a flat arc to the left of its way, so that opposite ways differ.

    The arc is a quadratic Bezier curve.

    Args:
        start: float64 (n, 2), in units of the spacing.
        end: float64 (n, 2); no arrow may have length 0.
        height: float64 (n,), in the same unit.

    Returns:
        The shafts, float64 (n, points, 2), and the heads, float64 (n, 3, 2).

    Example:
        >>> shafts, heads = hops(np.zeros((1, 2)), np.array([[3.0, 0.0]]), np.array([0.3]))
        >>> shafts.shape, heads.shape
        ((1, 16, 2), (1, 3, 2))
    """
    way = end - start
    length = np.hypot(way[:, 0], way[:, 1])[:, None]
    along = way / length
    aside = np.stack([along[:, 1], -along[:, 0]], axis=1)
    start, end = start + GAP * along, end - GAP * along
    bend = (start + end) / 2 + 2 * height[:, None] * aside
    landing = end - bend
    landing /= np.hypot(landing[:, 0], landing[:, 1])[:, None]
    size = np.minimum(1.0, 0.8 * length)
    neck = end - HEAD[0] * size * landing
    side = HEAD[1] * size * np.stack([landing[:, 1], -landing[:, 0]], axis=1)
    t = np.linspace(0.0, 1.0, N_POINTS)[None, :, None]
    shafts = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * bend[:, None] + t**2 * neck[:, None]
    return shafts, np.stack([end, neck + side, neck - side], axis=1)
