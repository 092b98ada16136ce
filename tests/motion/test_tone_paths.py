"""Tone programs of batches with paths of tones, and what is rendered of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from labseq.model import Batch, MotionSpec, Plan, RfSpec, SegmentKind, SiteGrid, TonePaths, ToneProgram
from labseq.model.motion import SpeedProfile
from labseq.motion import tone_program
from labseq.motion.render_reference import render_reference
from labseq.motion.rendering import Renderer, RenderPath

IDLE, PICK_UP, TRANSPORT, DROP_OFF = SegmentKind
GRID = SiteGrid(6, 6)
CALIBRATED = replace(
    GRID,
    row_frequency_hz=GRID.row_frequency_hz + 1e5 * np.sin(np.arange(6.0)),
    column_frequency_hz=GRID.column_frequency_hz[::-1] + 1e5 * np.cos(np.arange(6.0)),
)
STAGGERED = TonePaths(
    np.array([[0.0, 2], [0.5, 2.5], [0.5, 2.5], [1, 4], [1, 4.5], [1, 5]]),
    np.array([[0.0, 3], [0, 3], [0.5, 2.5], [1, 2.5], [0.5, 2], [0.5, 2]]),
    np.array([3, 5]),
    np.array([5, 4]),
)


def batch(moves: Any, tones: TonePaths | None = None) -> Batch:
    table = np.array(moves, np.int16)
    return Batch(table[:, :2], table[:, 2:], tones=tones)


LINE = batch([(0, 3, 4, 3), (0, 5, 4, 5), (2, 3, 5, 3)])
PATHS = batch([(0, 0, 1, 1)], STAGGERED)


def program_of(*batches: Batch, grid: SiteGrid = GRID, **motion: Any) -> ToneProgram:
    return tone_program(Plan.from_batches(batches), grid, MotionSpec(**motion))


@pytest.mark.parametrize("speed_profile", ["constant", "minimum_jerk"])
def test_a_line_batch_written_as_paths_plays_the_same(speed_profile: SpeedProfile) -> None:
    """Where the row tones move, all equally far, up to the last bit."""
    line = batch([(0, 3, 3, 3), (0, 5, 3, 5), (2, 3, 5, 3)])
    tones = TonePaths(np.array([[0.0, 2], [3, 5]]), np.array([[3.0, 5]] * 2))
    other = PATHS
    plans = [(other, one, other) for one in (line, replace(line, tones=tones))]
    one, two = (program_of(*each, grid=CALIBRATED, speed_profile=speed_profile) for each in plans)
    for name in ("duration_s", "kind", "course", "batch"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for axis in ("row", "column"):
        for name in ("offsets", "start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad"):
            np.testing.assert_array_equal(
                getattr(getattr(one, axis), name), getattr(getattr(two, axis), name)
            )


def test_segments_of_staggered_paths() -> None:
    program = program_of(PATHS, overhead_per_batch_s=1e-3)
    ways = [0.5, 0.5 * 3**0.5, 1.5, 0.5, 0]  # the fourth leg: one tweezer moves along row and column
    site_s = GRID.spacing_m / MotionSpec().speed_m_s
    kinds = [IDLE, PICK_UP, PICK_UP, TRANSPORT, TRANSPORT, TRANSPORT, DROP_OFF, TRANSPORT, DROP_OFF]
    assert program.kind.tolist()[:9] == kinds
    assert program.kind.tolist()[9:] == [TRANSPORT, DROP_OFF, DROP_OFF]
    moving_s = program.duration_s[program.kind == TRANSPORT]
    assert moving_s[0] == pytest.approx(ways[0] * site_s)
    assert np.diff(program.row.offsets).tolist() == [0, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1]
    assert np.diff(program.column.offsets).tolist() == [0, 2, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1]
    first_off = slice(*program.row.offsets[6:8])
    assert (program.row.end_amplitude[first_off] / program.row.start_amplitude[first_off]).tolist() == [0, 1]


def test_tweezers_of_paths_may_be_shallower() -> None:
    """The row tones of batches with paths alone, and only their amplitudes, change."""
    full, shallow = (program_of(LINE, PATHS, path_depth=depth) for depth in (1.0, 0.25))
    of_paths = np.repeat(full.batch == 1, np.diff(full.row.offsets))
    for name in ("start_amplitude", "end_amplitude"):
        expected = getattr(full.row, name) * np.where(of_paths, 0.5, 1.0)
        np.testing.assert_allclose(getattr(shallow.row, name), expected)
        np.testing.assert_array_equal(getattr(shallow.column, name), getattr(full.column, name))
    np.testing.assert_array_equal(shallow.row.phase_rad, full.row.phase_rad)


@pytest.mark.parametrize("grid", [GRID, CALIBRATED])
def test_tones_are_where_the_paths_say_and_keep_their_phases(grid: SiteGrid) -> None:
    """Frequencies by interpolation between sites; phases by their integral; amplitudes between ramps."""
    amplitudes = tuple(np.linspace(0.04, 0.05, 6).tolist())
    rf = RfSpec(row_amplitudes=amplitudes, column_amplitudes=amplitudes, snap_within_m=0.0)
    program = program_of(PATHS, grid=grid, rf=rf)
    knots = np.cumsum(program.kind == TRANSPORT).tolist()  # where each segment ends; every leg takes time
    for axis, path, off, site_hz in (
        ("row", STAGGERED.row, STAGGERED.row_off, grid.row_frequency_hz),
        ("column", STAGGERED.column, STAGGERED.column_off, grid.column_frequency_hz),
    ):
        tones = getattr(program, axis)
        phase: dict[int, float] = {}
        for segment, kind in enumerate(program.kind):
            end = knots[segment]
            start = end - (kind == TRANSPORT)
            part = slice(*tones.offsets[segment : segment + 2])
            on = [k for k in range(path.shape[1]) if off[k] >= end]
            assert len(tones.start_hz[part]) == len(on)
            np.testing.assert_allclose(tones.start_hz[part], np.interp(path[start, on], range(6), site_hz))
            np.testing.assert_allclose(tones.end_hz[part], np.interp(path[end, on], range(6), site_hz))
            if kind == TRANSPORT:
                power = np.interp(path[end, on], range(6), np.square(amplitudes))
                np.testing.assert_allclose(tones.end_amplitude[part] ** 2, power)
            for k, before in zip(on, tones.phase_rad[part], strict=True):
                turned = (before - phase.get(k, before)) / (2 * np.pi)
                assert abs(turned - round(turned)) < 1e-6
            cycles = 0.5 * (tones.start_hz[part] + tones.end_hz[part]) * program.duration_s[segment]
            phase |= dict(zip(on, tones.phase_rad[part] + 2 * np.pi * (cycles % 1), strict=True))


@pytest.mark.parametrize("speed_profile", ["constant", "minimum_jerk", "constant_jerk"])
@pytest.mark.parametrize("grid", [GRID, CALIBRATED])
def test_samples_are_those_of_the_reference(grid: SiteGrid, speed_profile: SpeedProfile) -> None:
    program = program_of(PATHS, LINE, grid=grid, speed_profile=speed_profile)
    renderer = Renderer(program, 224e6)
    samples = np.empty((2, renderer.n_samples), np.int16)
    for channel in range(2):
        renderer.write(channel, 0, samples[channel])
    expected = render_reference(program, 224e6)
    assert np.abs(samples - expected).max() < 0.52


def test_half_sites_make_a_comb() -> None:
    """At constant speed the legs of a batch in which all tones go equally far are rendered on a comb."""
    row, column = np.array([[0.0, 2], [0.5, 2.5], [2.5, 4.5]]), np.array([[0.0, 2, 4], [0, 2, 4], [1, 3, 5]])
    renderer = Renderer(program_of(batch([(0, 0, 3, 1)], TonePaths(row, column))), 624e6)
    assert set(renderer.path.ravel().tolist()) <= {RenderPath.COMB, RenderPath.BLENDED}
