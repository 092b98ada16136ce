"""Sites on the frame."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labseq.detection.sites import site_pixels
from labseq.model import SiteGrid

PIXEL_M = 0.35e-6


def test_neighbours_are_one_spacing_apart() -> None:
    pixels = site_pixels(SiteGrid(), PIXEL_M, (255.5, 255.5))
    along_row = np.linalg.norm(np.diff(pixels, axis=1), axis=-1)
    down_column = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    np.testing.assert_allclose(along_row, 4.49 / 0.35)
    np.testing.assert_allclose(down_column, 4.49 / 0.35)


def test_row_0_is_at_the_top_and_lower_rows_shift_with_the_shear() -> None:
    right = site_pixels(SiteGrid(shear=1), PIXEL_M, (0.0, 0.0))
    left = site_pixels(SiteGrid(shear=-1), PIXEL_M, (0.0, 0.0))
    assert (np.diff(right[..., 0], axis=0) > 0).all()
    assert (np.diff(right[..., 1], axis=0) > 0).all()
    assert (np.diff(left[..., 1], axis=0) < 0).all()
    assert (np.diff(right[..., 1], axis=1) > 0).all()


def test_the_grid_turns_clockwise_about_its_centre() -> None:
    grid = SiteGrid(1, 3, spacing_m=1e-6)
    turned = site_pixels(grid, 1e-6, (10.0, 20.0), math.pi / 2)
    np.testing.assert_allclose(turned[0], [[9.0, 20.0], [10.0, 20.0], [11.0, 20.0]])


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, -1.2])
def test_the_centre_of_the_sites_is_where_it_was_put(angle_rad: float) -> None:
    pixels = site_pixels(SiteGrid(5, 8), PIXEL_M, (100.25, 300.75), angle_rad)
    np.testing.assert_allclose(pixels.mean(axis=(0, 1)), [100.25, 300.75])
