"""The lattice of sites, found on an averaged frame without any start value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.imaging.flattening import flattened, pixel_noise
from labseq.imaging.lattice_growth import Spots, find_spots, find_window, index_spots, usual_light
from labseq.imaging.lattice_vectors import Vectors, find_vectors
from labseq.imaging.spot_fit import FittedSpots, fit_spots
from labseq.imaging.surface import Surface, fit_surface
from labseq.model import SiteGrid

Floats = NDArray[np.float64]

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
