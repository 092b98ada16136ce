"""Gaussian spots fitted to a frame, all at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.spots import spot_light

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

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
