"""Which spot is which site: rows and columns, grown over the frame from its best place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.lattice_vectors import Vectors
from labseq.imaging.surface import Surface, fit_surface

Floats = NDArray[np.float64]
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
        vectors: From :func:`labseq.imaging.lattice_vectors.find_vectors`.
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
