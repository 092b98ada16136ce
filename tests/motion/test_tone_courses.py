"""Programs of random plans: what they intend at any time, with every speed profile."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray

from labseq.model import (
    Batch,
    FrequencyCourse,
    MotionSpec,
    Occupancy,
    Plan,
    RfSpec,
    SegmentKind,
    SiteGrid,
    TargetPattern,
    ToneProgram,
    TonesNow,
)
from labseq.model.motion import SpeedProfile
from labseq.motion import check_plan, tone_program
from labseq.motion.tones import SPEED_PROFILES
from labseq.roles import Context
from labseq.testing.strategies import cases, tone_programs

GRID = SiteGrid(4, 6)
SITE_S = GRID.spacing_m / MotionSpec().speed_m_s
UNEVEN = RfSpec(row_amplitudes=(0.1, 0.2, 0.05, 0.1), column_amplitudes=(0.1, 0.05, 0.2, 0.15, 0.1, 0.12))
MOTIONS = st.builds(
    MotionSpec,
    speed_profile=st.sampled_from(SPEED_PROFILES),
    rf=st.sampled_from([UNEVEN, replace(UNEVEN, phases="low_crest"), RfSpec()]),
)
PROGRAMS = MOTIONS.flatmap(lambda motion: tone_programs(grid=GRID, motion=motion))


def program_of(*moves: tuple[int, int, int, int], **motion: Any) -> ToneProgram:
    table = np.array(moves, np.int16)
    return tone_program(Plan.from_batches([Batch(table[:, :2], table[:, 2:])]), GRID, MotionSpec(**motion))


def axes_at(program: ToneProgram, t_s: float) -> tuple[TonesNow, TonesNow]:
    tones = program.tones_at(t_s)
    return tones.row, tones.column


@given(PROGRAMS)
@settings(max_examples=60, deadline=None)
def test_frequency_amplitude_and_phase_go_on_at_every_joint_within_a_batch(program: ToneProgram) -> None:
    just_before_s = 1e-12
    for i in range(1, program.n_segments):
        if SegmentKind.IDLE in (program.kind[i - 1], program.kind[i]):
            continue
        joint_s = float(program.joint_s[i])
        befores, afters = axes_at(program, joint_s - just_before_s), axes_at(program, joint_s)
        for before, after in zip(befores, afters, strict=True):
            assert after.frequency_hz == pytest.approx(before.frequency_hz, abs=1.0)
            assert after.amplitude**2 == pytest.approx(before.amplitude**2, abs=1e-8)
            jump = np.exp(1j * (after.phase_rad - before.phase_rad))
            assert jump == pytest.approx(np.exp(2j * np.pi * after.frequency_hz * just_before_s), abs=1e-5)


def integrated_cycles(program: ToneProgram, start_s: float, end_s: float) -> list[NDArray[np.float64]]:
    """Cycles of each axis' tones between two times of a segment, by Gauss and Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    edges = np.linspace(start_s, end_s, 9)
    cycles: list[Any] = [0.0, 0.0]
    for low, high in pairwise(edges):
        for node, weight in zip(nodes, weights, strict=True):
            at = axes_at(program, 0.5 * (low + high) + 0.5 * (high - low) * node)
            for axis in (0, 1):
                cycles[axis] = cycles[axis] + 0.5 * (high - low) * weight * at[axis].frequency_hz
    return cycles


@given(PROGRAMS.filter(lambda program: program.n_segments > 0), st.data())
@settings(max_examples=60, deadline=None)
def test_the_phase_is_the_integral_of_the_frequency(program: ToneProgram, data: st.DataObject) -> None:
    i = data.draw(st.integers(0, program.n_segments - 1))
    start_s, duration_s = float(program.joint_s[i]), float(program.duration_s[i])
    t_s = start_s + duration_s * data.draw(st.floats(0.01, 0.99))
    cycles = integrated_cycles(program, start_s, t_s)
    for axis, passed, start in zip((0, 1), cycles, axes_at(program, start_s), strict=True):
        expected = np.exp(1j * (start.phase_rad + 2 * np.pi * passed))
        assert np.exp(1j * axes_at(program, t_s)[axis].phase_rad) == pytest.approx(expected, abs=1e-4)


@given(PROGRAMS, st.floats(0, 1, exclude_max=True))
@settings(max_examples=60, deadline=None)
def test_frequencies_and_amplitudes_stay_within_limits(program: ToneProgram, part: float) -> None:
    for now in axes_at(program, part * program.total_duration_s):
        assert np.all((now.frequency_hz >= 82e6) & (now.frequency_hz <= 118e6))
        assert np.all(np.diff(now.frequency_hz) >= 1.6e6 * (1 - 1e-9))
        assert np.all((now.amplitude >= 0) & (now.amplitude <= 0.2))
        assert now.amplitude.sum() <= 1.0 + 1e-9


