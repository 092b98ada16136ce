"""Finds the lattice of the sites on an averaged frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.detection.spots import (
    FittedSpots,
    Spots,
    filtered_by_width,
    find_spots,
    fit_spots,
    flattened,
    peak_places,
    pixel_noise,
    usual_light,
)
from labseq.errors import DeviceError
from labseq.model import SiteGrid

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Centre: TypeAlias = tuple[float, float] | None

SATURATED: Final = 65535.0
"""Counts of a saturated pixel."""
SCALES_PX: Final = (0.7, 1.2, 2.0, 3.3)
"""Widths of the filters to try, in pixels."""


CLEAR: Final = 4.0
"""Minimum height of the highest peak, in standard deviations of noise."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """The vectors of a lattice on a frame.

    Attributes:
        along: float64 (2,), (y, x) from a site to the next of its row, in pixels.
        down: float64 (2,), from a site to the site below it, in the next row.
        width_px: Rough width of a spot (1 sigma).
    """

    along: Floats
    down: Floats
    width_px: float

    @property
    def shortest_px(self) -> float:
        """Length of the shorter vector."""
        return float(min(np.hypot(*self.along), np.hypot(*self.down)))


def find_vectors(flat: Floats, grid: SiteGrid) -> Vectors | None:
    """Find the lattice's vectors in the autocorrelation of a frame.

    Shifted by a vector of the lattice, the frame resembles itself, independent of its offset and of dark
    sites. The shortest such vector within 17 degrees of the image's x axis points along a row. The vector
    nearest to the second axis of ``grid`` points from row to row. A single column has no rows, so the
    shortest vector within 17 degrees of the second axis counts. A single row or column takes the other vector
    from ``grid``.

    Args:
        flat: float64 (height, width), see :func:`labseq.detection.spots.flattened`.
        grid: Lattice and shear.

    Returns:
        The vectors, or None if none are found.
    """
    clearest, lags, heights, width = CLEAR, np.empty((0, 2)), np.empty(0), 0.0
    for scale in SCALES_PX:
        likeness = autocorrelation(filtered_by_width(flat, scale))
        some_lags, some_heights = _peaks(likeness)
        noise = np.sqrt(8 * np.pi / flat.size) * scale
        if some_heights.max(initial=0.0) / noise > clearest:
            clearest, lags, heights = some_heights.max() / noise, some_lags, some_heights
            width = scale
    if len(lags) == 0:
        return None
    lags = lags[heights >= 0.4 * heights.max()]
    first = int(grid.n_cols == 1)  # the axis that the search begins with
    x, y = grid.axes[first]
    slant = np.arctan2(lags[:, 0] * x - lags[:, 1] * y, lags[:, 1] * x + lags[:, 0] * y)
    likely = lags[np.abs(slant) < np.deg2rad(17)]  # a little more than the documented 15 degrees
    if len(likely) == 0:
        return None
    shortest = likely[np.argmin(np.hypot(*likely.T))]
    other = _turned(shortest, grid, first)
    if 1 not in grid.shape:
        off = np.hypot(*(lags - other).T)
        if off.min() > 0.35 * np.hypot(*shortest):
            return None
        other = lags[np.argmin(off)]
    return Vectors(other, shortest, width) if first else Vectors(shortest, other, width)


def autocorrelation(flat: Floats) -> Floats:
    """Autocorrelation for lags up to 55 pixels, float64 (2 m + 1, 2 m + 1), 1 at zero lag."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    reach = int(min(55.0, *(n - 1 for n in flat.shape)))
    shape = tuple(next_fast_len(n + reach, real=True) for n in flat.shape)
    spectrum = np.asarray(rfft2(flat - flat.mean(), s=shape))
    whole = np.asarray(irfft2(np.abs(spectrum) ** 2, s=shape))
    near = np.roll(whole, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return near / max(near[reach, reach], 1e-300)


def _peaks(likeness: Floats) -> tuple[Floats, Floats]:
    """(y, x) of the maxima other than the central one, and their heights."""
    from scipy.ndimage import maximum_filter

    middle = len(likeness) // 2
    y, x = np.indices(likeness.shape) - middle
    distance = np.hypot(y, x)
    ring = np.rint(distance).astype(np.int64).ravel()
    profile = np.bincount(ring, likeness.ravel()) / np.bincount(ring)
    shortest = max(3.5, float(np.argmax(profile < 0)))
    peaks = (likeness == maximum_filter(likeness, 5)) & (distance >= shortest)
    peaks[[0, -1]] = peaks[:, [0, -1]] = False
    y, x = np.nonzero(peaks)
    return peak_places(likeness, y, x) - middle, likeness[y, x]


def _turned(vector: Floats, grid: SiteGrid, axis: int) -> Floats:
    """The other axis of an undistorted grid whose given axis is ``vector``."""
    first, other = grid.axes[axis] / grid.spacing_m, grid.axes[1 - axis] / grid.spacing_m
    cosine, sine = first @ other, first[0] * other[1] - first[1] * other[0]
    y, x = vector
    return np.array([cosine * y + sine * x, cosine * x - sine * y])


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Polynomials of row and column that give y and x.

    Attributes:
        powers: int64 (n_terms, 2), powers of row and column in each term.
        centre: float64 (2,), (row, column) that is subtracted first.
        scale: Divisor after the centre is subtracted.
        coefficients: float64 (n_terms, 2), for y and for x, in pixels.
    """

    powers: NDArray[np.int64]
    centre: Floats
    scale: float
    coefficients: Floats

    def at(self, indices: Floats | NDArray[np.int64]) -> Floats:
        """(y, x) in pixels at each (row, column), float64 (..., 2)."""
        return _terms((indices - self.centre) / self.scale, self.powers) @ self.coefficients

    def axes(self, index: Floats) -> Floats:
        """(y, x) from a (row, column) to the next row and to the next column, float64 (2, 2), in pixels."""
        steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        down, up, right, left = self.at(index + steps)
        return np.stack([down - up, right - left])


def fit_surface(
    indices: Floats | NDArray[np.int64], places: Floats, degree: int, trust: Floats | None = None
) -> tuple[Surface, Floats]:
    """Fit places by robust least squares (Tukey's biweight).

    Powers of a coordinate are at most half the number of its values. Above degree 1, there
    are at least three points for each term.

    Args:
        indices: (n, 2), row and column of each point. A coordinate with one value is not fitted, so along a
            single row places depend on the column only.
        places: float64 (n, 2), (y, x) of each.
        degree: Highest degree of a term.
        trust: float64 (n,), weight of each point. None means 1.

    Returns:
        The surface, and the final weights of the points, float64 (n,), 0 for outliers.
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
        # 4.685 standard deviations: 95 % efficient for Gaussian errors
        weights = base * np.clip(1 - (off / (4.685 * width)) ** 2, 0, None) ** 2
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


NEAR: Final = 0.3
"""Maximum distance of a spot from its site, in spacings."""

LIT: Final = 0.3
"""Minimum light of a bright site, relative to the usual light."""

BRIGHT: Final = 0.5
"""Minimum light of a spot from which the lattice is found, relative to the usual light."""

LINE_LIT: Final = 0.25
"""Minimum fraction of bright sites in a row or column, of all its sites or of the count in the fullest."""


@dataclass(frozen=True, slots=True, eq=False)
class Indexed:
    """Spots with their rows and columns, counted from an arbitrary spot.

    Attributes:
        spots: int64 (n,), indices of the spots.
        indices: int64 (n, 2), row and column of each.
        surface: Places of all rows and columns.
    """

    spots: Ints
    indices: Ints
    surface: Surface


def index_spots(
    spots: Spots, vectors: Vectors, shape: tuple[int, int], centre_px: Centre = None
) -> Indexed | None:
    """Assign a row and a column to each spot.

    It starts at a bright spot with neighbours at the expected places, and continues outwards a few sites at a
    time. The places are fitted again after each step, so that distortions do not add up. A single row or
    column is followed along itself only, starting at the spot nearest to its centre if the centre is known.

    Returns:
        None if too few spots are neighbours (three, or both of a line of two).
    """
    from scipy.spatial import KDTree

    n_sites, reach = shape[0] * shape[1], max(shape) + 2
    bright = spots.light > BRIGHT * usual_light(spots.light, n_sites)
    places = spots.places[bright]
    fewest = min(3, n_sites)
    if len(places) < fewest:
        return None
    tree, shortest = KDTree(places), vectors.shortest_px
    if centre_px is not None and 1 in shape:
        origin = places[tree.query(centre_px)[1]]
    else:
        origin = _best_place(places, tree, vectors, shortest)
    steps = np.array([vectors.down, vectors.along])
    surface = Surface(np.array([[0, 0], [1, 0], [0, 1]]), np.zeros(2), 1.0, np.vstack([origin, steps]))
    radius, taken, indices = 1.5, np.empty(0, np.int64), np.empty((0, 2), np.int64)
    while True:
        spans = [np.arange(-int(radius), int(radius) + 1) if n > 1 else np.zeros(1, np.int64) for n in shape]
        square = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 2)
        off, nearest = (np.asarray(answer) for answer in tree.query(surface.at(square)))
        near = off < NEAR * shortest
        near &= _in_full_lines(square, near)
        taken, indices = nearest[near], square[near]
        n_lines = [len(np.unique(values)) for values in indices.T]
        if len(taken) < fewest or any(
            n < min(2, n_wanted) for n, n_wanted in zip(n_lines, shape, strict=True)
        ):
            return None
        surface, _ = fit_surface(indices, places[taken], 3 if radius >= 4 else 1)
        if radius >= reach:
            return Indexed(np.flatnonzero(bright)[taken], indices, surface)
        radius = min(radius * 1.25 + 0.2, reach)


def _in_full_lines(square: Ints, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True for each spot in a row and a column with many spots, which excludes noise outside the array."""
    full = np.ones(len(square), np.bool_)
    for values in square.T:
        _, line = np.unique(values, return_inverse=True)
        counts = np.bincount(line, near)
        full &= (counts >= LINE_LIT * counts.max())[line]
    return full


def find_window(
    spots: Spots, indexed: Indexed, shape: tuple[int, int], centre_px: Centre = None
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Choose the ``shape`` rows and columns with the most light.

    If the centre is given, choose the nearest rows and columns, whatever else is lit.

    Returns:
        Row and column of site (0, 0), and the number of bright rows and columns of the array.
    """
    from scipy.ndimage import map_coordinates

    usual = float(np.median(spots.light[indexed.spots]))
    beyond = np.where(np.array(shape) > 1, shape, 0)
    low, high = indexed.indices.min(axis=0) - beyond, indexed.indices.max(axis=0) + beyond
    rows, columns = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    index = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    n, m = shape
    if centre_px is not None:
        middles = indexed.surface.at(
            index[: len(rows) - n + 1, : len(columns) - m + 1] + [(n - 1) / 2, (m - 1) / 2]
        )
        off = np.hypot(*np.moveaxis(middles - np.array(centre_px), -1, 0))
        row, col = np.unravel_index(int(np.argmin(off)), off.shape)
        return (int(rows[row]), int(columns[col])), shape
    close = np.all((index >= low + np.array(shape) - 2) & (index <= high - np.array(shape) + 2), axis=-1)
    places = indexed.surface.at(index)
    light = map_coordinates(spots.filtered, places.transpose(2, 0, 1), order=1, mode="constant")
    lit = np.where(close, np.clip(light / usual, 0, 1), 0.0)
    total = np.pad(lit.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    in_window = total[n:, m:] - total[:-n, m:] - total[n:, :-m] + total[:-n, :-m]
    row, col = np.unravel_index(int(np.argmax(in_window)), in_window.shape)
    seen_rows = _extent((lit[:, col : col + m] > LIT).mean(axis=1))
    seen_columns = _extent((lit[row : row + n] > LIT).mean(axis=0))
    return (int(low[0] + row), int(low[1] + col)), (seen_rows, seen_columns)


def _extent(lit: Floats) -> int:
    lines = np.flatnonzero(lit >= LINE_LIT)
    return int(lines[-1] - lines[0] + 1) if len(lines) else 0


def _best_place(places: Floats, tree: KDTree, vectors: Vectors, shortest: float) -> Floats:
    """The spot with the largest number of its eight neighbours at the expected places."""
    steps = np.array([i * vectors.down + j * vectors.along for i in (-1, 0, 1) for j in (-1, 0, 1)])
    off, _ = tree.query(places[:, None] + steps)
    n_near = (off < 0.2 * shortest).sum(axis=1)
    best = places[n_near == n_near.max()]
    middle = best.mean(axis=0)
    return best[np.argmin(np.hypot(*(best - middle).T))]


MIN_FOUND: Final = 0.5
"""Minimum fraction of bright sites."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundLattice:
    """Positions of the sites on the frame. A value that a single line or site does not show is nan.

    Attributes:
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site on a smooth lattice fitted to all
            spots, so that dark sites also have a position.
        residuals_px: float64 (n_rows, n_cols, 2), (y, x) of each spot minus its site, or NaN for dark sites.
        light: float64 (n_rows, n_cols), total counts of each spot.
        frame: (height, width) of the frame.
        spot_px: Width of the spots (1 sigma).
        spacing_px: From a site to the next of its row, and to the site below it, in the middle of the array.
        angle_rad: Rotation of the grid, clockwise on the screen, without stretch and shear.
        stretch: Ratio of the largest magnification of any direction to the smallest.
        pixel_size_m: Size of a pixel in the atom plane, if the grid's spacing is right.
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
        """The sites with a spot, bool (n_rows, n_cols)."""
        return np.isfinite(self.residuals_px[..., 0])

    @property
    def n_sites_found(self) -> int:
        """Number of sites with a spot."""
        return int(self.found.sum())


def find_lattice(image: NDArray[Any], grid: SiteGrid, *, centre_px: Centre = None) -> FoundLattice:
    """Find the positions of a grid's sites on an averaged frame.

    Rows run along the image's x axis within 15 degrees, from left to right. ``grid.shear`` says which of the
    other directions is the second axis, which leads downwards. So row 0 is at the top and column 0 at the
    left, and the six-fold symmetry of the triangular lattice causes no ambiguity. All sites must be on the
    frame. The spacing must be 5 to 40 pixels and the spots 0.5 to 4 pixels wide (1 sigma), with at least 2.5
    widths between them. A single column is within 15 degrees of the grid's second axis.

    The steps are described in ``docs/explanation/finding-sites.md``.

    Args:
        image: (height, width), mean of frames on which each site often holds an atom.
        grid: Size, lattice and shear of the grid of sites. Its spacing is not used.
        centre_px: (y, x) of the middle of the grid to better than half a spacing, for frames that show more
            of the lattice, or more lines or spots, than the grid has.

    Raises:
        DeviceError: No such lattice is on the frame. The message says why.
    """
    counts = _checked(image, grid)
    flat = flattened(counts, grid.n_rows * grid.n_cols)
    noise = pixel_noise(counts)
    index = np.moveaxis(np.indices(grid.shape), 0, -1)
    if grid.shape == (1, 1):
        vectors, surface = _single(flat, noise, centre_px)
        return _refined(flat, noise, vectors, surface, index, grid)
    vectors = find_vectors(flat, grid)
    if vectors is None:
        n_spots = len(find_spots(flat, 10.0, 1.2, 2 * noise).light)
        _fail(
            f"{n_spots} spots found of {grid.n_rows * grid.n_cols} expected, but they do not repeat as a "
            f"{grid.lattice} lattice with rows within 15 degrees of the x axis; {_DARK}",
        )
    spots = find_spots(flat, vectors.shortest_px, vectors.width_px, noise)
    surface, first = _indexed(spots, vectors, grid, centre_px)
    return _refined(flat, noise, vectors, surface, index + np.array(first), grid)


_DARK: Final = "check the exposure, the light, the loading, the focus, and `grid.lattice`"
_MORE: Final = "if there are more traps than the grid has, give its centre with `--centre Y,X` in pixels"


def _checked(image: NDArray[Any], grid: SiteGrid) -> Floats:
    counts = np.asarray(image, np.float64)
    if counts.ndim != 2 or min(counts.shape) < 16 or not np.isfinite(counts).all():
        _fail(
            f"the frame is {image.dtype} {image.shape}; expected finite numbers, (height, width) at least 16 "
            "pixels or more",
        )
    highest = counts.max()
    full = min(SATURATED, highest) if highest > counts.min() else SATURATED
    n_full = int(np.count_nonzero(counts >= full))
    if n_full > max(20, grid.n_rows * grid.n_cols // 20):
        _fail(
            f"{n_full} pixels of the frame are saturated ({full:g} counts); use less light, gain or exposure",
        )
    return counts


def _fail(message: str) -> NoReturn:
    raise DeviceError("camera", f"no lattice found: {message}")


def _single(flat: Floats, noise: float, centre_px: Centre) -> tuple[Vectors, Surface]:
    """The place of the only spot, or of the spot nearest to ``centre_px``, with made-up vectors."""
    width = max(SCALES_PX, key=lambda scale: scale * float(filtered_by_width(flat, scale).max()))
    spacing = 8 * width
    spots = find_spots(flat, spacing, width, 2 * noise)
    bright = spots.places[spots.light > BRIGHT * spots.light.max(initial=0.0)]
    if len(bright) == 0 or (len(bright) > 1 and centre_px is None):
        _fail(f"{len(bright)} spots found of 1 expected; {_DARK if len(bright) == 0 else _MORE}")
    nearest = 0 if centre_px is None else int(np.argmin(np.hypot(*(bright - np.array(centre_px)).T)))
    surface = Surface(np.zeros((1, 2), np.int64), np.zeros(2), 1.0, bright[nearest : nearest + 1])
    return Vectors(np.array([0.0, spacing]), np.array([spacing, 0.0]), width), surface


def _indexed(
    spots: Spots, vectors: Vectors, grid: SiteGrid, centre_px: Centre
) -> tuple[Surface, tuple[int, int]]:
    """The fitted places of all rows and columns, and the indices of row 0 and column 0."""
    n_sites = grid.n_rows * grid.n_cols
    indexed = index_spots(spots, vectors, grid.shape, centre_px)
    bright = int(np.count_nonzero(spots.light > 0.3 * usual_light(spots.light, n_sites)))
    n_indexed = 0 if indexed is None else len(indexed.spots)
    if indexed is None or n_indexed < MIN_FOUND * min(bright, n_sites):
        _fail(
            f"of {bright} spots only {n_indexed} are on a lattice, but {n_sites} are expected; {_DARK}",
        )
    n_others = bright - n_indexed
    if 1 in grid.shape and centre_px is None and n_others > 0.25 * n_sites:
        _fail(
            f"the grid has {grid.n_rows} x {grid.n_cols} sites, but {n_others} spots are off its line; "
            f"{_MORE}"
        )
    first, lit_shape = find_window(spots, indexed, grid.shape, centre_px)
    if lit_shape != grid.shape:
        rows, cols = lit_shape
        _fail(
            f"{rows} x {cols} rows and columns are lit, but the grid has {grid.n_rows} x {grid.n_cols}; "
            "load a dark row or column at the edge (its place is ambiguous), or set the "
            f"size and `shear` of `grid` as in the static tweezers, or, {_MORE}",
        )
    return indexed.surface, first


def _refined(
    flat: Floats,
    noise: float,
    vectors: Vectors,
    surface: Surface,
    index: NDArray[np.int64],
    grid: SiteGrid,
) -> FoundLattice:
    shortest = vectors.shortest_px
    sites = index.reshape(-1, 2)
    fitted, lit = FittedSpots(surface.at(sites), np.ones(len(sites)), vectors.width_px), np.ones(0)
    for _ in range(2):
        fitted = fit_spots(flat, surface.at(sites), fitted.width_px, 0.3 * shortest, noise)
        off = np.hypot(*(fitted.places - surface.at(sites)).T)
        lit = (fitted.light > 0.25 * np.median(fitted.light)) & (off < 0.29 * shortest)
        if lit.sum() < max(min(3, len(sites)), MIN_FOUND * len(sites)):
            _fail(f"{lit.sum()} spots found of {len(sites)} expected; {_DARK}")
        surface, _ = fit_surface(sites[lit], fitted.places[lit], 3, fitted.light[lit])
    positions = surface.at(sites)
    residuals = np.where(lit[:, None], fitted.places - positions, np.nan)
    residual = float(np.sqrt(np.nanmean((residuals**2).sum(axis=1))))
    if residual > 0.08 * shortest:
        _fail(
            f"the spots are {residual:.2f} pixels (r.m.s.) away from a lattice of {shortest:.1f} pixels; "
            "for an irregular array, read the sites from a file with `detector.sites`",
        )
    height, width = flat.shape
    if ((positions < -0.5) | (positions > np.array([height, width]) - 0.5)).any():
        _fail("some of its sites are outside the frame; move the camera or take a larger frame")
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
    if grid.n_rows == 1:
        down = _turned(along, grid, 0)
    elif grid.n_cols == 1:
        along = _turned(down, grid, 1)
    vectors_xy = np.stack([along[::-1], down[::-1]], axis=1)  # (x, y) of each, as columns
    magnification = vectors_xy @ np.linalg.inv(grid.axes.T)  # pixels per metre
    left_vectors, strengths, right_vectors = np.linalg.svd(magnification)
    rotation = left_vectors @ right_vectors
    steps = [
        float(np.hypot(*step)) if n > 1 else np.nan for step, n in ((along, grid.n_cols), (down, grid.n_rows))
    ]
    is_one = grid.shape == (1, 1)
    return FoundLattice(
        positions_px=positions.reshape(*grid.shape, 2),
        residuals_px=residuals.reshape(*grid.shape, 2),
        light=fitted.light.reshape(grid.shape),
        frame=(frame[0], frame[1]),
        spot_px=fitted.width_px,
        spacing_px=(steps[0], steps[1]),
        angle_rad=np.nan if is_one else float(np.arctan2(rotation[1, 0], rotation[0, 0])),
        stretch=np.nan if 1 in grid.shape else float(strengths[0] / strengths[1]),
        pixel_size_m=np.nan if is_one else float(1 / np.sqrt(strengths[0] * strengths[1])),
        residual_px=residual,
    )
