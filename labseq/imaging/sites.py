"""Where the sites are on a frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.model import SiteGrid


def site_pixels(
    grid: SiteGrid, pixel_size_m: float, centre_px: tuple[float, float], angle_rad: float = 0.0
) -> NDArray[np.float64]:
    """Map the sites onto the camera.

    Args:
        grid: The grid of sites; its centre is the origin of its positions.
        pixel_size_m: Size of a camera pixel in the atom plane, in metres.
        centre_px: (y, x) of the grid's centre. Whole numbers are the middles of
            pixels, so the centre of a 512 x 512 frame is (255.5, 255.5).
        angle_rad: Rotation of the grid about its centre; positive is clockwise on
            the screen, where y points down.

    Returns:
        float64 (n_rows, n_cols, 2), (y, x) of each site in pixels.

    Example:
        >>> grid = SiteGrid(1, 2, spacing_m=4e-6)
        >>> site_pixels(grid, 1e-6, (10.0, 20.0)).tolist()
        [[[10.0, 18.0], [10.0, 22.0]]]
    """
    x_m, y_m = grid.positions_m[..., 0], grid.positions_m[..., 1]
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    y_px = centre_px[0] + (x_m * sin + y_m * cos) / pixel_size_m
    x_px = centre_px[1] + (x_m * cos - y_m * sin) / pixel_size_m
    return np.stack([y_px, x_px], axis=-1)
