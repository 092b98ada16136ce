"""Finds and fits the spots on an averaged frame, after removing hot pixels and stray light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HOT: Final = 6.0
"""A pixel this many times brighter than its second brightest neighbour is hot. Spots of 0.45 px are not."""


def spot_light(
    centres_px: NDArray[np.float64], corners: NDArray[np.int64], region: int, width_px: float
) -> NDArray[np.float64]:
    """Fraction of the light of Gaussian spots on the pixels of squares.

    Args:
        centres_px: float64 (n, 2), (y, x) of each spot.
        corners: int64 (n, 2), (y, x) of the first pixel of each square.
        region: Width of the squares, in pixels.
        width_px: Width of the spots (1 sigma), in pixels.

    Returns:
        float64 (n, region, region).

    Example:
        >>> import numpy as np
        >>> spot_light(np.array([[3.0, 3.0]]), np.array([[2, 2]]), 3, 0.1).round(3)[0, 1]
        array([0., 1., 0.])
    """
    from scipy.special import ndtr

    edges = (corners[:, :, None] + np.arange(region + 1) - 0.5 - centres_px[:, :, None]) / width_px
    along_y, along_x = np.diff(ndtr(edges), axis=2).transpose(1, 0, 2)
    return along_y[:, :, None] * along_x[:, None, :]


def flattened(image: NDArray[Any], n_sites: int) -> Floats:
    """Remove hot pixels and stray light from a frame.

    Stray light is the 30 % quantile of tiles 48 pixels wide, smoothly interpolated. This is the level of the
    dark pixels between the spots, or a constant below the mean where spots fill the tile. Pixels are clipped
    at twice the brightness of the brightest pixels of spots.

    Args:
        image: (height, width), of any real dtype.
        n_sites: Expected number of spots.

    Returns:
        float64 (height, width), counts above the stray light.
    """
    counts = without_hot_pixels(image)
    flat = counts - stray_light(counts)
    n_brightest = min(max(3, n_sites // 4), flat.size)
    cap = 2 * float(np.partition(flat, -n_brightest, axis=None)[-n_brightest])
    return np.clip(flat, -cap, cap)


def without_hot_pixels(image: NDArray[Any]) -> Floats:
    """Replace single bright pixels, and pairs, by the median of their neighbours."""
    counts = np.array(image, np.float64)
    dark, noise = np.median(counts), pixel_noise(counts)
    places = np.nonzero(counts - dark > 2 * HOT * noise)  # the others are too dim, whatever their neighbours
    edged = np.pad(counts, 1, mode="reflect")
    around = np.sort([edged[places[0] + i // 3, places[1] + i % 3] for i in (0, 1, 2, 3, 5, 6, 7, 8)], axis=0)
    second = np.maximum(around[-2] - dark, noise)
    hot = counts[places] - dark > HOT * (second + noise)
    counts[places[0][hot], places[1][hot]] = around[4, hot]
    return counts


def pixel_noise(counts: Floats) -> float:
    """Noise of a pixel (1 sigma), from second differences, which smooth light does not change.

    The mask is from Immerkaer, Computer Vision and Image Understanding 64, 300
    (1996). The darkest tenth of the frame's tiles counts, because spots add noise.
    """
    bends = counts[:-2] - 2 * counts[1:-1] + counts[2:]
    bends = np.abs(bends[:, :-2] - 2 * bends[:, 1:-1] + bends[:, 2:])
    medians = [float(np.median(tile)) for row in _tiles(bends) for tile in row if tile.size]
    return float(np.quantile(medians, 0.1)) / (0.6745 * 6.0) if medians else 0.0


def stray_light(counts: Floats) -> Floats:
    """The slowly varying part of a frame, float64 (height, width)."""
    from scipy.ndimage import gaussian_filter, zoom

    levels = np.array([[np.quantile(tile, 0.3) for tile in row] for row in _tiles(counts)])
    factors = np.array(counts.shape) / levels.shape
    levels = gaussian_filter(levels, 0.7, mode="nearest")
    return np.asarray(zoom(levels, factors, order=1, mode="nearest", grid_mode=True), np.float64)


def _tiles(counts: Floats) -> list[list[Floats]]:
    n_rows, n_cols = (max(1, round(n / 48)) for n in counts.shape)
    return [np.array_split(row, n_cols, axis=1) for row in np.array_split(counts, n_rows)]


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Bright spots on a frame.

    Attributes:
        places: float64 (n, 2), (y, x) of each, brightest first.
        light: float64 (n,), descending.
        filtered: float64 (height, width), the frame after a filter as wide as the spots.
    """

    places: Floats
    light: Floats
    filtered: Floats


