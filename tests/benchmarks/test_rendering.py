"""Rendering 17 ms of playing time, beside the paper's way and plain numpy.

The goals are in ratios of one run: playing time over rendering time at least 3 with one
group of tones, 2 with three, 2.5 for a plan, also if it is returned whole; 20 tones at most
1.3 times 5 tones; 5 times the stored waveforms, 100 times numpy; the direct way in real time
for 7 tones; paths through lanes at least half as fast as lines.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pytest
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray

import labseq
from labseq.bench.rendering import Samples, in_two_threads, render_all, uniform_program
from labseq.kernels.kernel import const, kernel
from labseq.model import FrequencyCourse, MotionSpec, SiteGrid, TargetPattern, ToneProgram
from labseq.motion import tone_program
from labseq.motion.render_reference import render_reference
from labseq.motion.rendering import Renderer, comb_sample_rate
from labseq.roles import Context

GRID = SiteGrid()
RATE_HZ = comb_sample_rate(GRID)
STORED = 1 << 21
"""Samples of each stored waveform: 84 MB in all."""


def measure(benchmark: Any, program: ToneProgram) -> None:
    renderer = Renderer(program, RATE_HZ)
    benchmark.extra_info["playing_s"] = renderer.n_samples / RATE_HZ
    benchmark(render_all, renderer)


@pytest.mark.parametrize("n_tones", [5, 20])
@pytest.mark.parametrize("directions", [(0,), (1,), (1, 0, -1)])
def test_tones_on_the_comb(benchmark: Any, n_tones: int, directions: tuple[int, ...]) -> None:
    measure(benchmark, uniform_program(GRID, n_tones, directions))


@pytest.mark.parametrize("course", [FrequencyCourse.MINIMUM_JERK, FrequencyCourse.CONSTANT_JERK])
def test_seven_tones_the_direct_way(benchmark: Any, course: FrequencyCourse) -> None:
    measure(benchmark, uniform_program(GRID, 7, (1,), course))


def program_of_20_to_15(overhead_s: float, lanes: str = "") -> ToneProgram:
    fill = np.zeros(GRID.shape, np.bool_)
    fill[2:17, 2:17] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=7), Context(grid=GRID))
    if lanes:
        settings = GridSettings.model_validate({"degree_of_parallelism": 15, "lanes": lanes})
        planner = GridPlanner(settings, Context(grid=GRID))
    plan = planner.plan(np.random.default_rng(1).random(GRID.shape) < 0.75, target)
    return tone_program(plan, GRID, MotionSpec(overhead_per_batch_s=overhead_s))


@pytest.mark.parametrize("lanes", ["", "straight", "weaving"])
def test_a_plan_of_20_to_15(benchmark: Any, lanes: str) -> None:
    measure(benchmark, program_of_20_to_15(0.0, lanes))


@pytest.mark.parametrize("overhead_s", [0.0, 0.5e-3])
def test_a_whole_plan_in_one_array(benchmark: Any, overhead_s: float) -> None:
    program = program_of_20_to_15(overhead_s)
    benchmark.extra_info["playing_s"] = program.total_duration_s
    benchmark(labseq.render, program, RATE_HZ)


def stored_waveforms() -> Samples:
    """The stored waveforms of the paper's method, one for each tone, at a twentieth of full scale.

    A waveform for each tone, each kind of segment and each distance does not fit into the
    processor's caches, and neither do these.
    """
    period = round(RATE_HZ / float(np.diff(GRID.column_frequency_hz[:2])[0]))
    cycles = np.outer(GRID.column_frequency_hz / RATE_HZ, np.arange(period)) % 1.0
    waves = np.rint(32767 / 20 * np.cos(2 * np.pi * cycles)).astype(np.int16)
    return np.tile(waves, (1, -(-STORED // period)))[:, :STORED].copy()


STORED_BLOCK: Final = 4096


@kernel(f"void({const('int16', 2)}, int64[::1], int64, int16[::1])")
def sum_stored(
    stored: NDArray[np.int16], picked: NDArray[np.int64], first: int, out: NDArray[np.int16]
) -> None:
    """Sum the stored waveforms int16 (n_tones, n) that are picked, from sample ``first`` on.

    Works block by block, so that the sums stay in the fastest cache.
    """
    for start in range(0, len(out), STORED_BLOCK):
        part = out[start : start + STORED_BLOCK]
        part[:] = 0
        for k in picked:
            one = stored[k, first + start : first + start + STORED_BLOCK]
            for j in range(len(part)):
                part[j] += one[j]


@pytest.mark.parametrize("n_tones", [5, 20])
def test_stored_waveforms(benchmark: Any, n_tones: int) -> None:
    """The paper's method: sum stored waveforms for one channel, and take one for the other."""
    stored, n = stored_waveforms(), np.arange(1000)
    expected = 32767 / 20 * np.cos(2 * np.pi * GRID.column_frequency_hz[19] / RATE_HZ * n)
    assert np.abs(stored[19, :1000] - expected).max() <= 0.5001

    def add(out: Samples, at: int) -> None:
        for picked in (np.arange(1), np.arange(n_tones)):
            sum_stored(stored, picked, at, out)

    out = np.empty(8000, np.int16)
    sum_stored(stored, np.arange(n_tones), 700, out)
    assert np.array_equal(out, stored[:n_tones, 700:8700].sum(axis=0))
    benchmark.extra_info["playing_s"] = STORED / RATE_HZ
    benchmark(in_two_threads, add, STORED)


def test_numpy(benchmark: Any) -> None:
    program = uniform_program(GRID, 20, (1,))
    benchmark.extra_info["playing_s"] = 20_000 / RATE_HZ
    benchmark(render_reference, program, RATE_HZ, 0, 20_000)
