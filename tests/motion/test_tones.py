"""Tone programs of plans: segments, courses, phases, limits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray

from labseq.errors import LimitError, PlanError
from labseq.model import (
    AxisTones,
    Batch,
    FrequencyCourse,
    MotionSpec,
    Occupancy,
    Plan,
    PlanReport,
    RfSpec,
    SegmentKind,
    SiteGrid,
    TargetPattern,
    ToneProgram,
)
from labseq.model.motion import SpeedProfile
from labseq.motion import check_plan, fitting_batches, tone_program
from labseq.motion.axes import preassigned_phases
from labseq.motion.render_reference import render_reference
from labseq.motion.tone_kernels import (
    AMPLITUDES,
    BAND,
    END_AMPLITUDE,
    END_HZ,
    N_FIELDS,
    POWER,
    SPACING,
    START_AMPLITUDE,
    START_HZ,
    WITHIN,
    first_excess,
    greatest_sum,
)
from labseq.motion.tones import SPEED_PROFILES
from labseq.roles import Context
from labseq.testing.strategies import cases, tone_programs


def report(ends: list[float]) -> PlanReport:
    return PlanReport(np.zeros((1, 1), np.bool_), np.array(ends), np.ones(len(ends), np.int32), 0, 0)


def plan(linked: list[bool]) -> Plan:
    n = len(linked)
    return Plan(np.zeros((n, 4), np.int16), np.arange(n + 1, dtype=np.int32), np.array(linked, np.bool_))


@pytest.mark.parametrize(("window_s", "expected"), [(1.0, 1), (2.0, 1), (3.0, 1), (4.0, 4), (5.0, 5)])
def test_a_chain_is_never_cut(window_s: float, expected: int) -> None:
    linked = [False, False, True, True, False]
    assert fitting_batches(report([1.0, 2.0, 3.0, 4.0, 5.0]), plan(linked), window_s) == expected


def test_rounding_of_sums_does_not_cost_a_batch() -> None:
    assert fitting_batches(report([0.1 + 0.2]), plan([False]), 0.3) == 1


@given(st.lists(st.booleans(), max_size=8), st.floats(0, 10))
def test_as_many_as_possible(linked: list[bool], window_s: float) -> None:
    linked = [False, *linked]
    ends = [float(i + 1) for i in range(len(linked))]
    n = fitting_batches(report(ends), plan(linked), window_s)
    cuts = [k for k in range(1, len(linked) + 1) if k == len(linked) or not linked[k]]
    assert n == max([0, *(k for k in cuts if ends[k - 1] <= window_s)])


Move = tuple[int, int, int, int]
IDLE, PICK_UP, TRANSPORT, DROP_OFF = SegmentKind
GRID = SiteGrid(4, 6)
PAUSE_S = 0.5e-3
SITE_S = GRID.spacing_m / MotionSpec().speed_m_s


def batch(*moves: Move, linked: bool = False) -> Batch:
    table = np.array(moves, np.int16).reshape(-1, 4)
    return Batch(table[:, :2], table[:, 2:], linked)


def program_of(*batches: Batch, grid: SiteGrid = GRID, **motion: Any) -> ToneProgram:
    """The tones of batches, by default with a pause before each."""
    paused = MotionSpec(overhead_per_batch_s=PAUSE_S)
    return tone_program(Plan.from_batches(batches), grid, replace(paused, **motion))


def segment(axis: AxisTones, index: int) -> dict[str, NDArray[np.float64]]:
    tones = slice(axis.offsets[index], axis.offsets[index + 1])
    names = ("start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad")
    return {name: getattr(axis, name)[tones] for name in names}


def sites(hz: NDArray[np.float64], site_hz: NDArray[np.float64]) -> list[float]:
    """Where tones are, in sites of an equally spaced axis."""
    return ((hz - site_hz[0]) / (site_hz[1] - site_hz[0])).tolist()


def test_a_row_move_segment_by_segment() -> None:
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 5)))
    assert program.kind.tolist() == [IDLE, PICK_UP, PICK_UP, TRANSPORT, TRANSPORT, DROP_OFF, DROP_OFF]
    assert program.batch.tolist() == [0] * 7
    ramps = [2e-6, 58e-6, SITE_S, 2 * SITE_S, 58e-6, 2e-6]
    assert program.duration_s == pytest.approx([0.5e-3, *ramps])
    assert program.row.offsets.tolist() == [0, *range(7)]
    assert program.column.offsets.tolist() == [0, *range(0, 14, 2)]

    way = [sites(segment(program.column, i)["start_hz"], GRID.column_frequency_hz) for i in range(2, 6)]
    assert way == [pytest.approx(at) for at in ([0, 2], [0, 2], [1, 3], [1, 5])]
    assert sites(segment(program.column, 6)["end_hz"], GRID.column_frequency_hz) == pytest.approx([1, 5])
    for i in range(1, 7):
        row = segment(program.row, i)
        assert sites(row["start_hz"], GRID.row_frequency_hz) == pytest.approx([1])
        assert row["end_hz"].tolist() == row["start_hz"].tolist()


def test_the_axis_that_moves_is_ramped_and_the_other_one_keyed_over_2_us() -> None:
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 5)), batch((0, 0, 2, 0)), max_row_tones=10)
    full = {"row": 1 / 10, "column": 1 / 20}
    for i, kind in enumerate(program.kind.tolist()):
        ramped = ("column", "row")[int(program.batch[i])]
        for name, axis in (("row", program.row), ("column", program.column)):
            tones = segment(axis, i)
            start, end = tones["start_amplitude"], tones["end_amplitude"]
            after = np.sqrt(2 / 60) if name == ramped else 1.0
            is_keyed = program.duration_s[i] < 3e-6
            rises, falls = (after, 1.0), (1.0, after)
            if is_keyed:
                rises, falls = (0.0, after), (after, 0.0)
            expected = {PICK_UP: rises, DROP_OFF: falls}.get(SegmentKind(kind), (1.0, 1.0))
            assert start == pytest.approx(expected[0] * full[name])
            assert end == pytest.approx(expected[1] * full[name])


def test_little_power_leaves_the_band_of_the_parked_axis() -> None:
    program = program_of(batch((1, 0, 1, 1)), grid=SiteGrid(4, 6), overhead_per_batch_s=0.0)
    power = np.abs(np.fft.rfft(render_reference(program, 500e6)[0])) ** 2
    hz = np.fft.rfftfreq(2 * len(power) - 2, 1 / 500e6)
    assert 10 * np.log10(power[np.abs(hz - 100e6) > 18e6].sum() / power.sum()) < -60


def test_linked_batches_keep_their_tones_on() -> None:
    program = program_of(batch((0, 0, 0, 2)), batch((0, 2, 3, 2), linked=True), batch((3, 2, 3, 1)))
    assert program.kind.tolist() == [
        IDLE, PICK_UP, PICK_UP, TRANSPORT, TRANSPORT, DROP_OFF, DROP_OFF,
        IDLE, PICK_UP, PICK_UP, TRANSPORT, DROP_OFF, DROP_OFF,
    ]  # fmt: skip
    assert program.batch.tolist() == [0] * 4 + [1] * 3 + [2] * 6
    assert program.duration_s[4] == pytest.approx(3 * SITE_S)
    check_joints(program)
    assert segment(program.column, 1)["start_amplitude"] == [0.0]
    assert segment(program.row, 5)["end_amplitude"] == pytest.approx([np.sqrt(2 / 60) / 20])
    assert segment(program.column, 5)["end_amplitude"] == [1 / 20]


def test_a_waiting_tone_stays() -> None:
    program = program_of(batch((0, 0, 0, 1), (0, 3, 0, 3)), batch((0, 1, 2, 1), (0, 3, 2, 3), linked=True))
    end = segment(program.column, 3)["end_hz"]
    assert sites(end, GRID.column_frequency_hz) == pytest.approx([1, 3])


def test_ejection_goes_on_beyond_the_edge() -> None:
    program = program_of(batch((0, 0, 0, -1), (0, 5, 0, 6)))
    step = 1.6e6
    first, last = GRID.column_frequency_hz[[0, -1]]
    assert segment(program.column, 3)["end_hz"] == pytest.approx([first - step, last + step])
    program = program_of(batch((2, 1, 4, 1)))
    assert segment(program.row, 3)["end_hz"] == pytest.approx([GRID.row_frequency_hz[-1] + step])


@pytest.mark.parametrize(
    ("shape", "move", "axis", "end_hz"),
    [
        ((1, 3), (0, 1, -1, 1), "row", 100e6 - 1.6e6),
        ((3, 1), (1, 0, 1, 1), "column", 100e6 + 1.6e6),
        ((1, 1), (0, 0, 0, 1), "column", 100e6 + 1.6e6),
    ],
)
def test_ejection_from_an_axis_with_a_single_site(shape: Any, move: Move, axis: str, end_hz: float) -> None:
    program = program_of(batch(move), grid=SiteGrid(*shape))
    assert getattr(program, axis).end_hz[-1] == pytest.approx(end_hz)


def test_calibrated_frequencies_are_met_at_every_site_where_a_tone_starts_or_ends() -> None:
    site_hz = np.array([90e6, 91e6, 93e6, 96e6])
    grid = SiteGrid(1, 4, column_frequency_hz=site_hz)
    program = program_of(batch((0, 1, 0, 2)), batch((0, 0, 0, -1), (0, 3, 0, 4)), grid=grid)
    assert program.column.end_hz[2] == 93e6
    assert program.column.end_hz[-2:].tolist() == [89e6, 99e6]


def test_phases_start_as_preassigned() -> None:
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 5)), batch((0, 0, 2, 0)))
    rows, columns = preassigned_phases(4, 6)
    assert segment(program.column, 1)["phase_rad"] == pytest.approx(2 * np.pi * columns[[0, 2]])
    assert segment(program.row, 1)["phase_rad"] == pytest.approx(2 * np.pi * rows[[1]])
    assert segment(program.row, 8)["phase_rad"] == pytest.approx(2 * np.pi * rows[[0]])
    assert preassigned_phases(20, 20)[1][:6].tolist() == columns.tolist()
    assert len({*rows, *columns}) == 10


def check_joints(program: ToneProgram) -> None:
    """Frequency, amplitude and phase go on at every joint while the tweezers are on."""
    for axis in (program.row, program.column):
        for i in range(1, program.n_segments):
            before, after = segment(axis, i - 1), segment(axis, i)
            if IDLE in (program.kind[i - 1], program.kind[i]) or program.kind[i] == PICK_UP:
                continue
            assert after["start_hz"] == pytest.approx(before["end_hz"], abs=1e-6)
            assert after["start_amplitude"] == pytest.approx(before["end_amplitude"])
            cycles = 0.5 * (before["start_hz"] + before["end_hz"]) * program.duration_s[i - 1]
            jump = np.exp(1j * (before["phase_rad"] + 2 * np.pi * cycles - after["phase_rad"]))
            assert jump == pytest.approx(1.0, abs=1e-6)


def check_motion(program: ToneProgram, atoms: Occupancy, grid: SiteGrid) -> set[Any]:
    """Let the tweezers carry atoms; returns where they are in the end."""
    held: dict[tuple[int, int], tuple[int, int]] = {}
    places = {(int(r), int(c)) for r, c in np.argwhere(atoms)}
    for i, kind in enumerate(program.kind.tolist()):
        row, col = segment(program.row, i), segment(program.column, i)
        ends: list[list[int]] = []
        for tones, site_hz, key in (
            (row, grid.row_frequency_hz, "start_hz"),
            (col, grid.column_frequency_hz, "start_hz"),
            (row, grid.row_frequency_hz, "end_hz"),
            (col, grid.column_frequency_hz, "end_hz"),
        ):
            step = 1.6e6
            at = (tones[key] - site_hz[0]) / step
            assert at == pytest.approx(np.round(at), abs=1e-6)
            ends.append(np.round(at).astype(int).tolist())
        if kind == PICK_UP:
            held = {(a, b): (r, c) for a, r in enumerate(ends[0]) for b, c in enumerate(ends[1])}
            held = {tones: site for tones, site in held.items() if site in places}
        elif kind == TRANSPORT:
            sites_passed = max(abs(a - b) for a, b in zip(ends[0] + ends[1], ends[2] + ends[3], strict=True))
            assert program.duration_s[i] == pytest.approx(sites_passed * SITE_S)
            moved = {tones: (ends[2][tones[0]], ends[3][tones[1]]) for tones in held}
            places = (places - set(held.values())) | set(moved.values())
            held = moved
    return {site for site in places if site[0] in range(grid.n_rows) and site[1] in range(grid.n_cols)}


@given(cases((6, 6)), st.integers(1, 6), st.sampled_from(SPEED_PROFILES))
@settings(max_examples=60, deadline=None)
def test_programs_do_what_the_plan_says(
    case: tuple[TargetPattern, Occupancy], dop: int, profile: SpeedProfile
) -> None:
    target, atoms = case
    grid, motion = SiteGrid(*target.shape), MotionSpec(speed_profile=profile)
    context = Context(grid=grid, motion=motion)
    plan = PscaPlanner(PscaSettings(degree_of_parallelism=dop), context).plan(atoms, target)
    report = check_plan(plan, atoms, target, dop, grid, motion)
    program = tone_program(plan, grid, motion)
    ends = [program.duration_s[program.batch <= i].sum() for i in range(plan.n_batches)]
    assert report.batch_end_s == pytest.approx(motion.overhead_per_cycle_s + np.array(ends))
    carried = check_motion(program, atoms, grid)
    assert carried == {(int(r), int(c)) for r, c in np.argwhere(report.predicted)}
    for i, kind in enumerate(program.kind.tolist()):
        n_tweezers = np.diff(program.row.offsets)[i] * np.diff(program.column.offsets)[i]
        assert n_tweezers == (0 if kind == IDLE else report.n_tweezers[program.batch[i]])


def test_the_first_batches_only() -> None:
    plan = Plan.from_batches([batch((0, 0, 0, 1)), batch((0, 1, 0, 2)), batch((0, 2, 0, 3))])
    whole = tone_program(plan, GRID)
    part = tone_program(plan, GRID, n_batches=2)
    n = part.n_segments
    assert part.batch.tolist() == [0] * 5 + [1] * 5
    assert part.duration_s.tolist() == whole.duration_s[:n].tolist()
    assert part.column.phase_rad.tolist() == whole.column.phase_rad[: part.column.offsets[n]].tolist()
    for wrong in (-1, 4):
        with pytest.raises(PlanError, match=f"3 batches, so {wrong} cannot be played"):
            tone_program(plan, GRID, n_batches=wrong)


WILD = st.tuples(st.integers(0, 3), st.integers(0, 5), st.integers(-9, 9), st.integers(-9, 9))


@given(st.lists(st.tuples(st.lists(WILD, max_size=5), st.booleans()), max_size=3))
@settings(max_examples=50, deadline=None)
def test_an_unchecked_plan_makes_a_program_or_is_refused(batches: list[tuple[list[Move], bool]]) -> None:
    try:
        program = program_of(*(batch(*moves, linked=linked) for moves, linked in batches))
    except LimitError:
        return
    for axis in (program.row, program.column):
        assert np.isfinite(axis.end_hz).all()
        assert (axis.phase_rad >= 0).all()
        assert (axis.phase_rad < 2 * np.pi).all()
        assert ((axis.end_hz > 82e6) & (axis.end_hz < 118e6)).all()


def test_what_takes_no_time_is_left_out() -> None:
    assert tone_program(Plan.from_batches([])).n_segments == 0
    program = program_of(batch((0, 0, 0, 1)), pick_up_s=0.0, drop_off_s=0.0, overhead_per_batch_s=0.0)
    assert program.kind.tolist() == [TRANSPORT]


def test_what_cannot_be_played() -> None:
    with pytest.raises(LimitError, match=r"column tones in batch 1 is 2; .* 1"):
        program_of(batch((0, 0, 0, 1)), batch((0, 1, 0, 2), (0, 3, 0, 4)), max_column_tones=1)
    for move in ((4, 0, 4, 1), (0, 6, 0, 5), (-1, 0, -1, 1)):
        with pytest.raises(PlanError, match="4 x 6 sites"):
            program_of(batch(move))


UNEVEN = RfSpec(row_amplitudes=(0.1, 0.2, 0.05, 0.1), column_amplitudes=(0.1, 0.05, 0.2, 0.15, 0.1, 0.12))
MOTIONS = st.builds(
    MotionSpec,
    speed_profile=st.sampled_from(SPEED_PROFILES),
    rf=st.sampled_from([UNEVEN, replace(UNEVEN, phases="low_crest"), RfSpec()]),
)


@given(MOTIONS.flatmap(lambda motion: tone_programs(grid=GRID, motion=motion)))
@settings(max_examples=40, deadline=None)
def test_frequency_amplitude_and_phase_go_on_at_every_joint_within_a_batch(program: ToneProgram) -> None:
    check_joints(program)


@pytest.mark.parametrize("profile", ["minimum_jerk", "constant_jerk"])
def test_with_a_jerk_profile_all_tones_start_and_arrive_together(profile: SpeedProfile) -> None:
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 5)), speed_profile=profile)
    course = FrequencyCourse[profile.upper()]
    assert program.kind.tolist() == [IDLE, PICK_UP, PICK_UP, TRANSPORT, DROP_OFF, DROP_OFF]
    assert program.course.tolist() == [0, 0, 0, course, 0, 0]
    assert program.duration_s[3] == pytest.approx(3 * SITE_S)
    middle_s = float(program.joint_s[3] + 1.5 * SITE_S)
    first = GRID.column_frequency_hz[0]
    for t_s, made in ((middle_s, 0.5), (middle_s - 0.75 * SITE_S, course.fraction(0.25))):
        sites = (program.tones_at(t_s).column.frequency_hz - first) / 1.6e6
        assert sites == pytest.approx([made, 2 + 3 * made])


def test_depth_goes_evenly_from_site_to_site() -> None:
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 5)), rf=UNEVEN)
    start_s = float(program.joint_s[3])
    squares = np.array(UNEVEN.column_amplitudes) ** 2
    for sites in (0.0, 0.5, 1.0, 1.7, 2.999):
        depth = program.tones_at(start_s + sites * SITE_S).column.amplitude ** 2
        assert depth == pytest.approx(np.interp([min(sites, 1.0), 2 + sites], np.arange(6), squares))
    assert program.tones_at(start_s).row.amplitude.tolist() == [0.2]


def test_phases_of_low_crest_follow_schroeder_s_rule() -> None:
    rf = replace(UNEVEN, phases="low_crest")
    program = program_of(batch((1, 0, 1, 1), (1, 2, 1, 3), (1, 5, 1, 6)), rf=rf)
    sites, power = np.array([0, 2, 5]), np.array([0.1, 0.2, 0.12]) ** 2
    ways = np.maximum(sites[:, None] - sites, 0)
    expected = -2 * np.pi * ways @ power / power.sum()
    phases = program.column.phase_rad[:3]
    assert np.exp(1j * phases) == pytest.approx(np.exp(1j * expected))


def test_the_seed_decides_on_the_random_phases() -> None:
    one, same, other = (
        program_of(batch((0, 0, 0, 1)), rf=RfSpec(phase_seed=seed)).column.phase_rad[0] for seed in (1, 1, 2)
    )
    assert one == same
    assert one != other


LIMITS = np.array([80.0, 120.0, 2.0, 1.0, 1.0, 0.3])
AMPLITUDE = st.floats(0, 0.5)


def tones(*each: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Tones of one segment: frequency and amplitude at its start, and at its end."""
    values = np.zeros((N_FIELDS, len(each)))
    values[[START_HZ, START_AMPLITUDE, END_HZ, END_AMPLITUDE]] = np.array(each).reshape(-1, 4).T
    return values


