"""The lattice of the sites on an averaged frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.detection.sites import spot_light
from labseq.errors import DeviceError
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
        flat: float64 (height, width), see :func:`labseq.calibration.lattice.flattened`.
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


Ints = NDArray[np.int64]

NEAR: Final = 0.3
"""A spot belongs to a site that is so near, in spacings."""

LIT: Final = 0.3
"""A site is lit that has so much of the usual light."""

BRIGHT: Final = 0.5
"""A spot with so much of the usual light tells where the lattice is."""

LINE_LIT: Final = 0.25
"""A row or column is part of the array if so many of its sites are lit, of all or of the fullest."""


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Bright places on a frame.

    Attributes:
        places: float64 (n, 2), (y, x) of each, brightest first.
        light: float64 (n,), falling.
        filtered: float64 (height, width), the frame seen through a filter as wide as the spots.
    """

    places: Floats
    light: Floats
    filtered: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Indexed:
    """Spots with their rows and columns, counted from any spot.

    Attributes:
        spots: int64 (n,), which spots.
        indices: int64 (n, 2), row and column of each.
        surface: The places of all rows and columns.
    """

    spots: Ints
    indices: Ints
    surface: Surface


@dataclass(frozen=True, slots=True)
class Window:
    """Where the array is among the rows and columns.

    Attributes:
        first: Row and column of site (0, 0).
        seen: How many rows and columns of it are lit.
    """

    first: tuple[int, int]
    seen: tuple[int, int]


def find_spots(flat: Floats, vectors: Vectors, noise: float) -> Spots:
    """Find the maxima behind a filter as wide as the spots, less one twice as wide.

    Args:
        flat: float64 (height, width).
        vectors: Spacing and width of the spots.
        noise: Noise of a pixel (1 sigma); what is not three times as bright behind the filter is no spot.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    shortest = min(np.hypot(*vectors.along), np.hypot(*vectors.down))
    width = float(np.clip(vectors.width_px, 0.6, shortest / 4))
    filtered = gaussian_filter(flat, width, mode="nearest") - gaussian_filter(flat, 2 * width, mode="nearest")
    around = maximum_filter(filtered, max(3, 2 * int(0.35 * shortest) + 1), mode="nearest")
    y, x = np.nonzero((filtered == around) & (filtered > 3 * noise / (2 * np.sqrt(np.pi) * width)))
    order = np.argsort(-filtered[y, x])
    y, x = y[order], x[order]
    edged = np.pad(filtered, 1, mode="edge")
    places = np.stack([y, x], axis=1).astype(np.float64)
    for axis, (dy, dx) in enumerate(((1, 0), (0, 1))):
        before, here, after = (edged[y + 1 + k * dy, x + 1 + k * dx] for k in (-1, 0, 1))
        bend = np.minimum(before - 2 * here + after, -1e-300)
        places[:, axis] += np.clip((before - after) / (2 * bend), -0.5, 0.5)
    return Spots(places, filtered[y, x], filtered)


def index_spots(spots: Spots, vectors: Vectors, n_sites: int, reach: int) -> Indexed | None:
    """Give spots their rows and columns.

    It starts at a bright spot whose neighbours are where they should be, and goes
    outwards a few sites at a time; after each step the places are fitted anew, so
    that no distortion adds up.

    Args:
        spots: From :func:`find_spots`.
        vectors: From :func:`labseq.calibration.lattice.find_vectors`.
        n_sites: How many spots are expected.
        reach: Most rows or columns from the start.

    Returns:
        None if no three spots are neighbours.
    """
    from scipy.spatial import KDTree

    bright = spots.light > BRIGHT * usual_light(spots.light, n_sites)
    places = spots.places[bright]
    if len(places) < 3:
        return None
    tree, shortest = KDTree(places), min(np.hypot(*vectors.along), np.hypot(*vectors.down))
    origin = _best_place(places, tree, vectors, shortest)
    steps = np.array([vectors.down, vectors.along])
    surface = Surface(np.array([[0, 0], [1, 0], [0, 1]]), np.zeros(2), 1.0, np.vstack([origin, steps]))
    radius, taken, indices = 1.5, np.empty(0, np.int64), np.empty((0, 2), np.int64)
    while True:
        span = np.arange(-int(radius), int(radius) + 1)
        square = np.stack(np.meshgrid(span, span, indexing="ij"), axis=-1).reshape(-1, 2)
        off, nearest = (np.asarray(answer) for answer in tree.query(surface.at(square)))
        near = off < NEAR * shortest
        near &= _in_full_lines(square, near)
        taken, indices = nearest[near], square[near]
        if len(taken) < 3 or min(len(np.unique(values)) for values in indices.T) < 2:
            return None
        surface, _ = fit_surface(indices, places[taken], 3 if radius >= 4 else 1)
        if radius >= reach:
            return Indexed(np.flatnonzero(bright)[taken], indices, surface)
        radius = min(radius * 1.25 + 0.2, reach)


def _in_full_lines(square: Ints, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which places are in rows and columns with spots enough: noise beside the array has few."""
    full = np.ones(len(square), np.bool_)
    for values in square.T:
        _, line = np.unique(values, return_inverse=True)
        counts = np.bincount(line, near)
        full &= (counts >= LINE_LIT * counts.max())[line]
    return full


