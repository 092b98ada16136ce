"""The check of plans: every rule, by examples and against a naive checker."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray

from labseq.errors import InvalidPlanError, LimitError
from labseq.model import Batch, MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import RULES, check_plan
from labseq.roles import Context
from labseq.testing.strategies import cases, occupancies, plans

from .naive_checker import Site, naive

Move = tuple[int, int, int, int]


def grid_of(text: str) -> NDArray[np.bool_]:
    """Rows of a picture: # is an atom."""
    return np.array([[site == "#" for site in row] for row in text.split()])


def batch(*moves: Move, linked: bool = False) -> Batch:
    table = np.array(moves, np.int16).reshape(-1, 4)
    return Batch(table[:, :2], table[:, 2:], linked)


def check(atoms: str, *batches: Batch, dop: int = 20, **options: Any) -> PlanReport:
    occupancy = grid_of(atoms)
    nothing = np.zeros_like(occupancy)
    target = TargetPattern(nothing, nothing)
    motion = MotionSpec(**options)
    return check_plan(Plan.from_batches(batches), occupancy, target, dop, motion=motion, planner="test")


def refusal(atoms: str, *batches: Batch, dop: int = 20, **options: Any) -> InvalidPlanError:
    with pytest.raises(InvalidPlanError) as error:
        check(atoms, *batches, dop=dop, **options)
    assert error.value.planner == "test"
    return error.value


@pytest.mark.parametrize(
    ("atoms", "batches", "after", "n_tweezers"),
    [
        ("#.", [], "#.", []),
        # a line shifts onto the places that it frees
        ("###.", [batch((0, 0, 0, 1), (0, 1, 0, 2), (0, 2, 0, 3))], ".###", [3]),
        # rows and columns at once; a crossing without an atom counts, too
        ("#.#. .... ..#.", [batch((0, 0, 0, 1), (0, 2, 0, 3), (2, 2, 2, 3))], ".#.# .... ...#", [4]),
        # round a corner, while another atom of the chain waits
        (
            "#.#. .... ....",
            [batch((0, 0, 0, 1), (0, 2, 0, 2)), batch((0, 1, 2, 1), (0, 2, 2, 2), linked=True)],
            ".... .... .##.",
            [2, 2],
        ),
        # ejections to all sides
        (".#. ...", [batch((0, 1, 0, -1))], "... ...", [1]),
        (".#. ...", [batch((0, 1, 2, 1))], "... ...", [1]),
        ("##. ..#", [batch((0, 0, 0, -2), (0, 1, 0, -1)), batch((1, 2, 1, 4))], "... ...", [2, 1]),
    ],
)
def test_legal_plans(atoms: str, batches: list[Batch], after: str, n_tweezers: list[int]) -> None:
    report = check(atoms, *batches, dop=4, eject_slots=2)
    assert report.predicted.tolist() == grid_of(after).tolist()
    assert report.n_tweezers.tolist() == n_tweezers


def test_the_occupancy_is_left_untouched_and_the_report_read_only() -> None:
    occupancy = grid_of("#.")
    report = check_plan(
        Plan.from_batches([batch((0, 0, 0, 1))]), occupancy, TargetPattern(~occupancy, occupancy), 1
    )
    assert occupancy.tolist() == [[True, False]]
    assert report.meets_target
    for array in (report.predicted, report.batch_end_s, report.n_tweezers):
        assert not array.flags.writeable


def test_defects_and_surplus_are_counted_after_the_plan() -> None:
    target = TargetPattern(grid_of("##.. ...."), grid_of("..## #..."))
    report = check_plan(Plan.from_batches([batch((1, 0, 1, 1))]), grid_of("#.## #..."), target, 1)
    assert (report.n_defects, report.n_surplus) == (1, 2)
    assert not report.meets_target


def test_times() -> None:
    """A site takes 1 s; linked batches need no overhead and no ramps."""
    motion = MotionSpec(pick_up_s=3.0, drop_off_s=5.0, speed_m_s=10e-6)
    motion = replace(motion, overhead_per_batch_s=100.0, overhead_per_cycle_s=1000.0)
    plan = [
        batch((0, 0, 0, 1), (0, 2, 0, 5)),
        batch((0, 5, 1, 5)),
        batch((1, 5, 1, 3), linked=True),
        batch((0, 1, 0, -1)),
    ]
    atoms = grid_of("#.#... ......")
    target, grid = TargetPattern(atoms & ~atoms, atoms & ~atoms), SiteGrid(2, 6, spacing_m=10e-6)
    report = check_plan(Plan.from_batches(plan), atoms, target, 2, grid=grid, motion=motion)
    assert report.batch_end_s == pytest.approx([1111, 1111 + 104, 1215 + 7, 1222 + 110])
    assert report.duration_s == report.batch_end_s[-1]