def excess(*each: tuple[float, float, float, float]) -> tuple[int, int, float]:
    return first_excess(np.array([0, len(each)], np.int32), tones(*each), LIMITS)


@given(st.lists(st.tuples(AMPLITUDE, AMPLITUDE), max_size=6))
def test_the_greatest_sum_of_amplitudes_is_that_of_a_close_look(pairs: list[tuple[float, float]]) -> None:
    values = tones(*((0.0, start, 0.0, end) for start, end in pairs))
    u = np.linspace(0.0, 1.0, 2001)[:, None]
    start, end = values[START_AMPLITUDE] ** 2, values[END_AMPLITUDE] ** 2
    seen = float(np.sqrt(start + (end - start) * u).sum(axis=1).max())
    assert greatest_sum(values, 0, len(pairs), 0.0) == pytest.approx(seen, abs=2e-3)
    assert greatest_sum(values, 0, len(pairs), 0.0) >= seen - 1e-9
    assert greatest_sum(values, 0, len(pairs), 9.0) >= seen - 1e-9


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        ([], (WITHIN, -1, 0.0)),
        ([(80, 0.3, 120, 0.3), (100, 0.3, 122, 0.3)], (BAND, 1, 122.0)),
        ([(80, 0.3, 118, 0.3), (100, 0.3, 120, 0.3)], (WITHIN, -1, 0.0)),
        ([(79, 0.3, 90, 0.3)], (BAND, 0, 79.0)),
        ([(math.nan, 0.3, 90, 0.3)], (BAND, 0, math.nan)),
        ([(90, 0.3, 90, 0.3), (91, 0.3, 100, 0.3)], (SPACING, 1, 1.0)),
        ([(90, 0.3, 100, 0.3), (100, 0.3, 90, 0.3)], (SPACING, 1, -10.0)),
        ([(90, 0.1, 90, 0.7), (100, 0.1, 100, 0.4)], (AMPLITUDES, 0, 1.1)),
        ([(90, math.nan, 90, 0.7)], (AMPLITUDES, 0, math.nan)),
        ([(90, 0.1, 90, 0.6)], (POWER, 0, 0.36)),
    ],
)
def test_the_first_excess(
    each: list[tuple[float, float, float, float]], expected: tuple[int, int, float]
) -> None:
    assert excess(*each) == pytest.approx(expected, nan_ok=True)
