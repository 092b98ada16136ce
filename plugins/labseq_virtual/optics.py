"""From atoms to photoelectrons on pixels: where the spots are, how bright, and what they look like."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import SiteGrid
from labseq_virtual.image_settings import ImageSettings
from labseq_virtual.view import View


def site_spots(settings: ImageSettings, grid: SiteGrid) -> NDArray[np.float64]:
    """Centres of the sites' spots on the full sensor.

    The grid is turned, stretched along an axis of the frame, put on its place, and bent by the
    radial distortion of the lenses.

    Returns:
        float64 (n_rows, n_cols, 2), (y, x) in pixels.
    """
    to_axis, ratio = settings.stretch_angle, math.sqrt(1 + settings.stretch)
    stretched = _rotation(to_axis) @ np.diag([1 / ratio, ratio]) @ _rotation(-to_axis)
    to_frame = stretched @ _rotation(settings.angle)
    straight = grid.positions_m[..., ::-1] @ to_frame.T / settings.pixel_size + settings.centre_px
    bent = 1 - settings.barrel * corner_distance(settings, straight) ** 2
    return middle(settings) + (straight - middle(settings)) * bent[..., None]


def site_brightness(
    settings: ImageSettings, spots: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """How bright an atom on each site is, relative to one in the middle of the frame.

    Args:
        settings: Constants of the optics.
        spots: What :func:`site_spots` found.
        rng: Random numbers of the machine.

    Returns:
        float64 (n_rows, n_cols).
    """
    spread = np.maximum(0.0, 1 + settings.brightness_spread * rng.standard_normal(spots.shape[:2]))
    return spread * np.maximum(0.0, 1 - settings.vignetting * corner_distance(settings, spots) ** 2)


def photoelectrons(
    settings: View,
    spots: NDArray[np.float64],
    mean: NDArray[np.float64],
    rng: np.random.Generator,
    binning: int = 1,
) -> NDArray[np.int32]:
    """Draw the photoelectrons of atoms on each pixel that is read.

    Each is drawn by itself: how many an atom gives (Poisson), and where each falls. In the
    spot that is a Gaussian, sampled by the pixels without any approximation. The fraction
    ``halo`` falls in wings of the density w / (2 pi (r^2 + w^2)^(3/2)), which fall as the mean
    of an Airy pattern does.

    Args:
        settings: Constants of the optics, and the part of the sensor that is read.
        spots: float64 (n_atoms, 2), (y, x) of each atom's spot on the sensor.
        mean: float64 (n_atoms,), mean photoelectrons of each.
        rng: Random numbers of the shot.
        binning: Pixels of the sensor per pixel of the frame, along each axis.

    Returns:
        int32 (height, width).
    """
    from labseq_virtual import _kernels_image as kernels

    n_each = rng.poisson(mean)
    n = int(n_each.sum())
    beside = rng.standard_normal((n, 2), np.float32)
    beside *= np.float32(settings.spot / settings.pixel_size)
    if settings.halo > 0:
        wide = np.flatnonzero(rng.random(n, np.float32) < settings.halo)
        beside[wide] = _wings(len(wide), rng) * (settings.halo_width / settings.pixel_size)
    top, left, height, width = settings.region
    light = np.zeros((height // binning, width // binning), np.int32)
    kernels.scatter(beside, spots, n_each, top, left, binning, light)
    return light


def middle(settings: ImageSettings) -> NDArray[np.float64]:
    """The middle of the sensor, (y, x)."""
    return (np.array(settings.frame) - 1) / 2


def corner_distance(settings: ImageSettings, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of places (..., 2) from the middle of the sensor; 1 is its corner."""
    return np.linalg.norm(places - middle(settings), axis=-1) / math.hypot(*(np.array(settings.frame) / 2))


def _wings(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Places in wings of width 1 (n, 2): where an even light from a unit above meets the plane."""
    cosine = 1.0 - rng.random(n)
    radius = np.sqrt(1 / cosine**2 - 1)
    angle = 2 * np.pi * rng.random(n)
    return np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    """Rotation of (y, x) clockwise on the screen."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, sin], [-sin, cos]])
