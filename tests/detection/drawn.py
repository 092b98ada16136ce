"""Frames drawn spot by spot, for tests that must not rest on a plugin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.detection.spots import spot_light
from labseq.model import SiteGrid

Floats = NDArray[np.float64]


def seen_sites(
    grid: SiteGrid,
    spacing: float,
    angle_deg: float = 0.0,
    stretch: float = 1.0,
    shear: float = 0.0,
    barrel: float = 0.0,
    centre: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Sites of a distorted grid in pixels; ``barrel`` is the relative change of the outermost radius."""
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    strain = np.array([[np.sqrt(stretch), shear], [0.0, 1 / np.sqrt(stretch)]])
    xy = grid.positions_m / grid.spacing_m @ (turn @ strain).T
    radius = (xy**2).sum(axis=-1, keepdims=True)
    xy *= spacing * (1 + barrel * radius / radius.max())
    return xy[..., ::-1] + np.array(centre)


def drawn(
    sites: Floats,
    shape: tuple[int, int],
    width: float,
    rng: np.random.Generator,
    *,
    n_frames: int = 50,
    loading: float = 0.6,
    photoelectrons: float = 60.0,
    background: float = 0.375,
    gradient: float = 0.0,
    hot: int = 0,
    dead: int = 0,
) -> Floats:
    """Mean of EMCCD frames, float64: 60 counts a photoelectron, exponential gain, offset 500."""
    places, region = sites.reshape(-1, 2), 2 * int(np.ceil(4 * width)) + 1
    lit = rng.binomial(n_frames, loading, len(places)).astype(np.float64)
    lit[rng.permutation(len(places))[:dead]] = 0.0
    corners = np.rint(places).astype(np.int64) - region // 2
    light = spot_light(places, corners, region, width) * photoelectrons * lit[:, None, None]
    y, x = (corners[:, axis, None] + region + np.arange(region) for axis in (0, 1))
    mean = np.zeros((shape[0] + 2 * region, shape[1] + 2 * region))
    np.add.at(mean, (y[:, :, None], x[:, None, :]), light)
    mean = mean[region:-region, region:-region]
    down, right = np.indices(shape)
    mean = mean + n_frames * background * (1 + gradient * (down / shape[0] + right / shape[1]))
    electrons = rng.poisson(mean)
    signal = 60 * rng.gamma(np.maximum(electrons, 1e-9)) * (electrons > 0)
    image = 500 + (signal + rng.normal(0, 16 * np.sqrt(n_frames), shape)) / n_frames
    image[rng.integers(0, shape[0], hot), rng.integers(0, shape[1], hot)] += rng.uniform(500, 20_000, hot)
    return image
