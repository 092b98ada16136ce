"""What a tone program does to the atoms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.settings import WorldSettings
from labseq_virtual.transport import FrequencyMap, Transport
from numpy.typing import NDArray

from labseq import LimitError, SiteGrid, ToneProgram
from labseq.model import AxisTones

Tone = tuple[float, float, float, float]
"""Place at start and end (sites), amplitude at start and end."""
GRID = SiteGrid(5, 6)


@dataclass
class Tape:
    """A tone program in the making, in sites instead of hertz."""

    grid: SiteGrid = GRID
    segments: list[tuple[Sequence[Tone], Sequence[Tone]]] = field(default_factory=list[Any])

    def add(self, rows: Sequence[Tone], cols: Sequence[Tone]) -> Tape:
        self.segments.append((rows, cols))
        return self

    def move(self, rows: Sequence[tuple[float, float]], cols: Sequence[tuple[float, float]]) -> Tape:
        """Pick up with a ramp of the column tones, transport, drop off."""
        moving_rows = [(a, b, 0.1, 0.1) for a, b in rows]
        self.add([(a, a, 0.1, 0.1) for a, _ in rows], [(a, a, 0.0, 0.1) for a, _ in cols])
        self.add(moving_rows, [(a, b, 0.1, 0.1) for a, b in cols])
        return self.add([(b, b, 0.1, 0.1) for _, b in rows], [(b, b, 0.1, 0.0) for _, b in cols])

    def program(self, segment_s: float = 1e-3) -> ToneProgram:
        n = len(self.segments)
        return ToneProgram(
            self._axis(0, self.grid.row_frequency_hz),
            self._axis(1, self.grid.column_frequency_hz),
            np.full(n, segment_s),
            np.zeros(n, np.int8),
            np.zeros(n, np.int32),
        )

    def _axis(self, axis: int, hz: NDArray[np.float64]) -> AxisTones:
        tones = [np.array(segment[axis], float).reshape(-1, 4) for segment in self.segments]
        start, end, on, off = np.concatenate(tones or [np.empty((0, 4))]).T
        offsets = np.cumsum([0, *map(len, tones)]).astype(np.int32)
        step = hz[1] - hz[0] if len(hz) > 1 else 1.6e6
        return AxisTones(offsets, hz[0] + start * step, hz[0] + end * step, on, off, np.zeros(len(on)))


def atoms(*sites: tuple[int, int], grid: SiteGrid = GRID) -> NDArray[np.bool_]:
    occupied = np.zeros(grid.shape, np.bool_)
    for site in sites:
        occupied[site] = True
    return occupied


def after(
    tape: Tape, *sites: tuple[int, int], n_segments: int | None = None, **physics: Any
) -> set[tuple[int, int]]:
    """Where the atoms are after a program."""
    occupied = atoms(*sites, grid=tape.grid)
    transport = Transport(tape.grid, WorldSettings.model_validate({"transport_loss": 0.0} | physics))
    n = len(tape.segments) if n_segments is None else n_segments
    transport.carry(occupied, tape.program(), n, np.random.default_rng(0), 1.0)
    return {(int(r), int(c)) for r, c in np.argwhere(occupied)}


def test_a_line_shifts_by_one_into_the_free_site() -> None:
    tape = Tape().move([(2, 2)], [(0, 1), (1, 2), (2, 3)])
    assert after(tape, (2, 0), (2, 1), (2, 2)) == {(2, 1), (2, 2), (2, 3)}


def test_a_column_moves_likewise() -> None:
    tape = Tape().move([(0, 1), (3, 4)], [(2, 2)])
    assert after(tape, (0, 2), (3, 2), (1, 1)) == {(1, 2), (4, 2), (1, 1)}


def test_rows_and_columns_of_tones_make_a_block_of_tweezers() -> None:
    tape = Tape().move([(0, 0), (1, 1)], [(0, 2), (1, 3)])
    assert after(tape, (0, 0), (0, 1), (1, 0), (1, 1)) == {(0, 2), (0, 3), (1, 2), (1, 3)}


def test_a_tweezer_that_finds_no_atom_moves_nothing() -> None:
    tape = Tape().move([(0, 0)], [(0, 3), (1, 4)])
    assert after(tape, (0, 1), (3, 3)) == {(0, 4), (3, 3)}


@pytest.mark.parametrize(
    ("off_by", "taken"), [(0.0, True), (0.24, True), (0.26, False), (-0.26, False), (0.5, False)]
)
@pytest.mark.parametrize("axis", ["row", "column"])
def test_a_pick_up_takes_only_what_is_within_the_tolerance(off_by: float, taken: bool, axis: str) -> None:
    row, col = (2 + off_by, 2.0) if axis == "row" else (2.0, 2 + off_by)
    there_and_gone = Tape().add([(row, row, 0.1, 0.1)], [(col, col, 0.0, 0.1)])
    assert after(there_and_gone, (2, 2)) == (set() if taken else {(2, 2)})


def test_an_atom_set_down_between_sites_is_lost() -> None:
    assert after(Tape().move([(0, 0)], [(0, 2.4)]), (0, 0)) == set()
    assert after(Tape().move([(0, 0)], [(0, 2.2)]), (0, 0)) == {(0, 2)}


@pytest.mark.parametrize(
    ("rows", "cols"),
    [([(2, 2)], [(0, -1)]), ([(2, 2)], [(0, 6)]), ([(2, -1)], [(0, 0)]), ([(2, 5)], [(0, 0)])],
)
def test_an_atom_that_ends_outside_of_the_grid_is_gone(rows: Any, cols: Any) -> None:
    assert after(Tape().move(rows, cols), (2, 0), (4, 5)) == {(4, 5)}


def test_ejection_takes_the_outermost_atom_only() -> None:
    assert after(Tape().move([(2, 2)], [(0, -1), (1, 0)]), (2, 0), (2, 1), (2, 2)) == {(2, 0), (2, 2)}


def test_two_atoms_on_one_site_are_both_lost() -> None:
    assert after(Tape().move([(0, 0)], [(0, 3)]), (0, 0), (0, 3), (1, 3)) == {(1, 3)}


def test_two_atoms_on_one_site_are_both_lost_however_the_second_came() -> None:
    creep = Tape().add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)])  # small jumps, never a sweep
    for place in (0.2, 0.4, 0.6, 0.8):
        creep.add([(0, 0, 0.1, 0.1)], [(place, place, 0.1, 0.1)])
    creep.add([(0, 0, 0.1, 0.1)], [(1, 1, 0.1, 0.0)])
    assert after(creep, (0, 0)) == {(0, 1)}
    assert after(creep, (0, 0), (0, 1)) == set()


def test_a_loaded_tweezer_and_the_atom_in_its_way_are_both_lost_and_the_next_passes() -> None:
    tape = Tape().move([(0, 0)], [(0, 4), (1, 5)])
    assert after(tape, (0, 0), (0, 1), (0, 3)) == {(0, 4)}


def test_an_empty_tweezer_throws_out_the_atom_in_its_way() -> None:
    assert after(Tape().move([(0, 0)], [(0, 4)]), (0, 2), (1, 2)) == {(1, 2)}


def test_the_first_loaded_tweezer_is_lost_wherever_it_hits() -> None:
    tape = Tape().move([(0, 0)], [(1, 4), (2, 5)])
    assert after(tape, (0, 1), (0, 2), (0, 3), (0, 4)) == {(0, 4)}


def test_a_crossing_that_nobody_meant_takes_its_atom_along() -> None:
    tape = Tape().move([(0, 0), (3, 3)], [(0, 1), (4, 5)])
    assert after(tape, (0, 0), (3, 4), (3, 0)) == {(0, 1), (3, 5), (3, 1)}


def test_a_diagonal_move_hits_what_lies_on_its_line_only() -> None:
    tape = Tape().move([(0, 2)], [(0, 2)])
    assert after(tape, (0, 0), (1, 0), (0, 1)) == {(2, 2), (1, 0), (0, 1)}
    assert after(tape, (0, 0), (1, 1)) == set()


def test_tweezers_that_stay_on_turn_a_corner() -> None:
    corner = (
        Tape()
        .add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)])
        .add([(0, 0, 0.1, 0.1)], [(0, 3, 0.1, 0.1)])
        .add([(0, 4, 0.1, 0.1)], [(3, 3, 0.1, 0.1)])
        .add([(4, 4, 0.1, 0.0)], [(3, 3, 0.1, 0.1)])
    )
    assert after(corner, (0, 0), (2, 2)) == {(4, 3), (2, 2)}


@pytest.mark.parametrize(("jump", "kept"), [(0.2, True), (0.3, False), (3.0, False)])
def test_a_tone_that_jumps_loses_its_atom(jump: float, kept: bool) -> None:
    tape = Tape().add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)])
    tape.add([(0, 0, 0.1, 0.1)], [(jump, 2, 0.1, 0.1)]).add([(0, 0, 0.1, 0.1)], [(2, 2, 0.1, 0.0)])
    assert after(tape, (0, 0)) == ({(0, 2)} if kept else set())


def test_a_tone_that_goes_out_between_segments_loses_its_atom() -> None:
    tape = Tape().add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)])
    tape.add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)]).add([(0, 0, 0.1, 0.1)], [(0, 0, 0.1, 0.0)])
    assert after(tape, (0, 0)) == set()


def test_tones_may_change_their_order_in_the_list() -> None:
    tape = Tape().add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1), (3, 3, 0.0, 0.1)])
    tape.add([(0, 0, 0.1, 0.0)], [(3, 3, 0.1, 0.1), (0, 0, 0.1, 0.1)])
    assert after(tape, (0, 0), (1, 1)) == {(0, 0), (1, 1)}


def test_atoms_still_held_at_the_end_are_lost() -> None:
    tape = Tape().move([(0, 0)], [(0, 2)])
    assert after(tape, (0, 0), (4, 4), n_segments=2) == {(4, 4)}
    assert after(tape, (0, 0), (4, 4), n_segments=0) == {(0, 0), (4, 4)}


def test_a_pause_between_batches_needs_no_tones() -> None:
    tape = Tape().move([(0, 0)], [(0, 2)]).add([], []).move([(0, 0)], [(2, 3)])
    assert after(tape, (0, 0)) == {(0, 3)}


@pytest.mark.parametrize("ends", [(3, 0), (1.9, 2.3), (2, 2)])
def test_tones_that_meet_or_pass_lose_their_atoms(ends: tuple[float, float]) -> None:
    tape = Tape().move([(0, 0)], [(0, ends[0]), (3, ends[1]), (5, 5)])
    assert after(tape, (0, 0), (0, 3), (0, 5)) == {(0, 5)}


def test_a_tone_without_light_disturbs_nothing() -> None:
    dark = [(0.0, 5.0, 0.0, 0.0)]
    tape = Tape().add([(0, 0, 0.1, 0.1)], [(0, 0, 0.0, 0.1)])
    tape.add([(0, 0, 0.1, 0.1)], [(0, 2, 0.1, 0.1), *dark]).add([(0, 0, 0.1, 0.1)], [(2, 2, 0.1, 0.0)])
    assert after(tape, (0, 0), (0, 4)) == {(0, 2), (0, 4)}


@pytest.mark.parametrize("sign", [1, -1])
def test_frequencies_may_rise_or_fall_and_go_on_beyond_the_grid(sign: int) -> None:
    hz = 100e6 + sign * np.array([0.0, 1.0, 2.1]) * 1e6
    places = FrequencyMap(hz, 1e6, "row").sites(100e6 + sign * np.array([-1.0, 0.5, 1.0, 2.1, 3.2]) * 1e6)
    np.testing.assert_allclose(places, [-1.0, 0.5, 1.0, 2.0, 3.0])


def test_frequencies_out_of_order_are_refused() -> None:
    with pytest.raises(LimitError, match="column frequencies"):
        FrequencyMap(np.array([1.0, 3.0, 2.0]), 1.0, "column")


def test_a_grid_of_one_site_takes_the_usual_step() -> None:
    tape = Tape(SiteGrid(1, 2)).move([(0, 0)], [(0, 1)])
    assert after(tape, (0, 0)) == {(0, 1)}
    lone = FrequencyMap(np.array([100e6]), 1.6e6, "row")
    np.testing.assert_allclose(lone.sites(np.array([98.4e6, 101.6e6])), [-1.0, 1.0])


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_a_legal_shift_of_a_whole_line_does_exactly_what_it_says(data: st.DataObject) -> None:
    n_cols = GRID.n_cols
    columns = st.lists(st.integers(0, n_cols - 1), min_size=1, max_size=n_cols, unique=True).map(sorted)
    sources = data.draw(columns)
    n = len(sources)
    goals = sorted(data.draw(st.lists(st.integers(-1, n_cols), min_size=n, max_size=n, unique=True)))
    others = data.draw(st.sets(st.tuples(st.sampled_from([0, 1, 3, 4]), st.integers(0, n_cols - 1))))
    tape = Tape().move([(2, 2)], list(zip(sources, goals, strict=True)))
    expected = others | {(2, c) for c in goals if 0 <= c < n_cols}
    assert after(tape, *others, *((2, c) for c in sources)) == expected


TONES = st.lists(
    st.tuples(st.floats(-2, 7), st.floats(-2, 7), st.sampled_from([0.0, 0.1]), st.sampled_from([0.0, 0.1])),
    max_size=3,
)


@given(
    st.lists(st.tuples(TONES, TONES), max_size=5), st.sets(st.tuples(st.integers(0, 4), st.integers(0, 5)))
)
@settings(max_examples=200, deadline=None)
def test_no_program_makes_atoms(segments: list[Any], sites: set[tuple[int, int]]) -> None:
    assert len(after(Tape(segments=segments), *sites)) <= len(sites)


def survivors(n_repeats: int, n_tones: int, loss_factor: float = 1.0, **physics: float) -> int:
    """How many of 5 atoms, carried ``n_repeats`` times with ``n_tones`` column tones, survive in all."""
    cols = [(0, 1), *((c, c) for c in range(2, n_tones + 1))]
    program = Tape().move([(r, r) for r in range(5)], cols).program()
    transport, rng = Transport(GRID, WorldSettings.model_validate(physics)), np.random.default_rng(2)
    total = 0
    for _ in range(n_repeats):
        occupied = atoms(*((r, 0) for r in range(5)))
        transport.carry(occupied, program, 3, rng, loss_factor)
        total += int(occupied.sum())
    return total


def within_four_sigma(count: int, n: int, p: float) -> bool:
    return abs(count - n * p) < 4 * np.sqrt(n * p * (1 - p))


def test_moved_atoms_are_lost_with_the_transport_loss() -> None:
    assert within_four_sigma(survivors(1000, 1, transport_loss=0.2), 5000, 0.8)
    assert within_four_sigma(survivors(1000, 1, transport_loss=0.2, loss_factor=2.0), 5000, 0.6)
    assert survivors(20, 1, transport_loss=0.4, loss_factor=4.0) == 0


def test_each_further_tone_adds_to_the_loss() -> None:
    physics = {"transport_loss": 0.1, "transport_loss_per_tone": 0.05}
    further = 4 + 2  # five row tones and three column tones are on
    assert within_four_sigma(survivors(1000, 3, **physics), 5000, 1 - (0.1 + 0.05 * further))


def test_atoms_that_are_not_moved_are_not_lost() -> None:
    tape = Tape().move([(0, 0)], [(0, 2)])
    assert after(tape, (4, 4), (0, 5), transport_loss=1.0) == {(4, 4), (0, 5)}
