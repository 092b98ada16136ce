"""Benchmarks: a frame, its detection, and a program of 40 batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labseq_virtual.settings import WorldSettings
from labseq_virtual.transport import Transport
from labseq_virtual.world import World

from labseq import Context, DepthRamp, Plan, RandomStream, SiteGrid, tone_program
from labseq.config.detectors import ThresholdSettings
from labseq.imaging import ThresholdDetector

GRID = SiteGrid()


@pytest.fixture
def world() -> World:
    """A world with 75 % of 400 atoms, at 1 s."""
    random = RandomStream(0)
    world = World(WorldSettings(), Context("simulation", GRID, random=random))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    random.begin_shot(0, 0)
    world.begin_shot()
    world.load(0.0, 0.5)
    return world


def test_a_frame_of_512_x_512(benchmark: Any, world: World) -> None:
    """Goal: under 8 ms."""
    times_s = iter(range(1, 1_000_000))
    frame = benchmark(lambda: world.expose(float(next(times_s)), 45e-3))
    assert frame.image.shape == (512, 512)


def test_detecting_400_sites(benchmark: Any, world: World) -> None:
    """Goal: under 100 us."""
    detector = ThresholdDetector(ThresholdSettings(), Context("detector", GRID))
    frame = world.expose(1.0, 45e-3)
    occupancy, _ = benchmark(detector.detect, frame)
    assert abs(int(occupancy.sum()) - int(world.truth().sum())) < 10


def test_carrying_atoms_through_40_batches(benchmark: Any) -> None:
    """Goal: under 5 ms; rows and columns in turn, 7 tones each, with whatever collides."""
    batches = [_shift(line, along_row=line % 2 == 0) for line in range(20) for _ in range(2)]
    program = tone_program(Plan.from_batches(batches), grid=GRID)
    transport, rng = Transport(GRID, WorldSettings()), np.random.default_rng(0)
    occupied = rng.random(GRID.shape) < 0.75
    benchmark(lambda: transport.carry(occupied.copy(), program, program.n_segments, rng, 1.0))


def _shift(line: int, *, along_row: bool) -> tuple[Any, Any]:
    places = np.arange(0, 14, 2)
    before, after = (np.stack([np.full(7, line), p], axis=1) for p in (places, places + 5))
    return (before, after) if along_row else (before[:, ::-1], after[:, ::-1])
