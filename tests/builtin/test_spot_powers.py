"""Powers of spots, fitted on drawn frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.builtin.spot_powers import SpotPowers
from labseq.detection.sites import site_pixels
from labseq.detection.spots import spot_light
from labseq.errors import DeviceError
from labseq.model import Frame, SiteGrid

Floats = NDArray[np.float64]

GRID = SiteGrid(6, 8)
RNG = np.random.default_rng(5)
POWER = 30e3 * np.exp(RNG.normal(0, 0.15, GRID.shape))
REGION = 15


def frame(power: Floats, full: int = 65535) -> Frame:
    """Photoelectrons with shot noise, read noise, and stray light that rises from left to right."""
    places = site_pixels(GRID, 0.35e-6, (80.3, 99.6), 0.03).reshape(-1, 2)
    corners = np.rint(places).astype(np.int64) - REGION // 2
    image = np.zeros((160, 200)) + np.linspace(10, 40, 200)
    lights = spot_light(places, corners, REGION, 1.2) * power.reshape(-1, 1, 1)
    for (y, x), light in zip(corners, lights, strict=True):
        image[y : y + REGION, x : x + REGION] += light
    counts = RNG.poisson(image) + RNG.normal(100, 2, image.shape)
    return Frame(np.clip(np.rint(counts), 0, full).astype(np.uint16), 1e-3, 0.0)


def test_powers_are_known_to_the_shot_noise() -> None:
    spots = SpotPowers(GRID, "trap_camera")
    for change in (1.0, np.outer(np.linspace(0.7, 1.3, 6), np.ones(8))):  # with the places of the first frame
        off = (spots.fit(frame(change * POWER)) / POWER / change - 1) * np.sqrt(POWER)
        assert off.std() < 1.6
        assert abs(off.mean()) < 1.0


def without(row: int, col: int) -> Floats:
    power = POWER.copy()
    power[row, col] = 0.0
    return power


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (
            lambda: frame(2 * POWER, full=4095),
            r"pixels? (is|are) saturated \(4095 counts\); shorten the exposure",
        ),
        (
            lambda: frame(POWER, full=2000),
            r"[0-9]+ pixels are saturated \(2000 counts\); shorten the exposure",
        ),
        (
            lambda: frame(without(2, 3)),
            r"1 of 48 spots are missing .* others: \(2, 3\); check that all tones are on",
        ),
        (
            lambda: frame(0 * POWER),
            "no powers from its frame of the tweezers: (no lattice found: |.* spots are missing)",
        ),
    ],
    ids=["full scale", "plateau", "missing", "dark"],
)
@pytest.mark.parametrize("first", [True, False])
def test_a_frame_that_cannot_be_measured_is_refused(
    seen: Callable[[], Frame], message: str, first: bool
) -> None:
    spots = SpotPowers(GRID, "trap_camera")
    if not first:
        spots.fit(frame(POWER))
    with pytest.raises(DeviceError, match=message):
        spots.fit(seen())
