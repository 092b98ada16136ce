"""What passes between a frame in memory and the first samples, part by part, called directly.

``labseq bench latency`` measures the same as a run calls it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.model import ToneProgram
from labseq.motion import check_plan, tone_program
from labseq.motion.rendering import Renderer, comb_sample_rate
from labseq.plugin import Context, DepthRamp, Frame, MotionSpec, RandomStream, SiteGrid, TargetPattern

CHUNK = 1 << 15  # samples per channel that a stream needs first
GRID = SiteGrid()
RATE_HZ = comb_sample_rate(GRID)


class Case:
    """A frame, and all that turns it into samples."""

    def __init__(self, dop: int, motion: MotionSpec) -> None:
        self.dop, self.motion = dop, motion
        fill = np.zeros(GRID.shape, np.bool_)
        fill[2:17, 2:17] = True
        self.target = TargetPattern(fill, np.zeros_like(fill))
        context = Context(grid=GRID, motion=motion)
        self.planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop), context)
        self.detector = ThresholdDetector(ThresholdSettings(), Context("detector", GRID))
        self.frame = take_frame()
        self.out = np.empty((2, CHUNK), np.int16)

    def program(self) -> ToneProgram:
        occupancy, *_ = self.detector.detect(self.frame)
        plan = self.planner.plan(occupancy, self.target)
        check_plan(plan, occupancy, self.target, self.dop, GRID, self.motion)
        return tone_program(plan, GRID, self.motion)

    def first_chunk(self) -> Renderer:
        renderer = Renderer(self.program(), RATE_HZ)
        for channel, samples in enumerate(self.out):
            renderer.write(channel, 0, samples)
        return renderer


def take_frame() -> Frame:
    random = RandomStream(0)
    world = VirtualSimulation(SimulationSettings(), Context("simulation", GRID, random=random))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    random.begin_shot(0, 0)
    world.begin_shot()
    world.load(0.0, 0.5)
    return world.expose(1.0, 45e-3)


@pytest.mark.parametrize("dop", [7, 15])
def test_from_a_frame_to_the_first_chunk(benchmark: Any, dop: int) -> None:
    case = Case(dop, MotionSpec(overhead_per_batch_s=0.0))  # else the first chunk would be silent
    case.first_chunk()
    renderer = benchmark(case.first_chunk)
    assert case.out.any()
    assert renderer.n_samples > CHUNK


@pytest.mark.parametrize("rate_hz", [RATE_HZ, 625e6])
def test_a_look_at_a_program(benchmark: Any, rate_hz: float) -> None:
    program = Case(7, MotionSpec()).program()
    assert benchmark(Renderer, program, rate_hz).n_samples > CHUNK


@pytest.mark.parametrize("dop", [7, 15])
def test_a_whole_program(benchmark: Any, dop: int) -> None:
    program = Case(dop, MotionSpec()).program()
    benchmark.extra_info["playing_s"] = program.total_duration_s

    out = np.empty(CHUNK, np.int16)

    def render_it() -> int:
        renderer = Renderer(program, RATE_HZ)
        for start in range(0, renderer.n_samples, CHUNK):
            for channel in (0, 1):
                renderer.write(channel, start, out)
        return renderer.n_samples

    assert benchmark(render_it) >= int(program.total_duration_s * RATE_HZ)
