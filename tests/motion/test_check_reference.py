"""The checker against a naive one that follows every tweezer through many instants."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings

from labseq.errors import InvalidPlanError
from labseq.model import MotionSpec, Occupancy, Plan, TargetPattern
from labseq.motion import RULES, check_plan
from labseq.roles import Context
from labseq.testing.strategies import cases, occupancies, plans

from .naive_checker import Site, naive

Batch = tuple[list[list[int]], bool]
"""Atom moves (from row, from col, to row, to col), and whether they are linked."""


def compare(plan: Plan, occupancy: Occupancy, dop: int, motion: MotionSpec) -> str:
    """ "accepted" or the rule that both checkers find broken; fails where they differ."""
    nothing = np.zeros_like(occupancy)
    expected = naive(plan, occupancy, dop, motion)
    try:
        report = check_plan(plan, occupancy, TargetPattern(nothing, nothing), dop, motion=motion)
    except InvalidPlanError as error:
        assert expected is None, f"legal, but: {error}"
        return error.rule
    assert expected is not None, "illegal, but accepted"
    atoms, ends, n_tweezers = expected
    assert {(int(r), int(c)) for r, c in np.argwhere(report.predicted)} == atoms
    assert report.batch_end_s == pytest.approx(ends)
    assert report.n_tweezers.tolist() == n_tweezers
    return "accepted"


class RandomPlans:
    """Draws plans that are half-way sensible, so that each rule has its turn."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def motion(self) -> MotionSpec:
        tweezers, rows, cols = self.rng.integers((3, 1, 1), (21, 6, 6)).tolist()
        slots = int(self.rng.integers(0, 3))
        return MotionSpec(max_tweezers=tweezers, max_row_tones=rows, max_column_tones=cols, eject_slots=slots)

    def occupancy(self) -> Occupancy:
        return self.rng.random(self.rng.integers(1, 7, 2)) < self.rng.choice([0.2, 0.4, 0.7])

    def plan(self, occupancy: Occupancy) -> Plan:
        atoms = {(int(r), int(c)) for r, c in np.argwhere(occupancy)}
        batches: list[Batch] = []
        held: list[Site] = []
        for _ in range(self.rng.integers(1, 4)):
            linked = self.rng.random() < 0.2
            sources = held if linked else self.some_sources(atoms, occupancy.shape)
            moves = self.moves(sources, occupancy.shape)
            if not moves and self.rng.random() < 0.9:
                continue
            batches.append((moves, linked))
            held = [(r, c) for _, _, r, c in moves]
            atoms = (atoms - {(r, c) for r, c, _, _ in moves}) | set(held)
        return plan_of(batches)

    def some_sources(self, atoms: set[Site], shape: tuple[int, ...]) -> list[Site]:
        """Atoms on the crossings of a few tones; now and then a site too many or too few."""
        rows = set(self.rng.integers(0, shape[0], self.rng.integers(1, 4)).tolist())
        cols = set(self.rng.integers(0, shape[1], self.rng.integers(1, 4)).tolist())
        slip = self.rng.random() < 0.1
        sites = [site for site in product(rows, cols) if site in atoms or slip]
        if len(sites) > 2 and self.rng.random() < 0.5:
            del sites[int(self.rng.integers(len(sites)))]
        return sites

    def moves(self, sources: list[Site], shape: tuple[int, ...]) -> list[list[int]]:
        """Each tone of one axis goes somewhere; now and then an atom goes elsewhere."""
        axis = int(self.rng.integers(2))
        tones = sorted({site[axis] for site in sources})
        margin = int(self.rng.random() < 0.3)
        free = np.arange(-margin, shape[axis] + margin)
        goals = self.rng.choice(free, min(len(tones), len(free)), replace=self.rng.random() < 0.1)
        if self.rng.random() < 0.8:
            goals = np.sort(goals)
        ends = dict(zip(tones, goals.tolist(), strict=False))
        if self.rng.random() < 0.5:
            shift = int(self.rng.choice([-1, 1, 2]))
            ends = {tone: tone + shift for tone in tones}
        moves: list[list[int]] = []
        for site in sources:
            goal = list(site)
            goal[axis] = ends.get(site[axis], 0)
            if self.rng.random() < 0.05:
                goal[int(self.rng.integers(2))] += int(self.rng.integers(-2, 3))
            if list(site) != goal or self.rng.random() < 0.3:
                moves.append([*site, *goal])
        return moves