@pytest.mark.parametrize("profile", SPEED_PROFILES)
@given(case=cases((6, 6)), dop=st.integers(1, 6))
@settings(max_examples=40, deadline=None)
def test_a_program_lasts_as_long_as_the_check_says(
    profile: SpeedProfile, case: tuple[TargetPattern, Occupancy], dop: int
) -> None:
    target, atoms = case
    grid, motion = SiteGrid(*target.shape), MotionSpec(speed_profile=profile)
    context = Context(grid=grid, motion=motion)
    plan = PscaPlanner(PscaSettings(degree_of_parallelism=dop), context).plan(atoms, target)
    report = check_plan(plan, atoms, target, dop, grid, motion)
    program = tone_program(plan, grid, motion)
    ends = [program.duration_s[program.batch <= i].sum() for i in range(plan.n_batches)]
    assert report.batch_end_s == pytest.approx(motion.overhead_per_cycle_s + np.array(ends))


@pytest.mark.parametrize("profile", ["minimum_jerk", "constant_jerk"])
def test_with_a_jerk_profile_all_tones_start_and_arrive_together(profile: SpeedProfile) -> None:
    program = program_of((1, 0, 1, 1), (1, 2, 1, 5), speed_profile=profile)
    course = FrequencyCourse[profile.upper()]
    assert program.kind.tolist() == [*SegmentKind]
    assert program.course.tolist() == [0, 0, course, 0]
    assert program.duration_s[2] == pytest.approx(3 * SITE_S)
    middle_s = float(program.joint_s[2] + 1.5 * SITE_S)
    first = GRID.column_frequency_hz[0]
    for t_s, made in ((middle_s, 0.5), (middle_s - 0.75 * SITE_S, course.fraction(0.25))):
        sites = (program.tones_at(t_s).column.frequency_hz - first) / 1.6e6
        assert sites == pytest.approx([made, 2 + 3 * made])


def test_at_constant_speed_every_segment_is_linear() -> None:
    program = program_of((1, 0, 1, 1), (1, 2, 1, 5))
    assert program.course.tolist() == [FrequencyCourse.LINEAR] * 5


def test_depth_goes_evenly_from_source_to_goal_through_all_cuts() -> None:
    program = program_of((1, 0, 1, 1), (1, 2, 1, 5), rf=UNEVEN)
    start_s = float(program.joint_s[2])
    for sites in (0.0, 0.5, 1.0, 1.7, 2.999):
        depth = program.tones_at(start_s + sites * SITE_S).column.amplitude ** 2
        early, late = min(sites, 1.0), sites / 3
        assert depth[0] == pytest.approx(0.1**2 + early * (0.05**2 - 0.1**2))
        assert depth[1] == pytest.approx(0.2**2 + late * (0.12**2 - 0.2**2))
    assert program.tones_at(start_s).row.amplitude.tolist() == [0.2]


def test_an_ejected_atom_keeps_the_amplitude_of_the_edge() -> None:
    program = program_of((0, 1, 0, -1), rf=UNEVEN)
    assert program.column.end_amplitude[-2] == 0.1


def crest(program: ToneProgram) -> float:
    """Peak over r.m.s. of the envelope of the column tones at the start of the transport."""
    tones = program.tones_at(float(program.joint_s[2])).column
    t_s = np.linspace(0.0, 1 / 1.6e6, 2000)[:, None]
    turns = 2j * np.pi * (tones.frequency_hz - tones.frequency_hz[0]) * t_s
    envelope = np.abs((tones.amplitude * np.exp(turns + 1j * tones.phase_rad)).sum(axis=1))
    return float(envelope.max() / np.sqrt((envelope**2).mean()))


@pytest.mark.parametrize("n", [4, 8, 19])
def test_phases_of_low_crest_beat_random_ones(n: int) -> None:
    plan = Plan.from_batches([([(0, i) for i in range(n)], [(0, i + 1) for i in range(n)])])
    chosen = tone_program(plan, motion=MotionSpec(rf=RfSpec(phases="low_crest")))
    drawn = [tone_program(plan, motion=MotionSpec(rf=RfSpec(phase_seed=seed))) for seed in range(20)]
    assert crest(chosen) < 1.5
    assert crest(chosen) < np.median([crest(program) for program in drawn])


def test_phases_of_low_crest_follow_schroeder_s_rule() -> None:
    rf = replace(UNEVEN, phases="low_crest")
    program = program_of((1, 0, 1, 1), (1, 2, 1, 3), (1, 5, 1, 6), rf=rf)
    sites, power = np.array([0, 2, 5]), np.array([0.1, 0.2, 0.12]) ** 2
    ways = np.maximum(sites[:, None] - sites, 0)
    expected = -2 * np.pi * ways @ power / power.sum()
    phases = program.column.phase_rad[:3]
    assert np.exp(1j * phases) == pytest.approx(np.exp(1j * expected))


def test_the_seed_decides_on_the_random_phases() -> None:
    one, same, other = (
        program_of((0, 0, 0, 1), rf=RfSpec(phase_seed=seed)).column.phase_rad[0] for seed in (1, 1, 2)
    )
    assert one == same
    assert one != other