def find_spots(flat: Floats, spacing_px: float, width_px: float, noise: float) -> Spots:
    """Find the maxima after a Gaussian filter as wide as the spots, minus a filter twice as wide.

    Args:
        flat: float64 (height, width), see :func:`flattened`.
        spacing_px: Shortest distance of two spots.
        width_px: Width of the spots (1 sigma), roughly.
        noise: Noise of a pixel (1 sigma). Spots are three times brighter after the filter.
    """
    from scipy.ndimage import maximum_filter

    width = float(np.clip(width_px, 0.6, spacing_px / 4))
    filtered = filtered_by_width(flat, width)
    around = maximum_filter(filtered, max(3, 2 * int(0.35 * spacing_px) + 1), mode="nearest")
    y, x = np.nonzero((filtered == around) & (filtered > 3 * noise / (2 * np.sqrt(np.pi) * width)))
    order = np.argsort(-filtered[y, x])
    y, x = y[order], x[order]
    return Spots(peak_places(filtered, y, x), filtered[y, x], filtered)


def filtered_by_width(flat: Floats, width_px: float) -> Floats:
    """The difference of a frame after Gaussian filters of the given width and of twice the width."""
    from scipy.ndimage import gaussian_filter

    narrow, wide = (gaussian_filter(flat, width, mode="nearest") for width in (width_px, 2 * width_px))
    return narrow - wide


def peak_places(smooth: Floats, y: Ints, x: Ints) -> Floats:
    """(y, x) of maxima to a fraction of a pixel, float64 (n, 2), by parabolas through three pixels."""
    padded = np.pad(smooth, 1, mode="edge")
    places = np.stack([y, x], axis=1).astype(np.float64)
    for axis, (dy, dx) in enumerate(((1, 0), (0, 1))):
        before, at_peak, after = (padded[y + 1 + k * dy, x + 1 + k * dx] for k in (-1, 0, 1))
        bend = np.minimum(before - 2 * at_peak + after, -1e-300)
        places[:, axis] += np.clip((before - after) / (2 * bend), -0.5, 0.5)
    return places


def usual_light(light: Floats, n_sites: int) -> float:
    """Median of the ``n_sites`` brightest."""
    return float(np.median(np.sort(light)[::-1][:n_sites])) if len(light) else 0.0


REACH: Final = 2.7
"""Distance from a spot to the last pixel that is fitted, in widths of the spot."""

KNOT_PX: Final = 64
"""Distance of the knots of stray light, in pixels, between which it changes linearly."""


