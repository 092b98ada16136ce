"""The kernels of PSCA against brute force, and by examples."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
from hypothesis import assume, given, settings, strategies as st
from labseq_psca import kernels_fewest, kernels_lines
from numpy.typing import NDArray

from labseq.plugin.plan_kernels import empty_plan, finished

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
        plan = finished(kernels_lines.sort_row(empty_plan(n), row, 0, change, count, n))
        moves = [[0, a, 0, b] for a, b in zip(before, np.flatnonzero(row), strict=True) if a != b]
        assert sorted(plan[0].tolist()) == moves
        assert n_moved == len(moves)
        assert count.tolist() == change.tolist()