def usual_light(light: Floats, n_sites: int) -> float:
    """Median of the brightest, as many as there are sites."""
    return float(np.median(np.sort(light)[::-1][:n_sites])) if len(light) else 0.0


def find_window(spots: Spots, indexed: Indexed, shape: tuple[int, int]) -> Window:
    """Choose the rows and columns with the most light.

    Args:
        spots: From :func:`find_spots`.
        indexed: From :func:`index_spots`.
        shape: (n_rows, n_cols) of the grid.
    """
    from scipy.ndimage import map_coordinates

    usual = float(np.median(spots.light[indexed.spots]))
    low = indexed.indices.min(axis=0) - np.array(shape)
    high = indexed.indices.max(axis=0) + np.array(shape)
    rows, columns = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    index = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    close = np.all((index >= low + np.array(shape) - 2) & (index <= high - np.array(shape) + 2), axis=-1)
    places = indexed.surface.at(index)
    light = map_coordinates(spots.filtered, places.transpose(2, 0, 1), order=1, mode="constant")
    lit = np.where(close, np.clip(light / usual, 0, 1), 0.0)
    total = np.pad(lit.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    n, m = shape
    in_window = total[n:, m:] - total[:-n, m:] - total[n:, :-m] + total[:-n, :-m]
    row, col = np.unravel_index(int(np.argmax(in_window)), in_window.shape)
    seen_rows = _extent((lit[:, col : col + m] > LIT).mean(axis=1))
    seen_columns = _extent((lit[row : row + n] > LIT).mean(axis=0))
    return Window((int(low[0] + row), int(low[1] + col)), (seen_rows, seen_columns))


def _extent(lit: Floats) -> int:
    lines = np.flatnonzero(lit >= LINE_LIT)
    return int(lines[-1] - lines[0] + 1) if len(lines) else 0


def _best_place(places: Floats, tree: object, vectors: Vectors, shortest: float) -> Floats:
    """The spot with the most of its eight neighbours, in a square of three by three, where they should be."""
    from scipy.spatial import KDTree

    assert isinstance(tree, KDTree)
    steps = np.array([i * vectors.down + j * vectors.along for i in (-1, 0, 1) for j in (-1, 0, 1)])
    off, _ = tree.query(places[:, None] + steps)
    n_near = (off < 0.2 * shortest).sum(axis=1)
    best = places[n_near == n_near.max()]
    middle = best.mean(axis=0)
    return best[np.argmin(np.hypot(*(best - middle).T))]


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


MAX_PASSES: Final = 12
SETTLED: Final = 0.01
REACH: Final = 2.7
"""Widths of a spot from its middle to the last pixel that is looked at."""

KNOT_PX: Final = 64
"""Distance of the knots between which stray light changes linearly."""

DIM: Final = 0.25
"""A spot with less than this part of the usual light has no say in the width, and moves little."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedSpots:
    """Spots with a common width.

    Attributes:
        places: float64 (n, 2), (y, x) of each, in pixels.
        light: float64 (n,), counts of each in all.
        width_px: Width of all (1 sigma).
    """

    places: Floats
    light: Floats
    width_px: float


def fit_spots(flat: Floats, places: Floats, width_px: float, furthest_px: float, noise: float) -> FittedSpots:
    """Fit places, light and the common width of spots, and stray light, by Gauss and Newton's least squares.

    All are fitted at once, so that spots may overlap, and a spot at the edge of the
    array is not drawn to the side where its neighbours are. The variance of a pixel
    is that of the dark ones and a part that grows with its light; how fast is
    taken from what the fit before left over.

    Args:
        flat: float64 (height, width).
        places: float64 (n, 2), (y, x) of each spot, roughly.
        width_px: Their width (1 sigma), roughly.
        furthest_px: How far a place may move.
        noise: Noise of a dark pixel (1 sigma).
    """
    from scipy.sparse import csr_array, hstack

    start, n, edge = places, len(places), np.array(flat.shape) - 1.0
    light, all_light, glow = np.zeros(n), np.zeros(n), np.zeros(flat.shape)
    growth = 0.0
    for _ in range(MAX_PASSES):
        pixels, spots, widening = _spot_columns(flat.shape, places, width_px, light)
        seen = flat.ravel()[pixels]
        matrix: Any = hstack([spots, csr_array(widening[:, None]), _stray_columns(flat.shape, pixels)], "csr")
        found = _least_squares(matrix, seen, noise**2 + growth * glow.ravel()[pixels])
        all_light, moves = found[:n], found[n : 3 * n].reshape(2, n).T
        usual = max(float(np.median(all_light[all_light >= np.median(all_light)])), 1e-30)
        wider = float(np.clip(found[3 * n], -0.3 * width_px, 0.4 * width_px))
        steps = np.clip(moves / np.maximum(all_light, DIM * usual)[:, None], -1.0, 1.0)
        if not light.any() or abs(wider) > 0.15 * width_px:
            steps *= 0.0  # spots of a wrong width are drawn to their neighbours
        before = places
        places = np.clip(start + np.clip(places + steps - start, -furthest_px, furthest_px), 0, edge)
        width_px = float(np.clip(width_px + wider, 0.35, 8.0))
        settled = light.any() and max(abs(wider), np.median(np.abs(places - before))) < SETTLED * width_px
        light = np.where(all_light > DIM * usual, all_light, 0.0)
        glow.ravel()[pixels] = spots[:, :n] @ light
        left = seen - matrix @ found
        growth = max(0.0, float((left**2 - noise**2).sum() / max(glow.sum(), 1e-30)))
        if settled:
            break
    return FittedSpots(places, all_light, width_px)


def _spot_columns(
    shape: tuple[int, ...], places: Floats, width_px: float, light: Floats
) -> tuple[Ints, Any, Floats]:
    """What light, y and x of each spot, and the width of all, do to the pixels around the spots.

    Returns:
        The pixels, as flat indices; a sparse matrix (n_pixels, 3 n); the width's column.
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
    part = places - below
    width = shape[1] // KNOT_PX + 2
    weights, knots = list[Floats](), list[Ints]()
    for dy in (0, 1):
        for dx in (0, 1):
            weights.append(np.abs(1 - dy - part[:, 0]) * np.abs(1 - dx - part[:, 1]))
            knots.append((below[:, 0] + dy) * width + below[:, 1] + dx)
    n_knots = (shape[0] // KNOT_PX + 2) * width
    rows = np.tile(np.arange(len(pixels)), 4)
    return csr_array((np.concatenate(weights), (rows, np.concatenate(knots))), shape=(len(pixels), n_knots))


def _least_squares(matrix: Any, values: Floats, variance: Floats) -> Floats:
    """By the normal equations, sparse but for the rows of width and stray light."""
    from scipy.sparse import diags_array, eye_array
    from scipy.sparse.linalg import splu

    weighted = diags_array(1 / np.maximum(variance, 1e-30)) @ matrix
    normal = (matrix.T @ weighted).tocsc()
    norms = np.sqrt(normal.diagonal())
    scale = np.where(norms > 0, 1 / np.maximum(norms, 1e-30), 0.0)
    scaled = diags_array(scale) @ normal @ diags_array(scale) + 1e-9 * eye_array(len(scale))
    factors = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return scale * factors.solve(scale * (weighted.T @ values))


MIN_FOUND: Final = 0.5
"""Least part of the sites that must be lit."""

MAX_RESIDUAL: Final = 0.08
"""Most r.m.s. distance of the spots from the smooth lattice, in spacings."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundLattice:
    """Where the sites are on the frame, and how well that is known.

    Attributes:
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site: a smooth lattice
            fitted to all spots, so that dark sites have their place, too.
        residuals_px: float64 (n_rows, n_cols, 2), (y, x) of each spot less that; NaN where none is.
        light: float64 (n_rows, n_cols), counts of each spot in all.
        frame: (height, width) of the frame.
        spot_px: Width of the spots (1 sigma).
        spacing_px: From a site to the next of its row, and to the one below it, in the middle of the array.
        angle_rad: Rotation against the grid, clockwise on the screen; stretch and shear do not count.
        stretch: Most over least magnification of all directions.
        pixel_size_m: Size of a pixel in the atom plane, if the grid's spacing is true.
        residual_px: R.m.s. distance of the spots from the lattice.
    """

    positions_px: Floats
    residuals_px: Floats
    light: Floats
    frame: tuple[int, int]
    spot_px: float
    spacing_px: tuple[float, float]
    angle_rad: float
    stretch: float
    pixel_size_m: float
    residual_px: float

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which sites have a spot, bool (n_rows, n_cols)."""
        return np.isfinite(self.residuals_px[..., 0])

    @property
    def n_sites_found(self) -> int:
        """How many sites have a spot."""
        return int(self.found.sum())


def find_lattice(
    image: NDArray[Any], grid: SiteGrid, *, saturated: float = 65535.0, camera: str = "camera"
) -> FoundLattice:
    """Find where the sites of a grid are on an averaged frame.

    Rows run along the image's x axis within 15 degrees, from left to right;
    ``grid.shear`` says which of the other directions is the second axis, and it
    leads downwards. So row 0 is at the top and column 0 at the left, and the
    six-fold symmetry of the triangular lattice leaves nothing to choose. All sites
    are on the frame; spacings of 5 to 40 pixels, spots of 0.5 to 4 pixels (1 sigma) with at
    least 2.5 of their widths between them.

    The steps are told in ``docs/explanation/finding-sites.md``.

    Args:
        image: (height, width), mean of frames on which each site is often lit.
        grid: The grid of sites: its size, lattice and shear; no lengths are used.
        saturated: Counts of a pixel that is full.
        camera: Name of the camera, for messages.

    Raises:
        DeviceError: No such lattice is on the frame; it says why.
    """
    counts = _checked(image, grid, saturated, camera)
    flat = flattened(counts, grid.n_rows * grid.n_cols)
    noise = pixel_noise(counts)
    vectors = find_vectors(flat, grid)
    if vectors is None:
        n_spots = len(find_spots(flat, _ANY, 2 * noise).light)
        _fail(
            camera,
            f"{n_spots} spots found of {grid.n_rows * grid.n_cols} expected, and nothing that repeats as a "
            f"{grid.lattice} lattice with rows within 15 degrees of the x axis does; {_DARK}",
        )
    spots = find_spots(flat, vectors, noise)
    surface, first = _indexed(spots, vectors, grid, camera)
    index = np.moveaxis(np.indices(grid.shape), 0, -1)
    return _refined(flat, noise, vectors, surface, index + np.array(first), grid, camera)


_ANY: Final = Vectors(np.array([0.0, 10.0]), np.array([10.0, 0.0]), 1.2)
_DARK: Final = "check the exposure, the light, the loading, the focus, and `grid.lattice`"


def _checked(image: NDArray[Any], grid: SiteGrid, saturated: float, camera: str) -> Floats:
    if min(grid.shape) < 2:
        _fail(
            camera,
            f"a lattice has two directions, {grid.n_rows} x {grid.n_cols} sites do not; set `detector.sites` "
            "to a file with their places",
        )
    counts = np.asarray(image, np.float64)
    if counts.ndim != 2 or min(counts.shape) < 16 or not np.isfinite(counts).all():
        _fail(
            camera,
            f"the frame is {image.dtype} {image.shape}; expected finite numbers, (height, width) of 16 "
            "pixels or more",
        )
    highest = counts.max()
    full = min(saturated, highest) if highest > counts.min() else saturated
    n_full = int(np.count_nonzero(counts >= full))
    if n_full > max(20, grid.n_rows * grid.n_cols // 20):
        _fail(
            camera,
            f"{n_full} pixels of the frame are saturated ({full:g} counts); use less light, gain or exposure",
        )
    return counts


def _fail(camera: str, message: str) -> NoReturn:
    raise DeviceError(camera, f"no lattice found: {message}")


def _indexed(spots: Spots, vectors: Vectors, grid: SiteGrid, camera: str) -> tuple[Surface, tuple[int, int]]:
    """Places of all rows and columns, and which of them are row 0 and column 0."""
    n_sites = grid.n_rows * grid.n_cols
    indexed = index_spots(spots, vectors, n_sites, max(grid.shape) + 2)
    bright = int(np.count_nonzero(spots.light > 0.3 * usual_light(spots.light, n_sites)))
    n_indexed = 0 if indexed is None else len(indexed.spots)
    if indexed is None or n_indexed < MIN_FOUND * min(bright, n_sites):
        _fail(
            camera,
            f"of {bright} spots only {n_indexed} stand on a lattice; {n_sites} are expected; {_DARK}",
        )
    window = find_window(spots, indexed, grid.shape)
    if window.seen != grid.shape:
        rows, cols = window.seen
        _fail(
            camera,
            f"{rows} x {cols} rows and columns of sites are lit, the grid has {grid.n_rows} x {grid.n_cols}; "
            "a dark row or column at the edge leaves open which one it is: load it, or set the "
            "size and `shear` of `grid` to what the static tweezers make",
        )
    return indexed.surface, window.first


def _refined(
    flat: Floats,
    noise: float,
    vectors: Vectors,
    surface: Surface,
    index: NDArray[np.int64],
    grid: SiteGrid,
    camera: str,
) -> FoundLattice:
    shortest = float(min(np.hypot(*vectors.along), np.hypot(*vectors.down)))
    sites = index.reshape(-1, 2)
    fitted, lit = FittedSpots(surface.at(sites), np.ones(len(sites)), vectors.width_px), np.ones(0)
    for _ in range(2):
        fitted = fit_spots(flat, surface.at(sites), fitted.width_px, 0.3 * shortest, noise)
        off = np.hypot(*(fitted.places - surface.at(sites)).T)
        lit = (fitted.light > 0.25 * np.median(fitted.light)) & (off < 0.29 * shortest)
        if lit.sum() < max(3, MIN_FOUND * len(sites)):
            _fail(camera, f"{lit.sum()} spots found of {len(sites)} expected; {_DARK}")
        surface, _ = fit_surface(sites[lit], fitted.places[lit], 3, fitted.light[lit])
    positions = surface.at(sites)
    residuals = np.where(lit[:, None], fitted.places - positions, np.nan)
    residual = float(np.sqrt(np.nanmean((residuals**2).sum(axis=1))))
    if residual > MAX_RESIDUAL * shortest:
        _fail(
            camera,
            f"the spots lie {residual:.2f} pixels (r.m.s.) beside a lattice of {shortest:.1f} pixels; "
            "sites of an irregular array come from a file: set `detector.sites`",
        )
    height, width = flat.shape
    if ((positions < -0.5) | (positions > np.array([height, width]) - 0.5)).any():
        _fail(camera, "some of its sites are beside the frame; move the camera or take a larger frame")
    return _described(positions, residuals, fitted, residual, surface, index, flat.shape, grid)


def _described(
    positions: Floats,
    residuals: Floats,
    fitted: FittedSpots,
    residual: float,
    surface: Surface,
    index: NDArray[np.int64],
    frame: tuple[int, ...],
    grid: SiteGrid,
) -> FoundLattice:
    down, along = surface.axes(index.reshape(-1, 2).mean(axis=0))
    seen = np.stack([along[::-1], down[::-1]], axis=1)  # (x, y) of each, as columns
    magnification = seen @ np.linalg.inv(grid.axes.T)  # pixels per metre
    left, strengths, right = np.linalg.svd(magnification)
    turned = left @ right
    return FoundLattice(
        positions_px=positions.reshape(*grid.shape, 2),
        residuals_px=residuals.reshape(*grid.shape, 2),
        light=fitted.light.reshape(grid.shape),
        frame=(frame[0], frame[1]),
        spot_px=fitted.width_px,
        spacing_px=(float(np.hypot(*along)), float(np.hypot(*down))),
        angle_rad=float(np.arctan2(turned[1, 0], turned[0, 0])),
        stretch=float(strengths[0] / strengths[1]),
        pixel_size_m=float(1 / np.sqrt(strengths[0] * strengths[1])),
        residual_px=residual,
    )
