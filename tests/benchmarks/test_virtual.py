"""Benchmarks: a frame, its detection, and a program of 40 batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import Flights, RunningProgram
from labseq_virtual.images import Images
from labseq_virtual.settings import ImageSettings, SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.plugin import Context, DepthRamp, MotionSpec, Plan, RandomStream, SiteGrid
from labseq.plugin.motion import tone_program

GRID = SiteGrid()


@pytest.fixture
def world() -> VirtualSimulation:
    """A world with 75 % of 400 atoms, at 1 s."""
    random = RandomStream(0)
    world = VirtualSimulation(SimulationSettings(), Context("simulation", GRID, random=random))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    random.begin_shot(0, 0)
    world.begin_shot()
    world.load(0.0, 0.5)
    return world


@pytest.mark.parametrize("sensor", ["emccd", "qcmos"])
def test_a_frame_of_512_x_512(benchmark: Any, sensor: str) -> None:
    """Goal: under 8 ms, of 300 atoms; about as long as normal numbers for all pixels take."""
    benchmark.group = "frame"
    images = Images(ImageSettings.model_validate({"sensor": sensor}), GRID, 0)
    row, col = np.indices(GRID.shape).reshape(2, -1)[:, :300]
    images.warm()
    image = benchmark(images.take, row, col, np.ones(300), 45e-3, np.random.default_rng(0))
    assert image.shape == (512, 512)


def test_normal_numbers_for_each_pixel(benchmark: Any) -> None:
    """What drawing the read noise alone would take, for the ratio within one run."""
    benchmark.group = "frame"
    rng = np.random.default_rng(0)
    assert benchmark(rng.standard_normal, 512 * 512, np.float32).size == 512 * 512


def test_detecting_400_sites(benchmark: Any, world: VirtualSimulation) -> None:
    """Goal: under 100 us."""
    detector = ThresholdDetector(ThresholdSettings(), Context("detector", GRID))
    frame = world.expose(1.0, 45e-3)
    occupancy, *_ = benchmark(detector.detect, frame)
    assert abs(int(occupancy.sum()) - int(world.truth().sum())) < 10


def test_carrying_atoms_through_40_batches(benchmark: Any) -> None:
    """Goal: under 5 ms; rows and columns in turn, 7 tones each, with whatever collides."""
    batches = [_shift(line, along_row=line % 2 == 0) for line in range(20) for _ in range(2)]
    program = tone_program(Plan.from_batches(batches), grid=GRID)
    flights, rng = Flights(GRID, MotionSpec(), SimulationSettings()), np.random.default_rng(0)
    running, depth = RunningProgram(program, 0.0), np.ones(GRID.shape)
    occupied = rng.random(GRID.shape) < 0.75
    benchmark(lambda: flights.carry_program(Atoms(occupied.copy(), 15e-6), running, depth, rng))


def _shift(line: int, *, along_row: bool) -> tuple[Any, Any]:
    places = np.arange(0, 14, 2)
    before, after = (np.stack([np.full(7, line), p], axis=1) for p in (places, places + 5))
    return (before, after) if along_row else (before[:, ::-1], after[:, ::-1])
