"""Planners that move one atom at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar

import labseq_single
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_single.planner import (
    CompressionPlanner,
    HcaPlanner,
    LsapPlanner,
    LsapSquaredPlanner,
    SingleTweezerPlanner,
    layers,
    travel,
)
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from labseq.plugin import Context, Occupancy, PlanError, Registry, SiteGrid, TargetPattern, check_plan
from labseq.roles import NeedsWarmUp
from labseq.testing import PlannerContract
from labseq.testing.strategies import cases

from .labseq_single_cases import distance, in_a_row, in_the_middle, journeys, loadings, plan_and_check

Factory = Callable[[Context], SingleTweezerPlanner]


class TestLsap(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(LsapPlanner, None)


class TestLsapSquared(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(LsapSquaredPlanner, None)


class TestCompression(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(CompressionPlanner, None)


class TestHca(PlannerContract):
    n_examples: ClassVar[int] = 100

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(HcaPlanner, None)


Bools = NDArray[np.bool_]

Site = tuple[int, int]

PLANNERS: Sequence[type[SingleTweezerPlanner]] = (
    LsapPlanner,
    LsapSquaredPlanner,
    CompressionPlanner,
    HcaPlanner,
)

every_planner = pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)

COMPACT = in_the_middle(np.ones((15, 15)))

ROWS, COLS = np.indices((15, 15))


@every_planner
@given(case=cases((7, 7)), eject_slots=st.integers(1, 2))
@settings(max_examples=200, deadline=None)
def test_any_target_on_any_grid(
    planner: type[SingleTweezerPlanner], case: tuple[TargetPattern, Occupancy], eject_slots: int
) -> None:
    target, atoms = case
    plan, report = plan_and_check(planner, atoms, target, eject_slots)
    missing = max(0, target.n_atoms - int(np.count_nonzero(atoms)))
    assert (report.n_defects, report.n_surplus) == (missing, 0)
    assert (np.diff(plan.batch_offsets) == 1).all()
    for way in journeys(plan):
        along_rows = [a[0] == b[0] for a, b in pairwise(way)]
        assert all(a != b for a, b in pairwise(along_rows)), "a batch goes straight on"


@every_planner
@given(case=cases((6, 6)))
@settings(max_examples=100, deadline=None)
def test_without_ejection_slots_nothing_is_ejected(
    planner: type[SingleTweezerPlanner], case: tuple[TargetPattern, Occupancy]
) -> None:
    target, atoms = case
    _, report = plan_and_check(planner, atoms, target, eject_slots=0)
    n_atoms = int(np.count_nonzero(atoms))
    n_places = int(np.count_nonzero(~target.clear))
    assert np.count_nonzero(report.predicted) == n_atoms
    assert report.n_defects == max(0, target.n_atoms - n_atoms)
    assert report.n_surplus == max(0, n_atoms - n_places)


@every_planner
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    filling=st.floats(0, 1),
    wanted=st.floats(0, 1),
)
@settings(max_examples=15, deadline=None)
def test_large_grids(
    planner: type[SingleTweezerPlanner], seed: int, shape: Site, filling: float, wanted: float
) -> None:
    rng = np.random.default_rng(seed)
    atoms = rng.random(shape) < filling
    fill = rng.random(shape) < wanted * filling
    target = TargetPattern(fill, ~fill & (rng.random(shape) < 0.3))
    _, report = plan_and_check(planner, atoms, target)
    missing = max(0, target.n_atoms - int(np.count_nonzero(atoms)))
    assert (report.n_defects, report.n_surplus) == (missing, 0)


@pytest.mark.parametrize(
    ("planner", "most_moves"),
    [(LsapPlanner, 167), (LsapSquaredPlanner, 188), (CompressionPlanner, 144.5), (HcaPlanner, 85)],
)
def test_mean_number_of_moves_of_the_papers_array(
    planner: type[SingleTweezerPlanner], most_moves: float
) -> None:
    n_moves: list[int] = []
    for atoms in loadings(200):
        plan, report = plan_and_check(planner, atoms, COMPACT)
        assert report.meets_target
        n_moves.append(len(journeys(plan)))
        assert n_moves[-1] >= COMPACT.n_defects(atoms)
    assert np.mean(n_moves) <= most_moves


def test_the_cluster_algorithm_needs_hardly_more_moves_than_there_are_defects_at_half_filling() -> None:
    target = in_the_middle(np.ones((10, 10)))
    arrays = loadings(100, filling=0.5)
    n_moves = sum(len(journeys(plan_and_check(HcaPlanner, atoms, target)[0])) for atoms in arrays)
    assert n_moves <= 1.07 * sum(target.n_defects(atoms) for atoms in arrays)


@every_planner
@pytest.mark.parametrize(
    "pattern",
    [~((ROWS % 2 == 1) & (COLS % 2 == 1)), (ROWS + COLS) % 3 > 0, (ROWS + COLS) % 2 == 0, (ROWS & COLS) == 0],
    ids=["kagome", "honeycomb", "checkerboard", "sierpinski"],
)
def test_sparse_targets_are_filled_and_cleared(planner: type[SingleTweezerPlanner], pattern: Bools) -> None:
    target = in_the_middle(pattern)
    for atoms in loadings(10):
        assert plan_and_check(planner, atoms, target)[1].meets_target


@every_planner
def test_a_target_over_the_whole_grid_ejects_what_is_too_much(planner: type[SingleTweezerPlanner]) -> None:
    fill = np.indices((20, 20)).sum(axis=0) % 2 == 0
    for atoms in loadings(3):
        plan, report = plan_and_check(planner, atoms, TargetPattern(fill, ~fill))
        assert report.meets_target
        outside = (plan.moves[:, 2:] < 0) | (plan.moves[:, 2:] > 19)
        assert np.count_nonzero(outside.any(axis=1)) == np.count_nonzero(atoms) - 200


@every_planner
@pytest.mark.parametrize("lattice", ["triangular", "square"])
def test_too_few_atoms_fill_the_target_from_its_centre(
    planner: type[SingleTweezerPlanner], lattice: Any
) -> None:
    grid = SiteGrid(lattice=lattice)
    atoms = loadings(1, filling=0.3)[0]
    report = check_plan(planner(None, Context(grid=grid)).plan(atoms, COMPACT), atoms, COMPACT, 1)
    filled = report.predicted & COMPACT.fill
    from_centre = np.linalg.norm(grid.positions_m - grid.positions_m[COMPACT.fill].mean(axis=0), axis=-1)
    assert np.count_nonzero(filled) == np.count_nonzero(atoms)
    assert from_centre[filled].max() <= from_centre[COMPACT.fill & ~filled].min() * (1 + 1e-9)


@every_planner
def test_a_hole_behind_full_sites_takes_two_moves(planner: type[SingleTweezerPlanner]) -> None:
    atoms = np.ones((5, 5), np.bool_)
    atoms[2, 2] = False
    plan, report = plan_and_check(planner, atoms, in_the_middle(np.ones((3, 3)), (5, 5)))
    assert report.meets_target
    assert (len(journeys(plan)), distance(plan)) == (2, 2)


@every_planner
def test_atoms_go_round_a_corner_in_one_move(planner: type[SingleTweezerPlanner]) -> None:
    atoms, fill = np.zeros((3, 4), np.bool_), np.zeros((3, 4), np.bool_)
    atoms[0, 0] = fill[2, 3] = True
    atoms[0, 2] = fill[0, 2] = True  # stands in the way along the row
    plan, report = plan_and_check(planner, atoms, TargetPattern(fill, np.zeros_like(fill)))
    assert report.meets_target
    if planner is LsapSquaredPlanner:  # 3 * 3 + 2 * 2 is less than 5 * 5
        assert journeys(plan) == [[(0, 2), (0, 3), (2, 3)], [(0, 0), (0, 2)]]
    elif planner is not CompressionPlanner:
        assert journeys(plan) == [[(0, 0), (2, 0), (2, 3)]]


@every_planner
def test_a_surplus_atom_prefers_the_reservoir_to_the_way_out(planner: type[SingleTweezerPlanner]) -> None:
    clear = np.array([[True, True, True, True, False]])
    target = TargetPattern(np.zeros_like(clear), clear)
    plan, report = plan_and_check(planner, np.array([[True, False, False, False, False]]), target)
    assert (plan.moves.tolist(), report.n_surplus) == ([[0, 0, 0, 4]], 0)
    plan, report = plan_and_check(planner, np.array([[True, False, False, False, True]]), target)
    assert (plan.moves[0, :2].tolist(), report.n_surplus) == ([0, 0], 0)
    assert plan.n_batches == 1


@every_planner
def test_an_inner_atom_is_ejected_after_those_outside_of_it_went_on(
    planner: type[SingleTweezerPlanner],
) -> None:
    fill = np.ones((3, 3), np.bool_)
    fill[1, 1] = False
    plan, report = plan_and_check(planner, np.ones((3, 3), np.bool_), TargetPattern(fill, ~fill))
    assert report.meets_target
    assert plan.n_batches == 2
    assert np.count_nonzero(report.predicted) == 8


@every_planner
def test_nothing_to_do(planner: type[SingleTweezerPlanner]) -> None:
    nothing = np.zeros((20, 20), np.bool_)
    assert plan_and_check(planner, ~nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(planner, nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(planner, loadings(1)[0], TargetPattern(nothing, nothing))[0].n_batches == 0


@every_planner
@pytest.mark.parametrize(
    ("occupancy", "message"),
    [
        (np.ones((20, 19)), r"shape \(20, 19\); the grid has \(20, 20\)"),
        (np.full((20, 20), 0.5), "only 0 and 1"),
        (None, "has shape"),
    ],
)
def test_what_is_no_occupancy_is_refused(
    planner: type[SingleTweezerPlanner], occupancy: Any, message: str
) -> None:
    with pytest.raises(PlanError, match=message) as refusal:
        planner(None, Context()).plan(occupancy, COMPACT)
    assert refusal.value.planner == planner.name


def test_they_register_themselves_and_can_be_warmed() -> None:
    registry = Registry()
    labseq_single.labseq_register(registry)
    for name in ("lsap", "lsap_squared", "compression", "hca"):
        planner = registry.get("planner", name).factory(None, Context())
        assert isinstance(planner, NeedsWarmUp)
        planner.warm()


@given(cases((6, 6)))
@settings(max_examples=200, deadline=None)
def test_lsap_moves_the_atoms_by_the_least_total_distance(case: tuple[TargetPattern, Occupancy]) -> None:
    target, atoms = case
    target = TargetPattern(target.fill, np.zeros_like(target.fill))
    goals, sources = np.flatnonzero(target.fill), np.flatnonzero(atoms)
    if len(goals) <= len(sources):
        lengths = travel(goals, sources, atoms.shape[1])
        least = lengths[linear_sum_assignment(lengths)].sum()
        assert distance(plan_and_check(LsapPlanner, atoms, target)[0]) == least


def test_the_squares_prefer_two_short_moves_to_a_long_one() -> None:
    atoms, fill = np.zeros((2, 7), np.bool_), np.zeros((2, 7), np.bool_)
    atoms[0, 0] = atoms[1, 3] = fill[1, 3] = fill[0, 6] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    assert distance(plan_and_check(LsapPlanner, atoms, target)[0]) == 6
    plan, _ = plan_and_check(LsapSquaredPlanner, atoms, target)
    assert [(way[0], way[-1]) for way in journeys(plan)] == [((1, 3), (0, 6)), ((0, 0), (1, 3))]


def test_a_queue_of_atoms_moves_from_its_front() -> None:
    atoms, target = in_a_row([1, 1, 1, 0, 0], [0, 0, 1, 1, 1])
    for planner in (LsapPlanner, LsapSquaredPlanner):
        plan, report = plan_and_check(planner, atoms, target)
        assert report.meets_target
        assert distance(plan) == 6
    assert [move[1] for move in plan_and_check(LsapSquaredPlanner, atoms, target)[0].moves.tolist()] == [
        2,
        1,
        0,
    ]


def test_compression_fills_from_the_centre_with_the_nearest_atom_outside() -> None:
    atoms, target = in_a_row([1, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 1, 1, 0])
    plan, _ = plan_and_check(CompressionPlanner, atoms, target)
    assert plan.moves.tolist() == [[0, 2, 0, 3], [0, 1, 0, 2], [0, 0, 0, 1]]


def test_an_atom_in_the_way_goes_into_the_depth_of_a_closed_region() -> None:
    atoms, target = in_a_row([1, 1, 0, 0, 0, 1, 1, 1, 1], [0, 1, 1, 1, 1, 1, 1, 0, 0])
    plan, report = plan_and_check(HcaPlanner, atoms, target)
    assert report.meets_target
    assert plan.moves[:2].tolist() == [[0, 1, 0, 4], [0, 0, 0, 3]]


def test_layers_are_squares_around_the_centre() -> None:
    order = layers(np.ones((4, 4), np.bool_))
    assert order[:4].tolist() == [5, 6, 9, 10]
    assert order[4:8].tolist() == [0, 3, 12, 15]
