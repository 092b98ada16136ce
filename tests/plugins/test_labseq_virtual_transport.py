"""What a tone program does to the atoms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray

from labseq import MotionSpec, SiteGrid
from labseq.testing.rf import ON, TAPE_GRID as GRID, ToneProgramBuilder

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


def test_a_column_moves_likewise() -> None:
    tape = ToneProgramBuilder().move([(0, 1), (3, 4)], [(2, 2)])
    assert after(tape, (0, 2), (3, 2), (1, 1)) == {(1, 2), (4, 2), (1, 1)}


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


def test_a_crossing_that_nobody_meant_takes_its_atom_along() -> None:
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


def test_a_grid_of_one_site_takes_the_usual_step() -> None:
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