@pytest.mark.parametrize(
    ("rule", "words", "atoms", "batches", "options"),
    [
        ("shape", "no atom moves", "#..", [batch()], {}),
        ("shape", "no atom moves", "#..", [batch((0, 0, 0, 1)), batch()], {}),
        ("grid", r"\(0, 5\) is outside the grid of 1 x 3", "#..", [batch((0, 5, 0, 1))], {}),
        ("grid", r"\(-1, 0\)", "#..", [batch((-1, 0, 0, 0))], {}),
        ("grid", "within 1 site", "#..", [batch((0, 0, 0, -2))], {}),
        ("grid", "within 0 site", "#..", [batch((0, 0, 0, -1))], {"eject_slots": 0}),
        ("straight", "changes row and column", "#.. ...", [batch((0, 0, 1, 1))], {}),
        ("straight", "goes nowhere", "#.#", [batch((0, 0, 0, 1), (0, 2, 0, 2))], {}),
        ("straight", "0 follows a row, 1 a column", "#.. ..#", [batch((0, 0, 0, 1), (1, 2, 0, 2))], {}),
        ("linked", "first batch", "#..", [batch((0, 0, 0, 1), linked=True)], {}),
        (
            "linked",
            "ejects",
            "#.#",
            [batch((0, 0, 0, -1)), batch((0, 2, 0, 1), linked=True)],
            {},
        ),
        (
            "linked",
            "moves 1 atoms but the batch before holds 2",
            "#.#.",
            [batch((0, 0, 0, 1), (0, 2, 0, 3)), batch((0, 1, 0, 0), linked=True)],
            {},
        ),
        (
            "linked",
            r"\(0, 2\) is not a goal",
            "#.#.",
            [batch((0, 0, 0, 1)), batch((0, 2, 0, 3), linked=True)],
            {},
        ),
        ("source", r"no atom on \(0, 1\)", "#..", [batch((0, 1, 0, 2))], {}),
        ("source", r"starts from \(0, 0\) too", "#..", [batch((0, 0, 0, 1), (0, 0, 0, 2))], {}),
        ("goal", "ends on an atom that stays", "#.#", [batch((0, 0, 0, 2))], {}),
        ("goal", r"ends on \(0, 1\) too", "#.#", [batch((0, 0, 0, 1), (0, 2, 0, 1))], {}),
        ("tones", "column 0 goes to column 1", "#.. #..", [batch((0, 0, 0, 1), (1, 0, 1, 2))], {}),
        ("tones", "row 0 goes to row 1", "##. ... ...", [batch((0, 0, 1, 0), (0, 1, 2, 1))], {}),
        (
            "tones",
            "2 row tones; the limit is 1",
            "#.. .#.",
            [batch((0, 0, 0, 1), (1, 1, 1, 2))],
            {"max_row_tones": 1},
        ),
        (
            "tones",
            "3 column tones; the limit is 2",
            "###.",
            [batch((0, 0, 0, 1), (0, 1, 0, 2), (0, 2, 0, 3))],
            {"max_column_tones": 2},
        ),
        ("order", "columns 0 and 1", "##..", [batch((0, 0, 0, 3), (0, 1, 0, 2))], {}),
        ("order", "rows 0 and 1", "#. .# .. ..", [batch((0, 0, 3, 0), (1, 1, 3, 1))], {}),
        ("order", "columns 0 and 2", "#.#", [batch((0, 0, 0, -1), (0, 2, 0, -1))], {}),
        (
            "parallelism",
            "1 row x 3 column tones make 3 tweezers; the limit is 2",
            "###.",
            [batch((0, 0, 0, 1), (0, 1, 0, 2), (0, 2, 0, 3))],
            {"dop": 2},
        ),
        ("parallelism", "limit is 3", "#... ..#.", [batch((0, 0, 0, 1), (1, 2, 1, 3))], {"max_tweezers": 3}),
        ("crossing", r"\(0, 2\)", "#.#. ..#.", [batch((0, 0, 0, 1), (1, 2, 1, 3))], {}),
        ("path", r"atom on \(0, 1\)", "##..", [batch((0, 0, 0, 2))], {}),
        ("path", r"atom on \(0, 3\)", "#..# ..#.", [batch((0, 0, 0, 1), (1, 2, 1, 3))], {}),
        ("ejection", r"one on \(0, 0\)", "##.", [batch((0, 1, 0, -1))], {}),
        ("ejection", r"one on \(2, 1\)", ".#. ... .#.", [batch((0, 1, 3, 1))], {}),
    ],
)  # fmt: skip
def test_each_rule(rule: str, words: str, atoms: str, batches: list[Batch], options: Any) -> None:
    error = refusal(atoms, *batches, **options)
    assert error.rule == rule
    assert error.batch == len(batches) - 1
    with pytest.raises(InvalidPlanError, match=words):
        raise error


def test_a_later_chunk_of_the_line_stands() -> None:
    first, second = batch((0, 0, 0, 1), (0, 1, 0, 2)), batch((0, 2, 0, 3))
    assert refusal("###.", first, second).rule == "goal"
    check("###.", second, first)


def test_the_error_names_the_batch_and_the_atom_move() -> None:
    error = refusal("##..", batch((0, 1, 0, 2)), batch((0, 2, 0, 3), (0, 1, 0, 2)))
    assert (error.batch, error.move, error.rule) == (1, 1, "source")
    assert all(words in str(error) for words in ("'test'", "batch 1", "atom move 1", "'source'", "(0, 1)"))