def plan_of(batches: list[Batch]) -> Plan:
    moves = np.array([move for batch, _ in batches for move in batch], np.int16).reshape(-1, 4)
    offsets = np.cumsum([0, *(len(batch) for batch, _ in batches)])
    return Plan(moves, offsets, np.array([linked for _, linked in batches], np.bool_))


def batches_of(plan: Plan) -> list[Batch]:
    offsets, moves, linked = plan.batch_offsets.tolist(), plan.moves.tolist(), plan.linked.tolist()
    return [(moves[a:b], linked[i]) for i, (a, b) in enumerate(pairwise(offsets))]


def test_random_plans() -> None:
    verdicts: Counter[str] = Counter()
    for seed in range(3000):
        draw = RandomPlans(seed)
        occupancy, motion = draw.occupancy(), draw.motion()
        dop = int(draw.rng.integers(2, 21))
        verdicts[compare(draw.plan(occupancy), occupancy, dop, motion)] += 1
    assert set(verdicts) == {"accepted", *RULES}
    assert min(verdicts.values()) >= 5, verdicts


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_legal_plans_cut_into_chains(data: st.DataObject) -> None:
    atoms = data.draw(occupancies(max_shape=(5, 5)))
    batches = batches_of(data.draw(plans(atoms)))
    chained: list[Batch] = []
    for moves, linked in batches:
        halves = [[[a, b, (a + c) // 2, (b + d) // 2] for a, b, c, d in moves]]
        halves.append([[*half[2:], *move[2:]] for half, move in zip(halves[0], moves, strict=True)])
        chained += [(halves[0], linked), (halves[1], True)]
    compare(plan_of(chained), atoms, 20, MotionSpec())


def damaged(data: st.DataObject, batches: list[Batch]) -> None:
    """Damage a plan in place, in one of many ways."""
    way = data.draw(st.sampled_from(["site", "drop", "double", "swap", "merge", "link", "split"]), "damage")
    i = data.draw(st.integers(0, len(batches) - 1), "batch")
    moves, linked = batches[i]
    k = data.draw(st.integers(0, max(0, len(moves) - 1)), "move")
    if way == "site" and moves:
        moves[k][data.draw(st.integers(0, 3))] += data.draw(st.sampled_from([-1, 1, 2]))
    elif way == "drop" and moves:
        del moves[k]
    elif way == "double" and moves:
        moves.append(list(moves[k]))
    elif way == "swap":
        j = data.draw(st.integers(0, len(batches) - 1))
        batches[i], batches[j] = batches[j], batches[i]
    elif way == "merge" and i:
        batches[i - 1][0].extend(moves)
        del batches[i]
    elif way == "link":
        batches[i] = (moves, not linked)
    elif way == "split":
        batches[i : i + 1] = [(moves[:k], linked), (moves[k:], linked)]


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_damaged_plans(data: st.DataObject) -> None:
    target, atoms = data.draw(cases((6, 6)))
    dop = data.draw(st.integers(1, 6))
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop), Context())
    plan = planner.plan(atoms, target)
    assert compare(plan, atoms, dop, MotionSpec()) == "accepted"
    batches = batches_of(plan)
    for _ in range(data.draw(st.integers(1, 2))):
        if batches:
            damaged(data, batches)
    compare(plan_of(batches), atoms, dop, MotionSpec())


@given(
    st.lists(st.tuples(*[st.integers(-(2**15), 2**15 - 1)] * 4), max_size=5),
    st.booleans(),
    st.integers(0, 2**31),
)
@settings(max_examples=200, deadline=None)
def test_any_numbers_whatever_are_checked(moves: Any, linked: bool, eject_slots: int) -> None:
    atoms = np.ones((3, 2), np.bool_)
    plan = plan_of([([list(move) for move in moves], False), ([[0, 0, 0, 1]], linked)])
    nothing = np.zeros_like(atoms)
    with pytest.raises(InvalidPlanError):
        check_plan(
            plan, atoms, TargetPattern(nothing, nothing), 20, motion=MotionSpec(eject_slots=eject_slots)
        )


def test_the_reference_refuses_something_of_each_kind() -> None:
    atoms = np.array([[1, 1, 0, 0]], np.bool_)
    legal = plan_of([([[0, 1, 0, 2]], False)])
    assert naive(legal, atoms, 1, MotionSpec()) is not None
    for move in ([0, 2, 0, 3], [0, 0, 0, 1], [0, 0, 0, 2], [0, 1, 0, 6], [0, 1, 0, -1]):
        assert naive(plan_of([([move], False)]), atoms, 1, MotionSpec()) is None
