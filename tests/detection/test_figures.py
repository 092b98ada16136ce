"""How well sites, thresholds and shifts are found: the figures of ``docs/explanation/finding-sites.md``.

``LABSEQ_FRAMES=40 pytest -s tests/detection/test_figures.py --numprocesses=0`` prints them.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

from labseq.detection.drift import measure_shift
from labseq.detection.lattice import find_lattice
from labseq.plugin import Context, DepthRamp, RandomStream, SiteGrid

from .drawn import drawn, seen_sites

N_DRAWS = int(os.environ.get("LABSEQ_FRAMES", "1"))
IN_SUITE = N_DRAWS == 1
"""Other tests of the suite hold the rest; without LABSEQ_FRAMES one figure of each kind is enough."""
SHAPE = (512, 512)


@pytest.mark.parametrize(
    ("n_frames", "most"), [(50, 0.1)] if IN_SUITE else [(20, 0.2), (50, 0.1), (200, 0.06)]
)
def test_sites_of_a_hidden_lattice(n_frames: int, most: float) -> None:
    """2 degrees, 10 % stretch, shear, barrel, a hidden offset, hot pixels, dark sites."""
    off = list[np.ndarray]()
    for seed in range(N_DRAWS):
        rng = np.random.default_rng(1000 + seed)
        centre = (250 + rng.uniform(-15, 15), 255 + rng.uniform(-15, 15))
        barrel = rng.uniform(-0.03, 0.03)
        sites = seen_sites(SiteGrid(), 12.8, 2.0, 1.1, rng.uniform(-0.02, 0.02), barrel, centre)
        image = drawn(sites, SHAPE, 1.2, rng, n_frames=n_frames, gradient=0.5, hot=40, dead=6)
        found = find_lattice(image, SiteGrid())
        off.append(np.hypot(*np.moveaxis(found.positions_px - sites, -1, 0)))
        assert found.n_sites_found >= 392
        assert found.spot_px == pytest.approx(1.2, abs=0.05)
    worst = [float(one.max()) for one in off]
    rms = float(np.sqrt(np.mean(np.stack(off) ** 2)))
    figures = f"r.m.s. {rms:.3f}, worst site {np.median(worst):.3f}, of all {max(worst):.3f} px"
    print(f"\n{n_frames:4d} frames: {figures}")
    assert np.median(worst) < most


@pytest.mark.parametrize("loading", [0.1] if IN_SUITE else [0.1, 0.6, 0.97])
def test_shifts_on_one_frame(loading: float) -> None:
    sites, off = (
        seen_sites(SiteGrid(), 12.8, 3.0, 1.05, barrel=0.02, centre=(250.0, 250.0)),
        list[np.ndarray](),
    )
    for seed in range(max(N_DRAWS, 6)):
        rng = np.random.default_rng(2000 + seed)
        shift = rng.uniform(-1.4, 1.4, 2)
        image = drawn(sites + shift, SHAPE, 1.2, rng, n_frames=1, loading=loading, hot=10)
        dy, dx, _ = measure_shift(image.clip(0, 65535).astype(np.uint16), sites, 1.2)
        off.append(np.array([dy, dx]) - shift)
    spread, bias = np.stack(off).std(), np.abs(np.mean(off, axis=0)).max()
    print(f"\nloading {loading:.2f}: r.m.s. {spread:.3f}, mean {bias:.3f} px")
    assert spread < 0.2


def test_sites_of_the_virtual_lab() -> None:
    """50 frames with a hidden offset and angle; the truth is the simulation's own."""
    random, grid = RandomStream(7), SiteGrid()
    image = {"centre_px": (247.3, 261.8), "angle": np.deg2rad(2.0)}
    simulation = VirtualSimulation(
        SimulationSettings.model_validate({"image": image}), Context("simulation", grid, random=random)
    )
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    frames: list[NDArray[np.uint16]] = []
    for shot in range(50):
        random.begin_shot(shot, 0)
        simulation.begin_shot()
        simulation.load(0.0, 0.5)
        frames.append(simulation.expose(0.5, 45e-3).image)
    found = find_lattice(np.mean(frames, axis=0), grid)
    off = found.positions_px.mean(axis=(0, 1)) - (247.3, 261.8)
    print(f"\nvirtual lab: angle {np.rad2deg(found.angle_rad):.3f} degrees, centre off by {off.round(4)} px")
    assert np.abs(off).max() < 0.02
    assert np.rad2deg(found.angle_rad) == pytest.approx(2.0, abs=0.02)
    assert found.stretch < 1.002
