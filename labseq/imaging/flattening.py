"""A frame without what is no atom: hot pixels and the slow changes of stray light."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TILE_PX: Final = 48
DARK_QUANTILE: Final = 0.3
HOT: Final = 6.0
"""A pixel so many times as bright as the second brightest around it is hot: no spot of 0.45 px is."""


def flattened(image: NDArray[Any], n_sites: int) -> Floats:
    """Take hot pixels and stray light off a frame.

    Stray light is the quantile of 30 % of tiles 48 pixels wide, smoothly
    interpolated: the dark pixels between the spots, or a constant below the mean
    where spots fill the tile. What is still twice as bright as the brightest
    pixels of spots is cut off there.

    Args:
        image: (height, width), of any real dtype.
        n_sites: How many spots may be there.

    Returns:
        float64 (height, width), counts over the stray light.
    """
    counts = without_hot_pixels(image)
    flat = counts - stray_light(counts)
    n_brightest = min(max(3, n_sites // 4), flat.size)
    cap = 2 * float(np.partition(flat, -n_brightest, axis=None)[-n_brightest])
    return np.clip(flat, -cap, cap)


def without_hot_pixels(image: NDArray[Any]) -> Floats:
    """Give single bright pixels, and pairs, the median of those around them.

    Args:
        image: (height, width), of any real dtype.
    """
    counts = np.array(image, np.float64)
    dark, noise = np.median(counts), pixel_noise(counts)
    y, x = np.nonzero(counts - dark > 2 * HOT * noise)
    padded = np.pad(counts, 1, mode="reflect")
    steps = [(dy, dx) for dy in (0, 1, 2) for dx in (0, 1, 2) if (dy, dx) != (1, 1)]
    around = np.stack([padded[y + dy, x + dx] for dy, dx in steps])
    second = np.maximum(np.sort(around, axis=0)[-2] - dark, noise)
    hot = counts[y, x] - dark > HOT * (second + noise)
    counts[y[hot], x[hot]] = np.median(around[:, hot], axis=0)
    return counts


def pixel_noise(counts: Floats) -> float:
    """Noise of a pixel (1 sigma), from second differences that smooth light does not reach.

    The mask is that of Immerkaer, Computer Vision and Image Understanding 64, 300
    (1996); of the frame's tiles the darkest tenth counts, so that spots do not.

    Args:
        counts: float64 (height, width).
    """
    bends = counts[:-2] - 2 * counts[1:-1] + counts[2:]
    bends = np.abs(bends[:, :-2] - 2 * bends[:, 1:-1] + bends[:, 2:])
    rows = np.array_split(bends, max(1, len(bends) // TILE_PX))
    tiles = [tile for row in rows for tile in np.array_split(row, max(1, row.shape[1] // TILE_PX), axis=1)]
    medians = [float(np.median(tile)) for tile in tiles if tile.size]
    return float(np.quantile(medians, 0.1)) / (0.6745 * 6.0) if medians else 0.0


def stray_light(counts: Floats) -> Floats:
    """The slow part of a frame, float64 (height, width).

    Args:
        counts: float64 (height, width).
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    rows, columns = (_tiles(n) for n in counts.shape)
    levels = np.array(
        [[np.quantile(counts[y0:y1, x0:x1], DARK_QUANTILE) for x0, x1 in columns] for y0, y1 in rows]
    )
    levels = gaussian_filter(levels, 0.7, mode="nearest")
    places = [
        np.interp(np.arange(n), [(first + end - 1) / 2 for first, end in tiles], np.arange(len(tiles)))
        for n, tiles in zip(counts.shape, (rows, columns), strict=True)
    ]
    return map_coordinates(levels, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest")


def _tiles(n_pixels: int) -> list[tuple[int, int]]:
    edges = np.linspace(0, n_pixels, max(1, round(n_pixels / TILE_PX)) + 1).round().astype(int).tolist()
    return list(pairwise(edges))
