"""The kernels of PSCA against brute force, and by examples."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from labseq_psca import kernels_fewest, kernels_lines, kernels_paper, kernels_repair, kernels_rows
from numpy.typing import NDArray

Sites = list[int]


def bools(values: Any) -> NDArray[np.bool_]:
    return np.array(values, np.bool_)


def ints(values: Sequence[int]) -> NDArray[np.int64]:
    return np.array(values, np.int64)


def work(n: int, n_rows: int = 1) -> kernels_fewest.Work:
    step, lists, rank = (
        np.zeros((n, n + 1), np.int8),
        np.zeros((3, n), np.int64),
        np.zeros(n_rows, np.int64),
    )
    return np.zeros(n + 1, np.int64), step, lists, rank


class TestCompress:
    """The goals of a line's atoms, against trying all there are."""

    @staticmethod
    def kernel(source: Sites, fill: Sequence[bool], clear: Sequence[bool], limit: int, slots: int) -> Sites:
        n = len(fill)
        goal = np.zeros(n, np.int64)
        cost, step = np.zeros((n, 2 * n + 1), np.int64), np.zeros((n, 2 * n + 1), np.int16)
        goal = goal[: len(source)]
        assert kernels_lines.compress(ints(source), bools(fill), bools(clear), limit, slots, cost, step, goal)
        return goal.tolist()

    @staticmethod
    def cost(source: Sites, goal: Sites, clear: Sequence[bool], limit: int) -> tuple[int, int, int, int]:
        """Sites not cleared, ejections, batches' worth of atoms moved or waiting, distance."""
        n = len(clear)
        not_cleared = sum(clear[site] for site in goal if 0 <= site < n)
        low, high = sum(site < 0 for site in goal), sum(site >= n for site in goal)
        moved = sum(a != b for a, b in zip(source, goal, strict=True))
        waiting = sum(range(low)) + sum(range(high))
        ends = [min(max(site, -1), n) for site in goal]
        distance = sum(abs(a - b) for a, b in zip(source, ends, strict=True))
        return not_cleared, low + high, moved + limit * waiting, distance

    @given(st.data())
    @settings(max_examples=100, deadline=None)
    def test_finds_the_cheapest_goals(self, data: st.DataObject) -> None:
        n = data.draw(st.integers(1, 6), "sites")
        wish = data.draw(st.lists(st.integers(0, 2), min_size=n, max_size=n), "1 fill, 2 clear")
        fill, clear = [w == 1 for w in wish], [w == 2 for w in wish]
        atoms = data.draw(st.lists(st.booleans(), min_size=n, max_size=n), "atoms")
        source = [site for site in range(n) if atoms[site]]
        assume(len(source) >= max(1, sum(fill)))
        slots, limit = data.draw(st.integers(0, 1), "slots"), data.draw(st.integers(1, 4), "limit")

        beyond = len(source) if slots else 0
        choices = combinations(range(-beyond, n + beyond), len(source))
        full = [site for site in range(n) if fill[site]]
        costs = [self.cost(source, list(goal), clear, limit) for goal in choices if set(full) <= set(goal)]
        goal = self.kernel(source, fill, clear, limit, slots)
        assert set(full) <= set(goal)
        assert goal == sorted(set(goal))
        assert self.cost(source, goal, clear, limit) == min(costs)

    def test_ejections_are_distributed_over_both_sides(self) -> None:
        goal = self.kernel([0, 1, 2, 3], [False] * 4, [True] * 4, 4, 1)
        assert [site < 0 for site in goal] == [True, True, False, False]

    def test_too_few_atoms_for_the_fill_sites(self) -> None:
        cost, step = np.zeros((2, 5), np.int64), np.zeros((2, 5), np.int16)
        fill, clear = bools([True, True]), bools([False, False])
        assert not kernels_lines.compress(ints([0]), fill, clear, 1, 1, cost, step, ints([0]))


