"""The effect of a tone program on the atoms: where they end, and what they are lost by."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import FrequencyMap, TonePositions, Transport
from numpy.typing import NDArray

from labseq import Batch, LimitError, MotionSpec, Plan, SiteGrid, check_plan, tone_program
from labseq.geometry import pattern
from labseq.model.motion import SpeedProfile
from labseq.testing.fakes import OneByOnePlanner
from labseq.testing.rf import ON, PROGRAM_GRID as GRID, ToneProgramBuilder

PLANE = SiteGrid(5, 6)


@pytest.mark.parametrize("sign", [1, -1])
def test_frequencies_may_rise_or_fall_and_go_on_beyond_the_grid(sign: int) -> None:
    hz = 100e6 + sign * np.array([0.0, 1.0, 2.1]) * 1e6
    places = FrequencyMap(hz, 1e6, "row").sites(100e6 + sign * np.array([-1.0, 0.5, 1.0, 2.1, 3.2]) * 1e6)
    np.testing.assert_allclose(places, [-1.0, 0.5, 1.0, 2.0, 3.0])


def test_frequencies_out_of_order_are_refused() -> None:
    with pytest.raises(LimitError, match="column frequencies"):
        FrequencyMap(np.array([1.0, 3.0, 2.0]), 1.0, "column")


def test_a_grid_of_one_site_takes_the_usual_step() -> None:
    lone = FrequencyMap(np.array([100e6]), 1.6e6, "row")
    np.testing.assert_allclose(lone.sites(np.array([98.4e6, 101.6e6])), [-1.0, 1.0])


def test_errors_of_the_tweezers_places_are_what_the_settings_say() -> None:
    light = SimulationSettings.model_validate(
        {"mobile_light": {"offset": [0.3e-6, -0.2e-6], "magnification_error": 0.01}}
    ).mobile_light
    places = TonePositions(PLANE, light)
    for axis, (offset_m, hz) in enumerate(
        [(-0.2e-6, PLANE.row_frequency_hz), (0.3e-6, PLANE.column_frequency_hz)]
    ):
        n = len(hz)
        expected = np.arange(n) + offset_m / PLANE.spacing_m + 0.01 * (np.arange(n) - (n - 1) / 2)
        np.testing.assert_allclose(places.actual(axis, hz), expected)
        np.testing.assert_allclose(places.intended(axis, hz), np.arange(n))


def test_tones_have_errors_of_their_own_that_belong_to_the_machine() -> None:
    light = SimulationSettings.model_validate({"mobile_light": {"tone_error": 0.1e-6}}).mobile_light
    grid = SiteGrid(60, 80, row_frequency_hz=np.arange(1.0, 61.0), column_frequency_hz=np.arange(1.0, 81.0))
    places = TonePositions(grid, light)
    errors: list[NDArray[np.float64]] = []
    for _ in range(2):
        places.draw(np.random.default_rng(5))
        errors.append(places.actual(1, grid.column_frequency_hz) - np.arange(80))
    np.testing.assert_array_equal(errors[0], errors[1])
    assert errors[0].std() * grid.spacing_m == pytest.approx(0.1e-6, rel=0.3)


FULL = np.ones(GRID.shape)


def atoms(*sites: tuple[int, int], grid: SiteGrid = GRID) -> NDArray[np.bool_]:
    occupied = np.zeros(grid.shape, np.bool_)
    for site in sites:
        occupied[site] = True
    return occupied


def after(
    tape: ToneProgramBuilder, *sites: tuple[int, int], n_segments: int | None = None, **physics: Any
) -> set[tuple[int, int]]:
    """Where the atoms are after a program."""
    occupied = atoms(*sites, grid=tape.grid)
    settings = SimulationSettings.model_validate({"transport_loss": 0.0, "temperature": 1e-6} | physics)
    transport = Transport(tape.grid, MotionSpec(), settings)
    n = len(tape.segments) if n_segments is None else n_segments
    transport.carry(occupied, tape.program(), n, np.ones(tape.grid.shape), np.random.default_rng(0), 1.0)
    return {(int(r), int(c)) for r, c in np.argwhere(occupied)}


def test_a_line_shifts_by_one_into_the_free_site() -> None:
    tape = ToneProgramBuilder().move([(2, 2)], [(0, 1), (1, 2), (2, 3)])
    assert after(tape, (2, 0), (2, 1), (2, 2)) == {(2, 1), (2, 2), (2, 3)}


def test_rows_and_columns_of_tones_make_a_block_of_tweezers() -> None:
    tape = ToneProgramBuilder().move([(0, 0), (1, 1)], [(0, 2), (1, 3)])
    assert after(tape, (0, 0), (0, 1), (1, 0), (1, 1)) == {(0, 2), (0, 3), (1, 2), (1, 3)}


def test_a_tweezer_that_finds_no_atom_moves_nothing() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 3), (1, 4)])
    assert after(tape, (0, 1), (3, 3)) == {(0, 4), (3, 3)}


@pytest.mark.parametrize(
    ("off_by", "taken"),
    [(0.0, True), (0.34, True), (-0.34, True), (0.36, False), (0.5, False)],
)
@pytest.mark.parametrize("axis", ["row", "column"])
def test_a_pick_up_takes_only_wells_that_merge_with_its_own(off_by: float, taken: bool, axis: str) -> None:
    row, col = (2 + off_by, 2.0) if axis == "row" else (2.0, 2 + off_by)
    there_and_gone = ToneProgramBuilder().add([(row, row, ON, ON)], [(col, col, 0.0, ON)])
    assert after(there_and_gone, (2, 2)) == (set() if taken else {(2, 2)})


def test_an_atom_set_down_between_sites_is_lost() -> None:
    assert after(ToneProgramBuilder().move([(0, 0)], [(0, 2.45)]), (0, 0)) == set()
    assert after(ToneProgramBuilder().move([(0, 0)], [(0, 2.2)]), (0, 0)) == {(0, 2)}


@pytest.mark.parametrize(
    ("rows", "cols"),
    [([(2, 2)], [(0, -1)]), ([(2, 2)], [(0, 6)]), ([(2, -1)], [(0, 0)]), ([(2, 5)], [(0, 0)])],
)
def test_an_atom_that_ends_outside_of_the_grid_is_gone(rows: Any, cols: Any) -> None:
    assert after(ToneProgramBuilder().move(rows, cols), (2, 0), (4, 5)) == {(4, 5)}


def test_ejection_takes_the_outermost_atom_only() -> None:
    assert after(ToneProgramBuilder().move([(2, 2)], [(0, -1), (1, 0)]), (2, 0), (2, 1), (2, 2)) == {
        (2, 0),
        (2, 2),
    }


def test_two_atoms_on_one_site_are_both_lost() -> None:
    assert after(ToneProgramBuilder().move([(0, 0)], [(0, 3)]), (0, 0), (0, 3), (1, 3)) == {(1, 3)}


def test_two_atoms_on_one_site_are_both_lost_however_the_second_came() -> None:
    creep = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])  # small jumps, never a sweep
    for place in (0.2, 0.4, 0.6, 0.8):
        creep.add([(0, 0, ON, ON)], [(place, place, ON, ON)])
    creep.add([(0, 0, ON, ON)], [(1, 1, ON, 0.0)])
    assert after(creep, (0, 0)) == {(0, 1)}
    assert after(creep, (0, 0), (0, 1)) == set()


def test_a_loaded_tweezer_and_the_atom_in_its_way_are_both_lost_and_the_next_passes() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 4), (1, 5)])
    assert after(tape, (0, 0), (0, 1), (0, 3)) == {(0, 4)}


def test_an_empty_tweezer_throws_out_the_atom_in_its_way() -> None:
    assert after(ToneProgramBuilder().move([(0, 0)], [(0, 4)]), (0, 2), (1, 2)) == {(1, 2)}


def test_the_first_loaded_tweezer_is_lost_wherever_it_hits() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(1, 4), (2, 5)])
    assert after(tape, (0, 1), (0, 2), (0, 3), (0, 4)) == {(0, 4)}


def test_an_unintended_crossing_takes_its_atom_along() -> None:
    tape = ToneProgramBuilder().move([(0, 0), (3, 3)], [(0, 1), (4, 5)])
    assert after(tape, (0, 0), (3, 4), (3, 0)) == {(0, 1), (3, 5), (3, 1)}


def test_a_diagonal_move_hits_what_lies_on_its_line_only() -> None:
    tape = ToneProgramBuilder().move([(0, 2)], [(0, 2)])
    assert after(tape, (0, 0), (1, 0), (0, 1)) == {(2, 2), (1, 0), (0, 1)}
    assert after(tape, (0, 0), (1, 1)) == set()


def test_tweezers_that_stay_on_turn_a_corner() -> None:
    corner = (
        ToneProgramBuilder()
        .add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
        .add([(0, 0, ON, ON)], [(0, 3, ON, ON)])
        .add([(0, 4, ON, ON)], [(3, 3, ON, ON)])
        .add([(4, 4, ON, 0.0)], [(3, 3, ON, ON)])
    )
    assert after(corner, (0, 0), (2, 2)) == {(4, 3), (2, 2)}


@pytest.mark.parametrize(("jump", "kept"), [(0.2, True), (0.3, False), (3.0, False)])
def test_a_tone_that_jumps_loses_its_atom(jump: float, kept: bool) -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(jump, 2, ON, ON)]).add([(0, 0, ON, ON)], [(2, 2, ON, 0.0)])
    assert after(tape, (0, 0)) == ({(0, 2)} if kept else set())


def test_a_tone_that_goes_out_between_segments_loses_its_atom() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)]).add([(0, 0, ON, ON)], [(0, 0, ON, 0.0)])
    assert after(tape, (0, 0)) == set()


def test_tones_may_change_their_order_in_the_list() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON), (3, 3, 0.0, ON)])
    tape.add([(0, 0, ON, 0.0)], [(3, 3, ON, ON), (0, 0, ON, ON)])
    assert after(tape, (0, 0), (1, 1)) == {(0, 0), (1, 1)}


def test_atoms_still_held_at_the_end_are_lost() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 2)])
    assert after(tape, (0, 0), (4, 4), n_segments=2) == {(4, 4)}
    assert after(tape, (0, 0), (4, 4), n_segments=0) == {(0, 0), (4, 4)}


def test_a_pause_between_batches_needs_no_tones() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 2)]).add([], []).move([(0, 0)], [(2, 3)])
    assert after(tape, (0, 0)) == {(0, 3)}


@pytest.mark.parametrize("ends", [(3, 0), (1.9, 2.3), (2, 2)])
def test_tones_that_meet_or_pass_lose_their_atoms(ends: tuple[float, float]) -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, ends[0]), (3, ends[1]), (5, 5)])
    assert after(tape, (0, 0), (0, 3), (0, 5)) == {(0, 5)}


def test_a_tone_without_light_disturbs_nothing() -> None:
    dark = [(0.0, 5.0, 0.0, 0.0)]
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(0, 2, ON, ON), *dark]).add([(0, 0, ON, ON)], [(2, 2, ON, 0.0)])
    assert after(tape, (0, 0), (0, 4)) == {(0, 2), (0, 4)}


def test_a_program_on_a_row_of_two_sites_works() -> None:
    tape = ToneProgramBuilder(SiteGrid(1, 2)).move([(0, 0)], [(0, 1)])
    assert after(tape, (0, 0)) == {(0, 1)}


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_a_legal_shift_of_a_whole_line_does_exactly_what_it_says(data: st.DataObject) -> None:
    n_cols = GRID.n_cols
    columns = st.lists(st.integers(0, n_cols - 1), min_size=1, max_size=n_cols, unique=True).map(sorted)
    sources = data.draw(columns)
    n = len(sources)
    goals = sorted(data.draw(st.lists(st.integers(-1, n_cols), min_size=n, max_size=n, unique=True)))
    others = data.draw(st.sets(st.tuples(st.sampled_from([0, 1, 3, 4]), st.integers(0, n_cols - 1))))
    tape = ToneProgramBuilder().move([(2, 2)], list(zip(sources, goals, strict=True)))
    expected = others | {(2, c) for c in goals if 0 <= c < n_cols}
    assert after(tape, *others, *((2, c) for c in sources)) == expected


TONES = st.lists(
    st.tuples(st.floats(-2, 7), st.floats(-2, 7), st.sampled_from([0.0, ON]), st.sampled_from([0.0, ON])),
    max_size=3,
)


@given(
    st.lists(st.tuples(TONES, TONES), max_size=5), st.sets(st.tuples(st.integers(0, 4), st.integers(0, 5)))
)
@settings(max_examples=200, deadline=None)
def test_no_program_makes_atoms(segments: list[Any], sites: set[tuple[int, int]]) -> None:
    assert len(after(ToneProgramBuilder(segments=segments), *sites)) <= len(sites)


def atoms_on(*sites: tuple[int, int]) -> NDArray[np.bool_]:
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in sites:
        occupied[site] = True
    return occupied


def remain(tape: ToneProgramBuilder, *sites: tuple[int, int], **physics: Any) -> set[tuple[int, int]]:
    """Where the atoms_on are after a program."""
    occupied = atoms_on(*sites)
    transport = Transport(GRID, MotionSpec(), SimulationSettings.model_validate(physics))
    transport.carry(occupied, tape.program(), len(tape.segments), FULL, np.random.default_rng(0), 1.0)
    return {(int(r), int(c)) for r, c in np.argwhere(occupied)}


def survivors(n_repeats: int, n_tones: int, loss_factor: float = 1.0, **physics: float) -> int:
    """How many of 5 atoms_on, carried ``n_repeats`` times with ``n_tones`` column tones, survive in all."""
    cols = [(0, 1), *((c, c) for c in range(2, n_tones + 1))]
    program = ToneProgramBuilder().move([(r, r) for r in range(5)], cols).program()
    transport = Transport(GRID, MotionSpec(), SimulationSettings.model_validate(physics))
    rng = np.random.default_rng(2)
    total = 0
    for _ in range(n_repeats):
        occupied = atoms_on(*((r, 0) for r in range(5)))
        transport.carry(occupied, program, 3, FULL, rng, loss_factor)
        total += int(occupied.sum())
    return total


def within_four_sigma(count: int, n: int, p: float) -> bool:
    return abs(count - n * p) < 4 * np.sqrt(n * p * (1 - p))


def test_each_further_tone_adds_to_the_loss() -> None:
    physics = {"transport_loss": 0.1, "transport_loss_per_tone": 0.05}
    further = 4 + 2  # five row tones and three column tones are on
    assert within_four_sigma(survivors(1000, 3, **physics), 5000, 1 - (0.1 + 0.05 * further))


def test_atoms_that_are_not_moved_are_not_lost() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 2)])
    assert remain(tape, (4, 4), (0, 5), transport_loss=1.0) == {(4, 4), (0, 5)}


def lost_by(
    tape: ToneProgramBuilder, *sites: tuple[int, int], depth: float = 1.0, **physics: Any
) -> dict[str, int]:
    """What the atoms_on of a program are lost by."""
    settings = SimulationSettings.model_validate({"transport_loss": 0.0, "temperature": 1e-6} | physics)
    transport = Transport(tape.grid, MotionSpec(), settings)
    static = np.full(tape.grid.shape, depth)
    occupied = atoms_on(*sites)
    n = len(tape.segments)
    lost = transport.carry(occupied, tape.program(), n, static, np.random.default_rng(0), 1.0)
    assert int(occupied.sum()) == len(sites) - sum(lost.values())
    return dict(lost)


def test_every_loss_has_its_cause() -> None:
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0), transport_loss=1.0) == {
        "hand_over": 1
    }
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0)) == {}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, -1)]), (0, 0)) == {"ejected": 1}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3)]), (0, 0), (0, 3)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3)]), (0, 0), (0, 1)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3), (3, 0)]), (0, 0), (0, 3)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)]), (0, 0)) == {"program": 1}
    held = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
    assert lost_by(held.add([], []), (0, 0)) == {"program": 1}
    light = {"adiabatic_depth": 3e-3, "shallow_loss": 1.0}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0), mobile_light=light) == {}
    slow = ToneProgramBuilder().move([(0, 0)], [(0, 2)])
    assert remain(slow, (0, 0), transport_loss=0.0, mobile_light=light) == {(0, 2)}  # 9 um/ms


def test_a_shallow_tweezer_at_full_speed_loses_its_atom_on_the_way() -> None:
    occupied = atoms_on((0, 0))
    light = {"adiabatic_depth": 3e-3, "shallow_loss": 1.0}
    settings = SimulationSettings.model_validate({"transport_loss": 0.0, "mobile_light": light})
    program = ToneProgramBuilder().move([(0, 0)], [(0, 2)]).program(segment_s=2 * GRID.spacing_m / 0.13)
    transport = Transport(GRID, MotionSpec(), settings)
    assert transport.carry(occupied, program, 3, FULL, np.random.default_rng(0), 1.0) == {"transport": 1}


def test_a_weak_tweezer_neither_takes_nor_throws_out_an_atom() -> None:
    weak = ON * 0.3  # 9 % of the depth, on the axis that is not ramped
    tape = (
        ToneProgramBuilder()
        .add([(0, 0, weak, weak)], [(0, 0, 0.0, ON)])
        .add([(0, 0, weak, weak)], [(0, 3, ON, ON)])
    )
    assert remain(tape, (0, 0), (0, 2)) == {(0, 0), (0, 2)}


@pytest.mark.parametrize(("offset_um", "kept"), [(0.0, 1.0), (0.9, 0.984), (1.2, 0.75), (2.0, 1.0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_pick_up_and_drop_off_beside_the_site_keeps_what_the_energy_allows(
    offset_um: float, kept: float, axis: int
) -> None:
    off = offset_um * 1e-6 / GRID.spacing_m
    rows = [(r + off * axis, r + off * axis, ON, ON) for r in range(5)]
    cols = [c + off * (1 - axis) for c in range(6)]
    tape = (
        ToneProgramBuilder()
        .add(rows, [(c, c, 0.0, ON) for c in cols])
        .add(rows, [(c, c, ON, 0.0) for c in cols])
    )
    transport = Transport(GRID, MotionSpec(), SimulationSettings(transport_loss=0.0))
    rng, total = np.random.default_rng(3), 0
    for _ in range(60):
        occupied = np.ones(GRID.shape, np.bool_)
        transport.carry(occupied, tape.program(), 2, FULL, rng, 1.0)
        total += int(occupied.sum())
    n = 60 * 30
    assert abs(total - n * kept) <= 4 * np.sqrt(n * kept * (1 - kept)) + 0.01 * n


def test_a_tweezer_that_splits_keeps_one_atom() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(2, 2, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(1.75, 1.2, ON, ON), (2.25, 2.8, ON, ON)])
    tape.add([(0, 0, ON, ON)], [(1.2, 1.2, ON, 0.0), (2.8, 2.8, ON, 0.0)])
    assert remain(tape, (0, 2), transport_loss=0.0, temperature=1e-6) == {(0, 1)}


def test_two_tweezers_that_come_on_beside_one_atom_take_it_once() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(1.7, 1.7, 0.0, ON), (2.3, 2.3, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(1.7, 1.0, ON, ON), (2.3, 3.0, ON, ON)])
    tape.add([(0, 0, ON, ON)], [(1.0, 1.0, ON, 0.0), (3.0, 3.0, ON, 0.0)])
    assert remain(tape, (0, 2), transport_loss=0.0) == {(0, 1)}


PROFILES = pytest.mark.parametrize("profile", ["constant", "minimum_jerk", "constant_jerk"])


def carried(plan: Plan, occupied: NDArray[np.bool_], profile: SpeedProfile = "constant") -> NDArray[np.bool_]:
    program = tone_program(plan, grid=PLANE, motion=MotionSpec(speed_profile=profile))
    result = occupied.copy()
    transport = Transport(PLANE, MotionSpec(), SimulationSettings(transport_loss=0.0))
    transport.carry(result, program, program.n_segments, np.ones(PLANE.shape), np.random.default_rng(0), 1.0)
    return result


@PROFILES
@pytest.mark.parametrize("seed", range(10))
def test_a_checked_plan_does_what_the_check_predicts(seed: int, profile: SpeedProfile) -> None:
    occupied = np.random.default_rng(seed).random(PLANE.shape) < 0.6
    target = pattern(np.array([[1, 0, 1], [0, 1, 0], [1, 0, 1]], np.bool_), PLANE)
    plan = OneByOnePlanner().plan(occupied, target)
    predicted = check_plan(plan, occupied, target, 1, grid=PLANE).predicted
    assert plan.n_batches > 0
    np.testing.assert_array_equal(carried(plan, occupied, profile), predicted)


@PROFILES
def test_ejection_parallel_moves_and_linked_batches_do_what_the_check_predicts(profile: SpeedProfile) -> None:
    occupied = np.zeros(PLANE.shape, np.bool_)
    for site in ((1, 0), (1, 1), (1, 2), (4, 4), (4, 5), (0, 3)):
        occupied[site] = True
    plan = Plan.from_batches(
        [
            Batch(np.array([(1, 0), (1, 1)], np.int16), np.array([(1, -1), (1, 0)], np.int16)),
            Batch(np.array([(4, 4)], np.int16), np.array([(4, 1)], np.int16)),
            Batch(np.array([(4, 1)], np.int16), np.array([(2, 1)], np.int16), linked=True),
        ]
    )
    target = pattern(np.ones((1, 1), np.bool_), PLANE)
    predicted = check_plan(plan, occupied, target, 2, grid=PLANE).predicted
    after_plan = carried(plan, occupied, profile)
    np.testing.assert_array_equal(after_plan, predicted)
    assert after_plan[2, 1]
    assert after_plan.sum() == 5
