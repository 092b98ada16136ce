"""Measures the speed of rendering tone programs."""

from __future__ import annotations

import timeit
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.console.report import Column, table
from labseq.model import AxisTones, FrequencyCourse, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.motion.rendering import Renderer, comb_sample_rate, warm_rendering
from labseq.units import format_quantity

N_CHANNELS: Final = 2
CHUNK: Final = 1 << 18
"""Samples per chunk. All chunks are rendered into the same buffer, as by a streaming driver."""

Samples = NDArray[np.int16]

SITES: Final = 5
"""Distance of each transport, in sites. About the mean of a plan."""


PLAN: Final = PlanRequest("random:20x20@75%", "{pattern: compact, rows: 15, cols: 15}", "psca", 7, seed=1)
"""A typical plan: 225 atoms in 20 x 20 sites, moved seven at a time."""


@dataclass(frozen=True, slots=True)
class RenderedProgram:
    """The speed of rendering one program.

    Attributes:
        gigasamples_per_s: Samples of both channels per second, in 1e9.
        playing_over_rendering: Playing time divided by rendering time.
    """

    name: str
    gigasamples_per_s: float
    playing_over_rendering: float


PROGRAMS: Final[Sequence[Column[RenderedProgram]]] = (
    Column("two channels", lambda program: program.name),
    Column("Gsample/s", lambda program: f"{program.gigasamples_per_s:.3g}", right=True),
    Column("playing/rendering", lambda program: f"{program.playing_over_rendering:.3g}", right=True),
)


@dataclass(frozen=True, slots=True)
class RenderingReport:
    """The speed of rendering, with one row for each kind of segment and one for a plan."""

    rows: Sequence[RenderedProgram]
    sample_rate_hz: float
    repeats: int

    def as_text(self) -> list[str]:
        """A table of the measurements, and the number of repetitions."""
        rate = format_quantity(self.sample_rate_hz, "frequency")
        return [
            *table(self.rows, PROGRAMS),
            "",
            f"{rate}, two threads, the best of {self.repeats}",
            "above 1 the computer renders faster than the card plays",
        ]


def bench_waveform(
    repeats: int = 5, *, announce: Callable[[float], None] = lambda _: None
) -> RenderingReport:
    """Measure rendering in two threads into reused buffers. The fastest of several repetitions counts.

    Args:
        repeats: Number of repetitions.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.
    """
    from labseq.kernels.kernel import announcing, load_kernels

    moves = plan_moves(PLAN, announce=announce)
    rate_hz = comb_sample_rate(moves.grid)
    with announcing(announce):
        warm_rendering()
        load_kernels()
        rows = list(_rows(moves, rate_hz, repeats))
    return RenderingReport(rows, rate_hz, repeats)


def _rows(moves: PlannedMoves, rate_hz: float, repeats: int) -> Generator[RenderedProgram]:
    grid = moves.grid
    # without pauses, which need no rendering
    motion = replace(moves.motion, overhead_per_batch_s=0.0)
    plan = tone_program(moves.plan, grid, motion)
    jerk = uniform_program(grid, 7, (1,), FrequencyCourse.MINIMUM_JERK)
    for name, program in (
        ("1 group, 5 tones", uniform_program(grid, 5, (1,))),
        ("1 group, 20 tones", uniform_program(grid, 20, (1,))),
        ("3 groups, 7 tones", uniform_program(grid, 7, (1, 0, -1))),
        ("3 groups, 20 tones", uniform_program(grid, 20, (1, 0, -1))),
        ("minimum jerk, 7 tones", jerk),
        ("plan 20 -> 15 at 7, pauses left out", plan),
    ):
        renderer = Renderer(program, rate_hz)
        # the fastest, because other work on the computer only makes it slower
        taken_s = min(timeit.repeat(partial(render_all, renderer), number=1, repeat=repeats))
        yield RenderedProgram(
            name=name,
            gigasamples_per_s=N_CHANNELS * renderer.n_samples / taken_s / 1e9,
            playing_over_rendering=renderer.n_samples / rate_hz / taken_s,
        )


def uniform_program(
    grid: SiteGrid, n_tones: int, directions: tuple[int, ...], course: int = FrequencyCourse.LINEAR
) -> ToneProgram:
    """A program of 100 transports, with a fixed row tone and column tones that move in given directions.

    They move back and forth, so that the tones stay in the band.
    """
    n_segments = 100
    hz = grid.column_frequency_hz[:n_tones]
    step_hz = float(grid.column_frequency_hz[1] - grid.column_frequency_hz[0])
    travel_hz = SITES * step_hz * np.array([directions[k % len(directions)] for k in range(n_tones)])
    forth = np.arange(n_segments)[:, None] % 2 == 0
    start_hz = np.where(forth, hz, hz + travel_hz).ravel()
    end_hz = np.where(forth, hz + travel_hz, hz).ravel()
    phase_rad = np.random.default_rng(0).uniform(0, 2 * np.pi, start_hz.size)
    amplitude = np.full(start_hz.size, 1 / 20)
    offsets = np.arange(n_segments + 1, dtype=np.int32)
    column = AxisTones(offsets * n_tones, start_hz, end_hz, amplitude, amplitude, phase_rad)
    row_hz = np.full(n_segments, grid.row_frequency_hz[0])
    row_amplitude = np.full(n_segments, 1 / 20)
    row = AxisTones(offsets, row_hz, row_hz, row_amplitude, row_amplitude, np.zeros(n_segments))
    kinds, batches = np.full(n_segments, 2, np.int8), np.arange(n_segments, dtype=np.int32)
    # at 0.13 m/s over sites 4.49 um apart, as in the bench profiles
    duration_s = np.full(n_segments, SITES * 4.49e-6 / 0.130)
    return ToneProgram(row, column, duration_s, kinds, batches, np.full(n_segments, course, np.int8))


def render_all(renderer: Renderer) -> None:
    """Render a whole program in two threads, each into its own buffer and half of the time."""

    def render(out: Samples, at: int) -> None:
        for channel in range(N_CHANNELS):
            renderer.write(channel, at, out)

    in_two_threads(render, renderer.n_samples)


def in_two_threads(render: Callable[[Samples, int], None], n_samples: int) -> None:
    """Render chunks that start at a sample into a buffer of each thread."""

    def work(start: int, stop: int) -> None:
        out = np.empty(CHUNK, np.int16)
        for at in range(start, stop, CHUNK):
            render(out[: min(CHUNK, stop - at)], at)

    # the kernels release Python's lock
    half = n_samples // 2
    with ThreadPoolExecutor(1) as executor:
        second_half = executor.submit(work, half, n_samples)
        work(0, half)
        second_half.result()