class TestFillBatch:
    """Which atoms of a line go together."""

    @given(st.data())
    @settings(max_examples=100, deadline=None)
    def test_the_way_is_free_and_no_batch_is_wasted(self, data: st.DataObject) -> None:
        n = data.draw(st.integers(1, 8), "sites")
        source = sorted(data.draw(st.sets(st.integers(0, n - 1), min_size=1), "atoms"))
        reach = st.sets(st.integers(-2, n + 1), min_size=len(source), max_size=len(source))
        goal = sorted(data.draw(reach, "goals"))
        limit, slots = data.draw(st.integers(1, 4), "limit"), data.draw(st.integers(1, 2), "slots")
        moving = [(a, b) for a, b in zip(source, goal, strict=True) if a != b]
        staying = {a for a, b in zip(source, goal, strict=True) if a == b}
        source, goal = [a for a, _ in moving], [b for _, b in moving]
        turn = ints([0] * len(moving))
        place = dict(enumerate(source))
        batch = 0
        while 0 in turn:
            batch += 1
            chosen = kernels_lines.fill_batch(ints(source), ints(goal), n, limit, slots, turn, batch)
            going = [i for i in place if turn[i] == batch]
            assert 0 < len(going) == chosen <= limit
            assert sum(goal[i] < 0 for i in going) <= slots
            assert sum(goal[i] >= n for i in going) <= slots
            for i, other in product(going, place):
                if other not in going:  # it stands
                    assert not min(place[i], goal[i]) <= place[other] <= max(place[i], goal[i])
            for i, site in product(going, staying):
                assert not min(place[i], goal[i]) <= site <= max(place[i], goal[i])
            for i in going:
                place[i] = goal[i]
                if not 0 <= goal[i] < n:
                    del place[i]
        n_ejected = max(sum(site < 0 for site in goal), sum(site >= n for site in goal))
        n_moved = sum(a != b for a, b in zip(source, goal, strict=True))
        if n_ejected == 0:
            assert batch == -(-n_moved // limit)


class TestBestExchange:
    """Which atoms of a row change their columns, against trying all exchanges."""

    @staticmethod
    def worth(atoms: Sequence[bool], gain: Sites, cost: Sites, change: Sequence[int]) -> int | None:
        """Gains minus costs minus atoms moved, by pairing old and new places; None if not allowed."""
        total = 0
        for col, atom in enumerate(atoms):
            fills, leaves = change[col] == 1, change[col] == -1
            if (fills and (atom or gain[col] == 0)) or (leaves and (not atom or cost[col] < 0)):
                return None
            total += fills * gain[col] - leaves * cost[col]
        if sum(change):
            return None
        before = [col for col, atom in enumerate(atoms) if atom]
        after = [col for col, atom in enumerate(atoms) if atom + change[col]]
        total -= sum(a != b for a, b in zip(before, after, strict=True))
        return total

    @given(st.data())
    @settings(max_examples=80, deadline=None)
    def test_finds_the_exchange_worth_most(self, data: st.DataObject) -> None:
        n = data.draw(st.integers(1, 7), "columns")
        atoms = data.draw(st.lists(st.booleans(), min_size=n, max_size=n), "atoms")
        gain = data.draw(st.lists(st.integers(0, 12), min_size=n, max_size=n), "gain")
        cost = data.draw(st.lists(st.integers(-1, 5), min_size=n, max_size=n), "cost")
        change = np.zeros(n, np.int64)
        found = kernels_fewest.best_exchange(bools(atoms), ints(gain), ints(cost), work(n), change)
        worths = [self.worth(atoms, gain, cost, c) for c in product((-1, 0, 1), repeat=n)]
        assert found == max(worth for worth in worths if worth is not None)
        assert self.worth(atoms, gain, cost, change.tolist()) == found

        row, count = bools([atoms]), np.zeros(n, np.int64)
        before = np.flatnonzero(row)
        n_moved = kernels_fewest.n_moved(row[0], change)
        lines = np.zeros((2, n), np.int64)
        plan = kernels_rows.sort_row(kernels_lines.empty_plan(n), row, 0, change, count, lines, n)
        moves = [[0, a, 0, b] for a, b in zip(before, np.flatnonzero(row), strict=True) if a != b]
        assert sorted(plan[0][: plan[1][plan[2]]].tolist()) == moves
        assert n_moved == len(moves)
        assert count.tolist() == change.tolist()


class TestChooseRow:
    @staticmethod
    def choose(
        atoms: Any,
        weight: Sites,
        leave: Sites,
        fill: Any = None,
        limit: int = 9,
        order: int = kernels_rows.HALF_FILLED,
    ) -> tuple[int, Sites]:
        grid = bools(atoms)
        n = grid.shape[1]
        change = np.zeros(n, np.int64)
        row = kernels_fewest.choose_row(
            grid,
            np.zeros_like(grid) if fill is None else bools(fill),
            ints(weight),
            ints(leave),
            limit,
            order,
            work(n, len(grid)),
            change,
        )
        return row, change.tolist()

    def test_takes_the_row_that_helps_most(self) -> None:
        atoms = [[1, 0, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]]
        assert self.choose(atoms, [0, 0, 90, 90], [0, 0, -1, -1]) == (1, [-1, -1, 1, 1])

    @pytest.mark.parametrize(("order", "row"), [("HALF_FILLED", 1), ("FULLEST", 0), ("EMPTIEST", 2)])
    def test_of_equals_takes_the_first_in_the_order(self, order: str, row: int) -> None:
        atoms = [[1, 0, 1, 1], [1, 0, 0, 1], [1, 0, 0, 0]]
        chosen, _ = self.choose(atoms, [0, 90, 0, 0], [0, -1, -1, -1], order=getattr(kernels_rows, order))
        assert chosen == row

    def test_prefers_to_land_on_fill_sites(self) -> None:
        atoms = [[1, 0], [1, 0]]
        assert self.choose(atoms, [0, 90], [0, -1], [[0, 0], [0, 1]])[0] == 1

    def test_no_row_helps(self) -> None:
        assert self.choose([[1, 1], [0, 0]], [0, 90], [0, -1])[0] == -1


def test_weights_of_columns() -> None:
    weight, leave = np.zeros(4, np.int64), np.zeros(4, np.int64)
    need, room, count = ints([3, 2, 0, 1]), ints([5, 5, 5, 2]), ints([1, 4, 1, 3])
    assert kernels_rows.weigh_columns(need, room, count, weight, leave) == 2
    assert weight.tolist() == [2 * (80 + 4), 0, 0, 0]
    assert leave.tolist() == [-1, 20, 0, 0]  # the last has more atoms than room


def test_unlocking_moves_the_nearest_atom_within_its_column() -> None:
    atoms = bools([[1, 1], [1, 1], [0, 0], [0, 0]])
    moves, _, n = kernels_rows.unlock_row(kernels_lines.empty_plan(8), atoms, ints([0, 90]), ints([0, -1]))
    assert (n, moves[0].tolist()) == (1, [1, 0, 2, 0])
    assert atoms.tolist() == [[True, True], [False, True], [True, False], [False, False]]
    assert kernels_rows.unlock_row(kernels_lines.empty_plan(8), atoms, ints([0, 90]), ints([-1, -1]))[2] == 0


def test_a_growing_plan_is_lengthened() -> None:
    plan = kernels_lines.empty_plan(0)
    for line in range(4):
        is_row = line % 2 == 0
        plan = kernels_lines.add_line(plan, ints([0, 1]), ints([1, 2]), 3, line, is_row, 1, 0)
    moves, offsets, n_batches = plan
    assert n_batches == 8
    assert offsets[:9].tolist() == list(range(9))
    assert moves[:4].tolist() == [[0, 1, 0, 2], [0, 0, 0, 1], [1, 1, 2, 1], [0, 1, 1, 1]]


@pytest.mark.parametrize("slots", [1, 2])
def test_ejection_slots_are_used_from_the_outermost_atom_on(slots: int) -> None:
    moves, offsets, n_batches = kernels_lines.add_line(
        kernels_lines.empty_plan(9), ints([0, 1, 3, 4]), ints([-2, -1, 5, 6]), 5, 7, True, 4, slots
    )
    batches = [moves[offsets[i] : offsets[i + 1]].tolist() for i in range(n_batches)]
    if slots == 1:
        assert batches == [[[7, 0, 7, -1], [7, 4, 7, 5]], [[7, 1, 7, -1], [7, 3, 7, 5]]]
    else:
        assert batches == [[[7, 0, 7, -2], [7, 1, 7, -1], [7, 3, 7, 5], [7, 4, 7, 6]]]


class TestPaper:
    """Each row is sorted once, and helps the columns most in need."""

    def test_rows_closest_to_half_filled_come_first(self) -> None:
        atoms = bools([[1, 1, 1, 1], [1, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 1]])
        assert kernels_paper.order_of_rows(atoms, 0).tolist() == [2, 1, 3, 0]
        assert kernels_paper.order_of_rows(atoms, -1).tolist() == [0, 3, 2, 1]
        assert kernels_paper.order_of_rows(atoms, 1).tolist() == [1, 2, 3, 0]

    def test_columns_most_in_need_are_helped_by_those_with_most_to_spare(self) -> None:
        change = np.empty(6, np.int64)
        row, need = bools([1, 0, 0, 1, 1, 0]), ints([0, 3, 3, 0, 0, 3])
        assert kernels_paper.exchange_for_need(row, need, ints([2, 1, 2, 3, 1, 0]), change) == 3
        assert change.tolist() == [-1, 1, 1, -1, -1, 1]
        assert kernels_paper.exchange_for_need(row, need, ints([0, 1, 2, 3, 1, 0]), change) == 2
        assert change.tolist() == [0, 1, 0, -1, -1, 1]

    def test_each_row_is_sorted_once_where_that_is_enough(self) -> None:
        atoms, fill = bools([[1, 0, 1], [0, 0, 1], [0, 1, 1]]), bools([[1, 0, 0], [1, 0, 0], [1, 0, 0]])
        moves, offsets = kernels_paper.plan_as_in_paper(atoms, fill, np.zeros_like(fill), 3, 3, 1, 0)
        assert len(offsets) == 3
        assert sorted(moves[:, 0].tolist()) == [1, 2, 2]


class TestRepair:
    """Defects are filled in the way that costs fewest atoms."""

    @staticmethod
    def repair(
        atoms: Any, fill: Any, clear: Any = None
    ) -> tuple[list[list[Sites]], list[bool], NDArray[np.bool_]]:
        clear = np.zeros(np.shape(fill), np.bool_) if clear is None else clear
        moves, offsets, linked, after = kernels_repair.plan_repair(
            bools(atoms), bools(fill), bools(clear), 9, 9, (0.02, 0.004, 0.0002)
        )
        return [moves[a:b].tolist() for a, b in pairwise(offsets.tolist())], linked.tolist(), after

    def test_the_nearest_of_the_four_sides(self) -> None:
        atoms = np.ones((7, 7), np.bool_)
        atoms[3, 1] = False
        fill = np.zeros((7, 7), np.bool_)
        fill[1:6, 1:6] = True
        assert self.repair(atoms, fill)[0] == [[[3, 0, 3, 1]]]

    def test_atoms_between_move_up_by_one_fill_site(self) -> None:
        batches, _, _ = self.repair([[1, 0, 1, 0, 1, 1]], [[0, 1, 1, 0, 1, 0]])
        assert batches == [[[0, 0, 0, 1]]]
        batches, _, after = self.repair([[0, 0, 1, 0, 1, 1]], [[0, 1, 1, 0, 1, 0]])
        assert batches == [[[0, 2, 0, 1], [0, 4, 0, 2], [0, 5, 0, 4]]]
        assert after.tolist() == [[False, True, True, False, True, False]]

    def test_an_atom_turns_with_its_tweezer_on(self) -> None:
        batches, linked, _ = self.repair(
            [[0, 0, 0, 1], [1, 0, 1, 1], [1, 1, 1, 1]],
            [[0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]],
        )
        assert batches == [[[0, 3, 0, 1]], [[0, 1, 1, 1]]]
        assert linked == [False, True]

    def test_a_chain_may_move_one_atom_straight_and_one_round_a_corner(self) -> None:
        batches, linked, after = self.repair([[0, 1, 0], [1, 1, 1]], [[1, 1, 0], [1, 1, 0]])
        assert batches == [[[0, 1, 0, 0]], [[1, 2, 0, 2]], [[0, 2, 0, 1]]]
        assert linked == [False, False, True]
        assert after.tolist() == [[True, True, False], [True, True, False]]

    def test_an_atom_that_must_leave_anyway_comes_first(self) -> None:
        clear = [[0, 0, 0, 0, 1]]
        assert self.repair([[1, 0, 0, 0, 1]], [[0, 1, 0, 0, 0]], clear)[0] == [[[0, 4, 0, 1]]]

    def test_defects_of_one_line_are_filled_by_one_shift(self) -> None:
        batches, _, _ = self.repair([[1, 1, 1, 0, 1, 0]], [[0, 0, 1, 1, 1, 1]])
        assert batches == [[[0, 0, 0, 2], [0, 1, 0, 3], [0, 2, 0, 4], [0, 4, 0, 5]]]

    def test_what_no_chain_can_fill_is_left(self) -> None:
        batches, _, after = self.repair([[1, 0], [0, 0]], [[1, 1], [0, 0]])
        assert batches == []
        assert after.tolist() == [[True, False], [False, False]]