class TestShape:
    TARGET = TargetPattern(grid_of("#."), grid_of(".#"))
    PLAN = Plan.from_batches([])

    def test_what_is_no_plan(self) -> None:
        with pytest.raises(InvalidPlanError, match=r"'shape': expected a Plan .* list"):
            check_plan([], grid_of("#."), self.TARGET, 1)  # pyright: ignore[reportArgumentType]

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"target": grid_of("#.")}, "'shape': expected a TargetPattern as target, not ndarray"),
            ({"grid": (1, 2)}, "'shape': expected a SiteGrid as grid, not tuple"),
        ],
    )
    def test_arguments_that_were_mixed_up(self, given: dict[str, Any], message: str) -> None:
        arguments: dict[str, Any] = {"target": self.TARGET, "degree_of_parallelism": 1, **given}
        with pytest.raises(InvalidPlanError, match=message):
            check_plan(self.PLAN, grid_of("#."), **arguments)

    @pytest.mark.parametrize("dop", ["7", 1.5, 0])
    def test_the_degree_of_parallelism_is_a_whole_number_above_0(self, dop: Any) -> None:
        with pytest.raises(LimitError, match=rf"degree of parallelism is .*{dop}"):
            check_plan(self.PLAN, grid_of("#."), self.TARGET, dop)
        assert check_plan(self.PLAN, grid_of("#."), self.TARGET, np.int64(1))  # pyright: ignore[reportArgumentType]

    @pytest.mark.parametrize(
        ("occupancy", "grid"),
        [
            (grid_of("#.."), None),
            (grid_of("#..."), SiteGrid(1, 4)),
            (grid_of("#."), SiteGrid(2, 1)),
            ([[0.5, 1.0]], None),
            ([1, 0], None),
        ],
    )
    def test_occupancy_target_and_grid_belong_together(self, occupancy: Any, grid: SiteGrid | None) -> None:
        with pytest.raises(InvalidPlanError) as error:
            check_plan(self.PLAN, occupancy, self.TARGET, 1, grid=grid)
        assert error.value.rule == "shape"
        assert error.value.batch == -1

    def test_any_layout_and_type_of_zeros_and_ones(self) -> None:
        for occupancy in ([[1, 0]], np.array([[1.0, 0.0]]), np.array([[1], [0]], np.uint8).T):
            assert check_plan(self.PLAN, occupancy, self.TARGET, 1).meets_target


PlainBatch = tuple[list[list[int]], bool]
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
        batches: list[PlainBatch] = []
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


def plan_of(batches: list[PlainBatch]) -> Plan:
    moves = np.array([move for batch, _ in batches for move in batch], np.int16).reshape(-1, 4)
    offsets = np.cumsum([0, *(len(batch) for batch, _ in batches)])
    return Plan(moves, offsets, np.array([linked for _, linked in batches], np.bool_))


def batches_of(plan: Plan) -> list[PlainBatch]:
    offsets, moves, linked = plan.batch_offsets.tolist(), plan.moves.tolist(), plan.linked.tolist()
    return [(moves[a:b], linked[i]) for i, (a, b) in enumerate(pairwise(offsets))]


def test_random_plans() -> None:
    verdicts: Counter[str] = Counter()
    for seed in range(1500):
        draw = RandomPlans(seed)
        occupancy, motion = draw.occupancy(), draw.motion()
        dop = int(draw.rng.integers(2, 21))
        verdicts[compare(draw.plan(occupancy), occupancy, dop, motion)] += 1
    assert set(verdicts) == {"accepted", *RULES}
    assert min(verdicts.values()) >= 2, verdicts


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_legal_plans_cut_into_chains(data: st.DataObject) -> None:
    atoms = data.draw(occupancies(max_shape=(5, 5)))
    batches = batches_of(data.draw(plans(atoms)))
    chained: list[PlainBatch] = []
    for moves, linked in batches:
        halves = [[[a, b, (a + c) // 2, (b + d) // 2] for a, b, c, d in moves]]
        halves.append([[*half[2:], *move[2:]] for half, move in zip(halves[0], moves, strict=True)])
        chained += [(halves[0], linked), (halves[1], True)]
    compare(plan_of(chained), atoms, 20, MotionSpec())


def damaged(data: st.DataObject, batches: list[PlainBatch]) -> None:
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
@settings(max_examples=100, deadline=None)
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
    st.integers(0, 100),
)
@settings(max_examples=60, deadline=None)
def test_any_numbers_are_checked(moves: Any, linked: bool, eject_slots: int) -> None:
    atoms = np.ones((3, 2), np.bool_)
    plan = plan_of([([list(move) for move in moves], False), ([[0, 0, 0, 1]], linked)])
    nothing = np.zeros_like(atoms)
    with pytest.raises(InvalidPlanError):
        check_plan(
            plan, atoms, TargetPattern(nothing, nothing), 20, motion=MotionSpec(eject_slots=eject_slots)
        )