DIM: Final = 0.25
"""Spots with less than this fraction of the usual light do not affect the width, and move little."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedSpots:
    """Spots with a common width.

    Attributes:
        places: float64 (n, 2), (y, x) of each, in pixels.
        light: float64 (n,), total counts of each.
        width_px: Common width (1 sigma).
    """

    places: Floats
    light: Floats
    width_px: float


def fit_spots(flat: Floats, places: Floats, width_px: float, furthest_px: float, noise: float) -> FittedSpots:
    """Fit places, light and the common width of spots, and stray light, by the Gauss-Newton method.

    All are fitted together, so that spots may overlap, and a spot at the edge of the array is not pulled
    towards its neighbours. The variance of a pixel is the variance of a dark pixel plus a part proportional
    to its light, with a factor from the residuals of the previous pass.

    Args:
        flat: float64 (height, width).
        places: float64 (n, 2), (y, x) of each spot, roughly.
        width_px: Their width (1 sigma), roughly.
        furthest_px: Maximum distance that a place may move in the fit.
        noise: Noise of a dark pixel (1 sigma).
    """
    from scipy.sparse import csr_array, hstack

    start, n, edge = places, len(places), np.array(flat.shape) - 1.0
    light, all_light, glow = np.zeros(n), np.zeros(n), np.zeros(flat.shape)
    growth, dark_noise = 0.0, noise
    for _ in range(12):
        pixels, spots, widening = _spot_columns(flat.shape, places, width_px, light)
        counts = flat.ravel()[pixels]
        matrix: Any = hstack([spots, csr_array(widening[:, None]), _stray_columns(flat.shape, pixels)], "csr")
        solution = _least_squares(matrix, counts, dark_noise**2 + growth * glow.ravel()[pixels])
        all_light, moves = solution[:n], solution[n : 3 * n].reshape(2, n).T
        usual = max(float(np.median(all_light[all_light >= np.median(all_light)])), 1e-30)
        wider = float(np.clip(solution[3 * n], -0.3 * width_px, 0.4 * width_px))
        steps = np.clip(moves / np.maximum(all_light, DIM * usual)[:, None], -1.0, 1.0)
        if not light.any() or abs(wider) > 0.15 * width_px:
            steps *= 0.0  # a wrong width pulls spots towards their neighbours
        before = places
        places = np.clip(start + np.clip(places + steps - start, -furthest_px, furthest_px), 0, edge)
        width_px = float(np.clip(width_px + wider, 0.35, 8.0))
        settled = light.any() and max(abs(wider), np.median(np.abs(places - before))) < 0.01 * width_px
        light = np.where(all_light > DIM * usual, all_light, 0.0)
        # how well the shape of spots is known, relative to their peak, so that the wings of bright spots do #
        # not dominate
        dark_noise = max(noise, 0.01 * usual / (2 * np.pi * width_px**2))
        glow.ravel()[pixels] = spots[:, :n] @ light
        residuals = counts - matrix @ solution
        growth = max(0.0, float((residuals**2 - noise**2).sum() / max(glow.sum(), 1e-30)))
        if settled:
            break
    return FittedSpots(places, all_light, width_px)


class KnownSpots:
    """Spots whose places and width are known, to fit their light on many frames.

    Args:
        shape: (height, width) of the frames.
        places: float64 (n, 2), (y, x) of each spot, in pixels.
        width_px: Common width (1 sigma).
    """

    def __init__(self, shape: tuple[int, int], places: Floats, width_px: float) -> None:
        from scipy.sparse import hstack

        self._n = len(places)
        self._pixels, spots, _ = _spot_columns(shape, places, width_px, np.zeros(self._n))
        self._matrix: Any = hstack([spots[:, : self._n], _stray_columns(shape, self._pixels)], "csr")

    def fit(self, image: NDArray[Any]) -> Floats:
        """Fit the light of each spot, and stray light that changes slowly, by least squares.

        Returns:
            The light, float64 (n,), in counts.
        """
        counts = np.asarray(image.ravel()[self._pixels], np.float64)
        return _least_squares(self._matrix, counts, np.ones(len(counts)))[: self._n]


def _spot_columns(
    shape: tuple[int, ...], places: Floats, width_px: float, light: Floats
) -> tuple[Ints, Any, Floats]:
    """Derivatives of the pixels around the spots by light, y and x of each spot, and by the common width.

    Returns:
        The pixels, as flat indices, a sparse matrix (n_pixels, 3 n), and the column of the width.
    """
    from scipy.sparse import csr_array

    n, reach = len(places), int(np.ceil(REACH * width_px))
    region, h = 2 * reach + 1, 0.01
    corners = np.rint(places).astype(np.int64) - reach
    y, x = (corners[:, axis, None] + np.arange(region) for axis in (0, 1))
    y, x = np.broadcast_arrays(y[:, :, None], x[:, None, :])
    inside = (y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1])
    pixels, rows = np.unique((y * shape[1] + x)[inside], return_inverse=True)
    parts = [spot_light(places, corners, region, width_px)]
    for dy, dx, wider in ((h, 0, 0), (0, h, 0), (0, 0, h)):
        step = np.array([dy, dx])
        more = spot_light(places + step, corners, region, width_px + wider)
        parts.append((more - spot_light(places - step, corners, region, width_px - wider)) / (2 * h))
    site = np.broadcast_to(np.arange(n)[:, None, None], y.shape)[inside]
    columns = np.concatenate([site, site + n, site + 2 * n])
    values = np.concatenate([part[inside] for part in parts[:3]])
    spots = csr_array((values, (np.tile(rows, 3), columns)), shape=(len(pixels), 3 * n))
    widening = np.zeros(len(pixels))
    np.add.at(widening, rows, (parts[3] * light[:, None, None])[inside])
    return pixels, spots, widening


def _stray_columns(shape: tuple[int, ...], pixels: Ints) -> Any:
    """Weights of the knots of stray light at the pixels, a sparse matrix (n_pixels, n_knots)."""
    from scipy.sparse import csr_array

    places = np.stack(np.unravel_index(pixels, shape), axis=1) / KNOT_PX
    below = places.astype(np.int64)
    fraction = places - below
    width = shape[1] // KNOT_PX + 2
    weights, knots = list[Floats](), list[Ints]()
    for dy in (0, 1):
        for dx in (0, 1):
            weights.append(np.abs(1 - dy - fraction[:, 0]) * np.abs(1 - dx - fraction[:, 1]))
            knots.append((below[:, 0] + dy) * width + below[:, 1] + dx)
    n_knots = (shape[0] // KNOT_PX + 2) * width
    rows = np.tile(np.arange(len(pixels)), 4)
    return csr_array((np.concatenate(weights), (rows, np.concatenate(knots))), shape=(len(pixels), n_knots))


def _least_squares(matrix: Any, values: Floats, variance: Floats) -> Floats:
    """Solve the weighted normal equations, which are sparse."""
    from scipy.sparse import diags_array, eye_array
    from scipy.sparse.linalg import splu

    weighted = diags_array(1 / np.maximum(variance, 1e-30)) @ matrix
    normal = (matrix.T @ weighted).tocsc()
    norms = np.sqrt(normal.diagonal())
    scale = np.where(norms > 0, 1 / np.maximum(norms, 1e-30), 0.0)
    scaled = diags_array(scale) @ normal @ diags_array(scale) + 1e-9 * eye_array(len(scale))
    factors = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return scale * factors.solve(scale * (weighted.T @ values))
