"""Measures the speed of rendering tone programs, compared with the paper's method and with plain numpy."""

from __future__ import annotations

import timeit
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.console.text import columns
from labseq.model import AxisTones, FrequencyCourse, SiteGrid, ToneProgram
from labseq.motion import Renderer, comb_sample_rate, tone_program, warm_rendering
from labseq.motion.render_reference import render_reference
from labseq.session.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.units import format_quantity

N_CHANNELS: Final = 2
CHUNK: Final = 1 << 18
"""Samples per chunk; all chunks are rendered into the same buffer, as by a streaming driver."""

STORED: Final = 1 << 21
"""Samples of each stored waveform: 84 MB in all."""

STORED_5: Final = "stored waveforms, 5 tones"
STORED_20: Final = "stored waveforms, 20 tones"
NUMPY_20: Final = "numpy, 20 tones"

Samples = NDArray[np.int16]

SITE_S: Final = 4.49e-6 / 0.130
SITES: Final = 5
"""Distance of each transport, in sites, about the mean of a plan."""


PLAN: Final = PlanRequest("random:20x20@75%", "compact:15x15", "psca", 7, seed=1)
"""A typical plan: 225 atoms in 20 x 20 sites, moved seven at a time."""


def bench_waveform(repeats: int = 5, *, announce: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """Measure rendering in two threads into reused buffers; the fastest of several repetitions counts.

    Args:
        repeats: Number of repetitions.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.

    Returns:
        JSON-ready: ``rows``, one for each kind of segment and for a plan, stored waveforms and numpy last,
        with samples of both channels per second, in 1e9; ``ratios`` of rendering times, whose goal is a
        minimum, or a maximum if ``at_most``.
    """
    from labseq.kernel import announcing, load_kernels

    moves = plan_moves(PLAN, announce=announce)
    grid, rate_hz = moves.grid, comb_sample_rate(moves.grid)
    with announcing(announce):
        warm_rendering()
        load_kernels()
        rows = [*_comb_rows(moves, rate_hz, repeats), *_other_ways(grid, rate_hz, repeats)]
    time_of = {row["name"]: 1.0 / row["gigasamples_per_s"] for row in rows}
    fast, stored, numpy = (time_of[name] for name in ("1 group, 20 tones", STORED_20, NUMPY_20))
    ratios = (
        ("20 tones over 5 tones", fast / time_of["1 group, 5 tones"], 1.3, True),
        ("stored waveforms over comb, 20 tones", stored / fast, 5.0, False),
        ("numpy over comb, 20 tones", numpy / fast, 100.0, False),
    )
    names = ("name", "value", "goal", "at_most")
    return {
        "rows": rows,
        "ratios": [dict(zip(names, ratio, strict=True)) for ratio in ratios],
        "sample_rate_hz": rate_hz,
        "repeats": repeats,
    }


def _comb_rows(moves: PlannedMoves, rate_hz: float, repeats: int) -> Generator[dict[str, Any]]:
    grid = moves.grid
    bare = replace(moves.motion, overhead_per_batch_s=0.0)
    plan = tone_program(moves.plan, grid, bare)
    jerk = uniform_program(grid, 7, (1,), FrequencyCourse.MINIMUM_JERK)
    for name, program, goal in (
        ("1 group, 5 tones", uniform_program(grid, 5, (1,)), 3.0),
        ("1 group, 20 tones", uniform_program(grid, 20, (1,)), 3.0),
        ("3 groups, 7 tones", uniform_program(grid, 7, (1, 0, -1)), 2.0),
        ("3 groups, 20 tones", uniform_program(grid, 20, (1, 0, -1)), 2.0),
        ("minimum jerk, 7 tones", jerk, 1.0),
        ("plan 20 -> 15 at 7, pauses left out", plan, 2.5),
    ):
        renderer = Renderer(program, rate_hz)
        taken_s = _best(partial(render_all, renderer), repeats)
        yield _row(name, renderer.n_samples, rate_hz, taken_s, goal)


def _other_ways(grid: SiteGrid, rate_hz: float, repeats: int) -> Generator[dict[str, Any]]:
    stored = stored_waveforms(grid, rate_hz)
    for name, n_tones in ((STORED_5, 5), (STORED_20, 20)):
        yield _row(name, STORED, rate_hz, _best(partial(sum_all_stored, stored, n_tones), repeats))
    n, program = CHUNK // 8, uniform_program(grid, 20, (1,))
    yield _row(NUMPY_20, n, rate_hz, _best(partial(render_reference, program, rate_hz, 0, n), 1))


def uniform_program(
    grid: SiteGrid, n_tones: int, directions: tuple[int, ...], course: int = FrequencyCourse.LINEAR
) -> ToneProgram:
    """A program of 100 transports: column tones that move in given directions, a fixed row tone.

    They move back and forth, so that the tones stay in the band.
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
    """Render a whole program in two threads, each into its own buffer and half of the time."""

    def render(out: Samples, at: int) -> None:
        for channel in range(N_CHANNELS):
            renderer.write(channel, at, out)

    _in_two_threads(render, renderer.n_samples)


def _in_two_threads(render: Callable[[Samples, int], None], n_samples: int) -> None:
    """Render chunks that start at a sample into a buffer of each thread."""

    def work(start: int, stop: int) -> None:
        out = np.empty(CHUNK, np.int16)
        for at in range(start, stop, CHUNK):
            render(out[: min(CHUNK, stop - at)], at)

    half = n_samples // 2
    with ThreadPoolExecutor(1) as other:
        later = other.submit(work, half, n_samples)
        work(0, half)
        later.result()


def stored_waveforms(grid: SiteGrid, sample_rate_hz: float) -> NDArray[np.int16]:
    """The stored waveforms of the paper's method, one for each tone, at a twentieth of full scale.

    A waveform for each tone, each kind of segment and each distance does not fit into the
    processor's caches, and neither do these.

    Returns:
        int16 (n_sites, STORED).
    """
    period = round(sample_rate_hz / float(np.diff(grid.column_frequency_hz[:2])[0]))
    cycles = np.outer(grid.column_frequency_hz / sample_rate_hz, np.arange(period)) % 1.0
    waves = np.rint(32767 / 20 * np.cos(2 * np.pi * cycles)).astype(np.int16)
    return np.tile(waves, (1, -(-STORED // period)))[:, :STORED].copy()


def sum_all_stored(stored: NDArray[np.int16], n_tones: int) -> None:
    """The paper's method: sum ``n_tones`` stored waveforms for one channel, and take one for the other."""
    from labseq.motion.render_direct_kernels import sum_stored

    def add(out: Samples, at: int) -> None:
        for picked in (np.arange(1), np.arange(n_tones)):
            sum_stored(stored, picked, at, out)

    _in_two_threads(add, STORED)


def _best(call: Callable[[], object], repeats: int) -> float:
    """Shortest duration of some calls, in seconds."""
    return min(timeit.repeat(call, number=1, repeat=repeats))


def _row(
    name: str, n_samples: int, sample_rate_hz: float, taken_s: float, goal: float | None = None
) -> dict[str, Any]:
    return {
        "name": name,
        "gigasamples_per_s": N_CHANNELS * n_samples / taken_s / 1e9,
        "playing_over_rendering": n_samples / sample_rate_hz / taken_s,
        "goal": goal,
    }


def report_text(report: Mapping[str, Any]) -> list[str]:
    """A table of the measurements, a table of the ratios of rendering times, and their extent."""
    rows = [("two channels", "Gsample/s", "playing/rendering", "goal")]
    for row in report["rows"]:
        goal = "-" if row["goal"] is None else f">= {row['goal']:g}"
        speed, ratio = row["gigasamples_per_s"], row["playing_over_rendering"]
        rows.append((row["name"], f"{speed:.3g}", f"{ratio:.3g}", goal))
    ratios = [("rendering times", "ratio", "goal")]
    for ratio in report["ratios"]:
        sign = "<=" if ratio["at_most"] else ">="
        ratios.append((ratio["name"], f"{ratio['value']:.3g}", f"{sign} {ratio['goal']:g}"))
    rate = format_quantity(report["sample_rate_hz"], "frequency")
    extent = f"{rate}, two threads; the best of {report['repeats']}"
    return [*columns(rows, right=(1, 2, 3)), "", *columns(ratios, right=(1, 2)), "", extent]
