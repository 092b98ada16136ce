"""Rendered samples against the reference; programs that cannot be rendered."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

import labseq
from labseq.errors import LimitError
from labseq.model import Batch, FrequencyCourse, MotionSpec, Plan, SiteGrid, TonePaths, ToneProgram
from labseq.motion import tone_program
from labseq.motion.render_reference import render_reference
from labseq.motion.rendering import MAX_WORKSPACES, Renderer, RenderPath, comb_sample_rate, render

from .programs import STEP_HZ, Segment, program_of, site

SILENT, COMB, BLENDED, DIRECT = RenderPath
COMB_HZ = 624e6
LIMIT = 0.51


def comb(n: int, start_hz: float, step_hz: float) -> NDArray[np.float64]:
    return (start_hz + step_hz * np.arange(n)).astype(np.float64)


def path_of(program: ToneProgram, sample_rate_hz: float = COMB_HZ) -> list[int]:
    return Renderer(program, sample_rate_hz).path[0].tolist()


def check(program: ToneProgram, sample_rate_hz: float = COMB_HZ) -> NDArray[np.int16]:
    """Render, and compare every sample with the definition."""
    samples = render(program, sample_rate_hz).samples
    expected = render_reference(program, sample_rate_hz)
    assert samples.shape == expected.shape
    assert np.abs(samples - expected).max(initial=0.0) <= LIMIT
    return samples


def move(n: int, by: list[int], duration_s: float = 34.538e-6, amplitude: float | None = None) -> Segment:
    a = amplitude or 1 / n
    rng = np.random.default_rng(n)
    ends = [by[k % len(by)] for k in range(n)]
    return duration_s, [(site(k), site(k + ends[k]), a, a, rng.uniform(0, 6)) for k in range(n)]


@pytest.mark.parametrize("sample_rate_hz", [COMB_HZ, 625e6, 500_000_008.0])
@pytest.mark.parametrize(("n", "by"), [(1, [1]), (7, [0]), (7, [-1, 0]), (20, [1, -1, 0])])
def test_every_sample_of_a_comb_is_right(n: int, by: list[int], sample_rate_hz: float) -> None:
    check(program_of((0.1e-6, []), move(n, by)), sample_rate_hz)


@pytest.mark.parametrize("n", [1, 20])
@pytest.mark.parametrize("course", FrequencyCourse)
def test_full_scale_is_reached_and_not_exceeded(n: int, course: int) -> None:
    aligned = [(site(k), site(k + 5), 1 / n, 1 / n, 0.0) for k in range(n)]
    samples = check(program_of((173e-6, aligned), course=course))
    assert samples.max() >= 32766
    assert samples.min() >= -32767


@pytest.mark.parametrize("course", [FrequencyCourse.MINIMUM_JERK, FrequencyCourse.CONSTANT_JERK])
@pytest.mark.parametrize("sites", [1, 19])
def test_jerk_profiles_go_the_direct_way(course: int, sites: int) -> None:
    program = program_of(move(7, [sites, -1, 0], 34.538e-6 * sites), course=course)
    assert path_of(program) == [DIRECT]
    check(program)


def test_tones_off_the_comb_go_the_direct_way() -> None:
    rng = np.random.default_rng(0)
    tones = [(site(k) + 20e3 * rng.normal(), site(k + 2), 0.05, 0.05, 1.0) for k in range(12)]
    program = program_of(move(12, [1]), (69e-6, tones))
    assert path_of(program)[1] == DIRECT
    check(program)


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (1.0, 0.0), (0.5, 1.0)])
@pytest.mark.parametrize("off_hz", [0.0, 5e3])
def test_ramps_are_linear_in_depth(start: float, end: float, off_hz: float) -> None:
    tones = [(site(k) + off_hz * k**2, site(k) + off_hz * k**2, start / 7, end / 7, k) for k in range(7)]
    for duration_s in (60e-6, 60.0007e-6):
        program = program_of((1.3e-9, []), (duration_s, tones))
        assert path_of(program)[1] == (DIRECT if off_hz else COMB)
        check(program)


def test_amplitudes_that_change_differently_are_blended_or_else_rendered_directly() -> None:
    rng = np.random.default_rng(1)
    before, after = 0.045 * (1 + 0.02 * rng.normal(size=(2, 20)))
    tones = [(site(k), site(k + 1), before[k], after[k], k) for k in range(20)]
    program = program_of((34.538e-6, tones))
    assert path_of(program) == [BLENDED]
    check(program)
    tones = [(site(k), site(k + 1), 0.05 * (k % 2), 0.04, k) for k in range(20)]
    program = program_of((34.538e-6, tones))
    assert path_of(program) == [DIRECT]
    check(program)


@pytest.mark.parametrize("n_moving", [20, 10])
def test_tones_whose_ways_differ_a_little_are_blended(n_moving: int) -> None:
    tones = [(site(k), site(k + (k < n_moving)) + 2.0 * k, 0.05, 0.05, k) for k in range(20)]
    program = program_of((34.538e-6, tones))
    assert path_of(program) == [BLENDED]
    check(program)


def test_a_sample_rate_that_misses_the_comb_by_a_clock_step_is_made_up_for() -> None:
    step_hz = 1_623_457.1
    grid = SiteGrid(row_frequency_hz=comb(20, 100e6, step_hz), column_frequency_hz=comb(20, 90e6, step_hz))
    rate_hz = comb_sample_rate(grid)
    assert rate_hz % 8 == 0
    assert rate_hz != round(rate_hz / step_hz) * step_hz
    plan = Plan.from_batches(
        [Batch(np.array([[0, k] for k in range(9)]), np.array([[0, k + 3] for k in range(9)]))]
    )
    program = tone_program(plan, grid, MotionSpec(overhead_per_batch_s=1e-6))
    assert set(Renderer(program, rate_hz).path[1].tolist()) == {SILENT, COMB, BLENDED} - {COMB}
    check(program, rate_hz)


def weaving() -> TonePaths:
    """Columns that go up, that wait and that go down in a lane, and rows that are dropped off in turn.

    All swing to and fro on their way.
    """
    parts = np.arange(1, 17)
    swing = np.where(parts % 4, 0.11 * np.sin(np.pi * parts / 4), 0.0)
    ways = [parts / 8 - swing / 2, swing, np.clip(parts - 4, 0, 8) / -8 + swing]
    column = 0.5 + np.array([1.0, 4.0, 7.0, 10.0]) + np.array([ways[0], ways[0], ways[1], ways[2]]).T
    row = 0.5 + np.array([0.0, 2.0, 5.0]) + swing[:, None]
    column = np.vstack(
        [[1, 4, 7, 10], [1.5, 4.5, 7.5, 10.5], column, [3, 6, 7, 9], [3.5, 6.5, 7.5, 9.5], [3, 6, 7, 9]]
    )
    row = np.vstack([[0, 2, 5], [0.5, 2.5, 5.5], row, [0, 2.5, 5.5], [0, 2.5, 5.5], [0, 2, 5]])
    return TonePaths(row, column, np.array([18, 20, 20]))


@pytest.mark.parametrize("sample_rate_hz", [COMB_HZ, 625e6])
@pytest.mark.parametrize("uneven", [False, True])
def test_paths_through_lanes_are_rendered_in_groups(uneven: bool, sample_rate_hz: float) -> None:
    moves = np.array([[0, 1]]), np.array([[0, 3]])
    plan = Plan.from_batches([Batch(*moves, tones=weaving())] * 2)
    amplitudes = tuple(0.045 + 0.002 * (np.arange(20) % 3)) if uneven else ()
    motion = MotionSpec(overhead_per_batch_s=1e-6, rf=replace(MotionSpec().rf, column_amplitudes=amplitudes))
    program = tone_program(plan, SiteGrid(), motion)
    paths = Renderer(program, sample_rate_hz).path
    assert set(paths[0]) == {SILENT, COMB}
    assert set(paths[1]) == ({SILENT, COMB, DIRECT} if uneven else {SILENT, COMB})  # groups are small
    check(program, sample_rate_hz)


TONE = st.tuples(
    st.sampled_from([0, 1, 2, 5, 9, 9.5, 10.5, 12.125, 13.125, 20]),
    st.sampled_from([-3, -0.5, 0, 0, 0.125, 1]),
    st.sampled_from([0.0, 0.03, 0.0301, 0.05]),
    st.floats(-7, 7),
)


@given(
    segments=st.lists(
        st.tuples(st.floats(0, 14e-6), st.lists(TONE, max_size=6), st.booleans()), min_size=1, max_size=5
    ),
    course=st.sampled_from(FrequencyCourse),
    off_hz=st.sampled_from([0.0, 0.3, 40.0, 1e4]),
    sample_rate_hz=st.sampled_from([COMB_HZ, 625e6, 300e6]),
    chunk_samples=st.integers(50, 9000),
)
@settings(max_examples=50, deadline=None)
def test_any_program_is_rendered_right_in_chunks_of_any_size(
    segments: Any, course: int, off_hz: float, sample_rate_hz: float, chunk_samples: int
) -> None:
    made: list[Segment] = []
    for duration_s, tones, ramped in segments:
        rows: list[tuple[float, float, float, float, float]] = []
        for number, (index, by, amplitude, phase_rad) in enumerate(tones):
            start_hz = site(index) + off_hz * phase_rad
            start, end = (0.0 if ramped else amplitude), (amplitude if ramped and number % 2 else 0.05)
            rows.append((start_hz, start_hz + by * STEP_HZ, end if number % 2 else start, end, phase_rad))
        made.append((duration_s, rows))
    program = program_of(*made, course=course, still=False)
    samples = check(program, sample_rate_hz)
    renderer, n_samples = Renderer(program, sample_rate_hz), samples.shape[1]
    streamed = np.ones((2, n_samples + chunk_samples), np.int16)
    for start in range(0, n_samples + chunk_samples, chunk_samples):
        for channel in (0, 1):
            renderer.write(channel, start, streamed[channel, start : start + chunk_samples])
    assert np.array_equal(streamed[:, :n_samples], samples)
    assert not streamed[:, n_samples:].any()


def test_segments_own_the_samples_from_the_rounded_start_on() -> None:
    tone = (site(3), site(3), 1.0, 1.0, 0.0)
    program = program_of((10.4e-9, [tone]), (10.2e-9, []), (0.1e-9, [tone]), (9e-9, [tone]))
    renderer = Renderer(program, 1e9)
    assert renderer.first_sample.tolist() == [0, 10, 21, 21, 30]
    samples = check(program, 1e9)
    assert samples[0, :10].all()
    assert not samples[0, 10:21].any()


def test_what_is_silent_is_zero_and_the_empty_program_has_no_samples() -> None:
    off = [(site(1), site(2), 0.0, 0.0, 0.0)]
    program = program_of((1e-6, off), (1e-6, []))
    assert path_of(program) == [SILENT, SILENT]
    assert not render(program, COMB_HZ).samples.any()
    assert render(program_of()).samples.shape == (2, 0)


def test_row_tones_are_channel_0_and_column_tones_channel_1() -> None:
    waveform = labseq.render(program_of(move(2, [0])))
    assert waveform.sample_rate_hz == 625e6
    assert waveform.samples[0].any()
    assert not waveform.samples[1].any()
    assert not waveform.samples.flags.writeable


def test_many_threads_render_at_the_same_time_into_the_callers_buffers() -> None:
    program = program_of(*(move(9, [1, -1]) for _ in range(20)), still=False)
    whole = render(program, COMB_HZ).samples
    renderer = Renderer(program, COMB_HZ)
    out, n = np.empty_like(whole), 40_000
    stretches = [(channel, start) for channel in (0, 1) for start in range(0, renderer.n_samples, n)]
    assert len(stretches) > 2 * MAX_WORKSPACES
    with ThreadPoolExecutor(len(stretches)) as workers:
        for channel, start in stretches:
            workers.submit(renderer.write, channel, start, out[channel, start : start + n])
    assert np.array_equal(out, whole)


def test_only_the_memory_of_waveforms_that_are_gone_is_used_again() -> None:
    programs = [program_of(*(move(n, [1]) for _ in range(20 + n)), still=False) for n in (2, 4, 3)]
    expected = [render(program, COMB_HZ).samples.copy() for program in programs]
    whole, part = render(programs[0], COMB_HZ), render(programs[1], COMB_HZ).samples[1, 1000:2000]
    third = render(programs[2], COMB_HZ)
    assert np.array_equal(whole.samples, expected[0])
    assert np.array_equal(part, expected[1][1, 1000:2000])
    assert np.array_equal(third.samples, expected[2])
    gone = third.samples.ctypes.data
    del third
    assert render(programs[1], COMB_HZ).samples.ctypes.data == gone


@pytest.mark.parametrize(
    ("tone", "message"),
    [
        ((320e6, 1e8, 0.1, 0.1, 0.0), "start_hz of a row tone in batch 0 .* 320000000.* 312500000"),
        ((1e8, 1e8, float("nan"), 0.1, 0.0), "start_amplitude of a row tone in batch 0 is nan"),
        ((1e8, 1e8, 0.1, 0.96, 0.0), "sum of the amplitudes of the row tones in batch 0 is 1.01"),
    ],
)
def test_what_cannot_be_played_is_refused(tone: Any, message: str) -> None:
    program = program_of((1e-6, [(1e8, 1e8, 0.05, 0.05, 0.0), tone]))
    with pytest.raises(LimitError, match=message):
        render(program)


@pytest.mark.parametrize("duration_s", [-1e-6, float("nan")])
def test_wrong_durations_are_refused(duration_s: float) -> None:
    with pytest.raises(LimitError, match="duration of segment 0 in batch 0"):
        render(program_of((duration_s, [])))


@pytest.mark.parametrize("durations_s", [(1e308, 1e308), (1e9,)])
def test_more_samples_than_can_be_counted_are_refused(durations_s: tuple[float, ...]) -> None:
    with pytest.raises(LimitError, match=r"number of samples .*9\.01e\+15"):
        Renderer(program_of(*((duration_s, []) for duration_s in durations_s)), 10e9)


@pytest.mark.parametrize("sample_rate_hz", [0.0, float("nan"), float("inf")])
def test_wrong_sample_rates_are_refused(sample_rate_hz: float) -> None:
    with pytest.raises(LimitError, match="sample rate"):
        render(program_of((1e-6, [])), sample_rate_hz)
