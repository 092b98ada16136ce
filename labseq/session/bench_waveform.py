"""How fast tone programs become samples, beside the paper's way and plain numpy."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import AxisTones, FrequencyCourse, MotionSpec, Plan, SiteGrid, ToneProgram
from labseq.motion import Renderer, comb_sample_rate, tone_program
from labseq.motion.render_reference import render_reference

N_CHANNELS: Final = 2
CHUNK: Final = 1 << 18
"""Samples that are rendered into the same buffer again and again, as a streaming driver does."""

STORED: Final = 1 << 21
"""Samples of each stored waveform: 84 MB in all."""

SITE_S: Final = 4.49e-6 / 0.130
SITES: Final = 5
"""Sites per transport of the programs that stand for one kind of segment: about a plan's mean."""


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement.

    Attributes:
        name: What was rendered, and how.
        gigasamples_per_s: Samples of both channels per second, in 1e9.
        playing_over_rendering: Playing time over rendering time.
    """

    name: str
    gigasamples_per_s: float
    playing_over_rendering: float


def bench_waveform(plan: Plan | None = None, repeats: int = 5, grid: SiteGrid | None = None) -> list[Row]:
    """Measure rendering into buffers that are used again, two threads, the best of some repeats.

    Args:
        plan: A plan whose program is measured too, pauses left out.
        repeats: How often everything is rendered.
        grid: The grid of sites; by default the paper's.

    Returns:
        A row for each kind of segment and for the plan; the stored-waveform way and numpy last.
    """
    grid = grid or SiteGrid()
    rate_hz = comb_sample_rate(grid)
    programs = {
        "1 group, 5 tones": uniform_program(grid, 5, (1,)),
        "1 group, 20 tones": uniform_program(grid, 20, (1,)),
        "3 groups, 7 tones": uniform_program(grid, 7, (1, 0, -1)),
        "3 groups, 20 tones": uniform_program(grid, 20, (1, 0, -1)),
        "minimum jerk, 7 tones": uniform_program(grid, 7, (1,), FrequencyCourse.MINIMUM_JERK),
    }
    if plan is not None:
        programs["plan"] = tone_program(plan, grid, MotionSpec(overhead_per_batch_s=0.0))
    rows: list[Row] = []
    for name, program in programs.items():
        renderer = Renderer(program, rate_hz)
        rows.append(_row(name, renderer.n_samples, rate_hz, _best(partial(render_all, renderer), repeats)))
    stored = stored_waveforms(grid, rate_hz)
    for n_tones in (5, 20):
        taken_s = _best(partial(sum_all_stored, stored, n_tones), repeats)
        rows.append(_row(f"stored waveforms, {n_tones} tones", STORED, rate_hz, taken_s))
    n = CHUNK // 8
    taken_s = _best(partial(render_reference, programs["1 group, 20 tones"], rate_hz, 0, n), 1)
    rows.append(_row("numpy, 20 tones", n, rate_hz, taken_s))
    return rows


def uniform_program(
    grid: SiteGrid, n_tones: int, directions: tuple[int, ...], course: int = FrequencyCourse.LINEAR
) -> ToneProgram:
    """A program of 100 transports: column tones that move in given directions, a row tone that stands.

    They go there and back, so that the tones stay in the band.
    """
    n_segments = 100
    hz = grid.column_frequency_hz[:n_tones]
    step_hz = float(grid.column_frequency_hz[1] - grid.column_frequency_hz[0])
    way_hz = SITES * step_hz * np.array([directions[k % len(directions)] for k in range(n_tones)])
    forth = np.arange(n_segments)[:, None] % 2 == 0
    start_hz = np.where(forth, hz, hz + way_hz).ravel()
    end_hz = np.where(forth, hz + way_hz, hz).ravel()
    phase_rad = np.random.default_rng(0).uniform(0, 2 * np.pi, start_hz.size)
    amplitude = np.full(start_hz.size, 1 / 20)
    offsets = np.arange(n_segments + 1, dtype=np.int32)
    column = AxisTones(offsets * n_tones, start_hz, end_hz, amplitude, amplitude, phase_rad)
    row_hz = np.full(n_segments, grid.row_frequency_hz[0])
    one = np.full(n_segments, 1 / 20)
    row = AxisTones(offsets, row_hz, row_hz, one, one, np.zeros(n_segments))
    kinds, batches = np.full(n_segments, 2, np.int8), np.arange(n_segments, dtype=np.int32)
    duration_s = np.full(n_segments, SITES * SITE_S)
    return ToneProgram(row, column, duration_s, kinds, batches, np.full(n_segments, course, np.int8))


def render_all(renderer: Renderer) -> None:
    """Render a whole program in two threads, each into a buffer of its own, half of the time each."""

    def work(worker: int, start: int, stop: int) -> None:
        out = np.empty(CHUNK, np.int16)
        for at in range(start, stop, CHUNK):
            for channel in range(N_CHANNELS):
                renderer.write(channel, at, out[: min(CHUNK, stop - at)], worker)

    half = renderer.n_samples // 2
    with ThreadPoolExecutor(1) as other:
        later = other.submit(work, 1, half, renderer.n_samples)
        work(0, 0, half)
        later.result()


def stored_waveforms(grid: SiteGrid, sample_rate_hz: float) -> NDArray[np.int16]:
    """The paper's store: waveforms of each tone, at a twentieth of full scale.

    A waveform for each tone, each kind of segment and each distance does not fit into the
    processor's caches; nor does this.

    Returns:
        int16 (n_sites, STORED).
    """
    period = round(sample_rate_hz / float(np.diff(grid.column_frequency_hz[:2])[0]))
    cycles = np.outer(grid.column_frequency_hz / sample_rate_hz, np.arange(period)) % 1.0
    waves = np.rint(32767 / 20 * np.cos(2 * np.pi * cycles)).astype(np.int16)
    return np.tile(waves, (1, -(-STORED // period)))[:, :STORED].copy()


def sum_all_stored(stored: NDArray[np.int16], n_tones: int) -> None:
    """The paper's way: pick ``n_tones`` waveforms and sum them, and one for the other channel.

    As in :func:`render_all`, two threads do half of the time each, into the same buffers.
    """
    from labseq.kernels.render_stored import sum_stored

    def work(start: int, stop: int) -> None:
        out = np.empty(CHUNK, np.int16)
        for at in range(start, stop, CHUNK):
            for picked in (np.arange(1), np.arange(n_tones)):
                sum_stored(stored, picked, at, out[: min(CHUNK, stop - at)])

    half = STORED // 2
    with ThreadPoolExecutor(1) as other:
        later = other.submit(work, half, STORED)
        work(0, half)
        later.result()


def _best(call: Callable[[], object], repeats: int) -> float:
    """Shortest duration of some calls, in seconds."""
    taken: list[float] = []
    for _ in range(repeats):
        start_s = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start_s)
    return min(taken)


def _row(name: str, n_samples: int, sample_rate_hz: float, taken_s: float) -> Row:
    return Row(name, N_CHANNELS * n_samples / taken_s / 1e9, n_samples / sample_rate_hz / taken_s)
