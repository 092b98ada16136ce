"""The optics between SLM and atoms, with the sites in the far field, the beam, and aberrations.

A phase that grows by k radians from pixel to pixel sends the light to ``k * wavelength * focal_length /
(2 pi * pixel_pitch)`` from the zeroth order (Goodman, "Introduction to Fourier Optics", chapter 5). Pixels
can make -pi to pi per pixel, which is the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LimitError, SiteGrid
from labseq_slm.settings import SlmSettings, ZernikeSettings

Floats = NDArray[np.float64]

CLEAR: Final = 2.5
"""Least distance of a site from others and from the zeroth order, in 1/e^2 radii of a spot (ours).

At this distance the light of a spot is down to 4e-6 of its middle."""


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """Directions of the light to the sites, and the available light.

    Attributes:
        row_rad: float64 (n_sites,), phase from row to row of pixels that sends light to a site.
        column_rad: float64 (n_sites,), the same phase from column to column.
        pixels: Rows and columns of pixels.
        beam_px: 1/e^2 radius of the intensity on the SLM, in pixels.
    """

    row_rad: Floats
    column_rad: Floats
    pixels: tuple[int, int]
    beam_px: float


def optics_of(name: str, settings: SlmSettings, grid: SiteGrid) -> Optics:
    """The optics of an array.

    Args:
        name: Name of the device, for messages.
        settings: The SLM and the lens.
        grid: The sites.

    Raises:
        LimitError: Sites are outside of the field, on the zeroth order, or closer together than their spots.
    """
    scale_m = settings.wavelength * settings.focal_length / (2 * math.pi * settings.pixel_pitch)
    x, y = np.moveaxis(grid.positions_m.reshape(-1, 2), -1, 0)
    x = -x if settings.mirrored else x
    cos, sin = math.cos(settings.rotation), math.sin(settings.rotation)
    x, y = cos * x + sin * y + settings.offset[0], cos * y - sin * x + settings.offset[1]
    spot_m = settings.wavelength * settings.focal_length / (math.pi * settings.beam_waist)
    _check(name, grid, np.stack([x, y], axis=1), math.pi * scale_m, CLEAR * spot_m)
    beam_px = settings.beam_waist / settings.pixel_pitch
    return Optics(y / scale_m, x / scale_m, settings.pixels, beam_px)


def _check(name: str, grid: SiteGrid, places_m: Floats, field_m: float, clear_m: float) -> None:
    """Refuse sites that the SLM cannot make.

    Args:
        name: Name of the device.
        grid: The sites.
        places_m: float64 (n_sites, 2), (x, y) of each site from the zeroth order.
        field_m: How far the field reaches from there along x and y.
        clear_m: Least distance between spots.
    """
    shape = f"{grid.n_rows} x {grid.n_cols} sites {grid.spacing_m * 1e6:.3g} um apart"
    width_m = float(np.ptp(places_m, axis=0).max())
    if width_m >= 2 * field_m:
        limit = f"{2 * field_m * 1e6:.4g} um, the field of the SLM"
        hint = "use fewer sites, a longer `focal_length` or a smaller `pixel_pitch`"
        raise LimitError(f"{name}: width of {shape}", f"{width_m * 1e6:.4g} um", limit, hint)
    beyond = np.abs(places_m).max(axis=1)
    if (far_m := float(beyond.max())) >= field_m:
        limit = f"{field_m * 1e6:.4g} um, half of the field of the SLM"
        what = f"{name}: distance of site {_site(grid, int(beyond.argmax()))} from the zeroth order"
        raise LimitError(what, f"{far_m * 1e6:.4g} um", limit, "`offset` is too large", setting=("offset",))
    distance = np.hypot(*places_m.T)
    if (near_m := float(distance.min())) < clear_m:
        limit = f"{clear_m * 1e6:.3g} um or more"
        what = f"{name}: distance of site {_site(grid, int(distance.argmin()))} from the zeroth order"
        hint = "move the array with `offset`"
        raise LimitError(what, f"{near_m * 1e6:.3g} um", limit, hint, setting=("offset",))
    if len(places_m) > 1 and grid.spacing_m < clear_m:
        limit = f"{clear_m * 1e6:.3g} um or more, as wide as the spots are"
        hint = "use a wider `beam_waist` or a shorter `focal_length`"
        raise LimitError(f"{name}: distance between sites", f"{grid.spacing_m * 1e6:.3g} um", limit, hint)


def _site(grid: SiteGrid, index: int) -> str:
    return f"({index // grid.n_cols}, {index % grid.n_cols})"


def beam(pixels: tuple[int, int], waist_px: float, shift_px: float = 0.0) -> NDArray[np.float32]:
    """Amplitude of a Gaussian beam on the pixels, float32 (rows, columns), 1 in its middle.

    Args:
        pixels: Rows and columns of pixels.
        waist_px: 1/e^2 radius of its intensity.
        shift_px: How far to the right of the middle of the SLM it is.
    """
    row, column = (np.arange(n) - (n - 1) / 2 for n in pixels)
    square = row[:, None] ** 2 + (column - shift_px) ** 2
    return np.exp(-square / waist_px**2).astype(np.float32)


def zernike_phase(modes: ZernikeSettings, pixels: tuple[int, int]) -> NDArray[np.float32]:
    """The sum of Zernike modes, float32 (rows, columns) in rad.

    The modes have the norm of Noll (J. Opt. Soc. Am. 66, 207, 1976), so coefficients are r.m.s. phases over
    the largest circle on the pixels. Beyond the circle the polynomials go on.
    """
    radius = (min(pixels) - 1) / 2
    row, column = (((np.arange(n) - (n - 1) / 2) / radius).astype(np.float32) for n in pixels)
    y, x = row[:, None], column[None, :]
    square = x**2 + y**2
    shapes = {
        "defocus": (3, lambda: 2 * square - 1),
        "oblique_astigmatism": (6, lambda: 2 * x * y),
        "vertical_astigmatism": (6, lambda: x**2 - y**2),
        "vertical_coma": (8, lambda: (3 * square - 2) * y),
        "horizontal_coma": (8, lambda: (3 * square - 2) * x),
        "vertical_trefoil": (8, lambda: (3 * x**2 - y**2) * y),
        "oblique_trefoil": (8, lambda: (x**2 - 3 * y**2) * x),
        "spherical": (5, lambda: 6 * square**2 - 6 * square + 1),
    }
    phase = np.zeros(pixels, np.float32)
    for mode, (norm, shape) in shapes.items():
        if coefficient := getattr(modes, mode):
            phase += np.float32(coefficient * math.sqrt(norm)) * shape()
    return phase
