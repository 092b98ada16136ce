from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from labseq_rivals import kernels_lines as kernels, kernels_tetris
from numpy.typing import NDArray

from labseq import MotionSpec, TargetPattern, check_plan
from labseq.plugin.plan_kernels import add_turns, as_plan, empty_plan, finished
from labseq.testing.strategies import occupancies

Line = list[bool]


def bools(values: Any) -> NDArray[np.bool_]:
    return np.array(values, np.bool_)


def settled(atoms: Line, fill: Line, clear: Line, low: bool, high: bool) -> tuple[list[int], list[int]]:
    source, goal = kernels.settle(bools(atoms), bools(fill), bools(clear), low, high)
    return source.tolist(), goal.tolist()


def cost(source: list[int], goal: list[int], fill: Line, clear: Line) -> tuple[int, int, int, int, int]:
    """Fill sites left empty, atoms on clear sites, ejections, atoms moved or waiting to leave, distance."""
    n = len(fill)
    low, high = sum(site < 0 for site in goal), sum(site >= n for site in goal)
    distance = sum(abs(a - min(max(b, -1), n)) for a, b in zip(source, goal, strict=True))
    return (
        sum(fill) - sum(fill[site] for site in goal if 0 <= site < n),
        sum(clear[site] for site in goal if 0 <= site < n),
        low + high,
        sum(a != b for a, b in zip(source, goal, strict=True)) + low**2 + high**2,
        distance,
    )


@st.composite
def lines(draw: st.DrawFn) -> tuple[Line, Line, Line]:
    n = draw(st.integers(1, 6), "sites")
    wish = draw(st.lists(st.integers(0, 2), min_size=n, max_size=n), "1 fill, 2 clear")
    atoms = draw(st.lists(st.booleans(), min_size=n, max_size=n), "atoms")
    return atoms, [w == 1 for w in wish], [w == 2 for w in wish]


class TestSettle:
    """The arrangement of a line, against trying all there are."""

    @given(lines(), st.booleans(), st.booleans())
    @settings(max_examples=100, deadline=None)
    def test_finds_the_cheapest_arrangement(
        self, line: tuple[Line, Line, Line], low: bool, high: bool
    ) -> None:
        atoms, fill, clear = line
        n = len(atoms)
        source, goal = settled(atoms, fill, clear, low, high)
        assert source == [site for site in range(n) if atoms[site]]
        assert goal == sorted(set(goal))
        n_low, n_high = sum(site < 0 for site in goal), sum(site >= n for site in goal)
        assert low or n_low == 0
        assert high or n_high == 0
        best = min(
            cost(source, [*range(-a, 0), *inside, *range(n, n + b)], fill, clear)
            for a in range(len(source) + 1 if low else 1)
            for b in range(len(source) - a + 1 if high else 1)
            for inside in combinations(range(n), len(source) - a - b)
        )
        assert cost(source, goal, fill, clear) == best

    def test_surplus_atoms_are_distributed_over_both_ends(self) -> None:
        full = [True] * 4
        assert settled(full, [False] * 4, full, low=True, high=True)[1] == [-2, -1, 4, 5]
        assert settled(full, [False] * 4, full, low=False, high=True)[1] == [4, 5, 6, 7]
        assert settled(full, [False] * 4, full, low=False, high=False)[1] == [0, 1, 2, 3]


class TestTakeTurnsOutwards:
    """The batches of a line, as the check sees them."""

    @given(lines(), st.integers(1, 4), st.integers(1, 2), st.booleans())
    @settings(max_examples=100, deadline=None)
    def test_batches_are_legal_and_as_few_as_the_limit_allows(
        self, line: tuple[Line, Line, Line], limit: int, slots: int, is_row: bool
    ) -> None:
        atoms, fill, clear = line
        n = len(atoms)
        source, goal = settled(atoms, fill, clear, low=True, high=True)
        lists = np.array(source, np.int64), np.array(goal, np.int64)
        turns = kernels_tetris.take_turns_outwards(*lists, n, limit, slots)
        plan = as_plan(finished(add_turns(empty_plan(0), (is_row, 0, n), *lists, turns)))
        shape = (1, n) if is_row else (n, 1)
        target = TargetPattern(bools(fill).reshape(shape), bools(clear).reshape(shape))
        before = bools(atoms).reshape(shape)
        report = check_plan(plan, before, target, limit, motion=MotionSpec(eject_slots=slots))
        inside = [site for site in goal if 0 <= site < n]
        assert np.flatnonzero(report.predicted.ravel()).tolist() == inside
        n_moved = sum(a != b for a, b in zip(source, goal, strict=True))
        n_ejected = len(goal) - len(inside)
        assert plan.n_atom_moves == n_moved
        assert -(-n_moved // limit) <= plan.n_batches <= -(-n_moved // limit) + n_ejected


class TestSupplyColumns:
    @given(occupancies(max_shape=(5, 5)), st.data())
    @settings(max_examples=80, deadline=None)
    def test_every_column_gets_what_it_needs(self, atoms: NDArray[np.bool_], data: st.DataObject) -> None:
        n_rows, n_cols = atoms.shape
        needs = st.lists(st.integers(0, n_rows), min_size=n_cols, max_size=n_cols)
        need = np.array(data.draw(needs, "atoms that each column needs"), np.int64)
        assume(need.sum() <= np.count_nonzero(atoms))
        limit = data.draw(st.integers(1, 4), "limit")
        after, spare = atoms.copy(), atoms.sum(axis=0).astype(np.int64) - need
        made = finished(kernels.supply_columns(empty_plan(0), after, spare, limit))
        nothing = np.zeros(atoms.shape, np.bool_)
        report = check_plan(as_plan(made), atoms, TargetPattern(nothing, nothing), limit)
        assert np.array_equal(report.predicted, after)
        assert (after.sum(axis=0) >= need).all()
        assert np.array_equal(spare, after.sum(axis=0) - need)

    def test_all_exchanges_of_a_row_are_made_at_once(self) -> None:
        atoms = bools([[1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]])
        spare = np.array([1, 1, 0, 0, -1, -1], np.int64)
        moves, offsets, _ = finished(kernels.supply_columns(empty_plan(1), atoms, spare, 4))
        assert offsets.tolist() == [0, 4]
        assert moves[:, [1, 3]].tolist() == [[0, 2], [1, 3], [2, 4], [3, 5]]
        assert spare.tolist() == [0] * 6

    @pytest.mark.parametrize("upwards", [False, True])
    def test_an_atom_first_goes_to_the_row_of_a_vacancy(self, upwards: bool) -> None:
        atoms = bools([[1, 1], [0, 0]])
        if upwards:
            atoms = atoms[::-1].copy()
        spare = np.array([1, -1], np.int64)
        moves, _, _ = finished(kernels.supply_columns(empty_plan(1), atoms, spare, 1))
        start, end = (1, 0) if upwards else (0, 1)
        assert moves.tolist() == [[start, 0, end, 0], [end, 0, end, 1]]
