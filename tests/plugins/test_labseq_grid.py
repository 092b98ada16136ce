"""Batches of rows and columns; tests/plugins/test_planners.py has what all planners promise."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_grid.kernels_columns import EMPTY, SPARE, STAYS, UNWANTED, match_columns, workspace
from labseq_grid.planner import GridPlanner, GridSettings

from labseq.motion.survival import predict_survival
from labseq.plugin import Context, LimitError, MotionSpec, SiteGrid, TargetPattern
from labseq.plugin.motion import RfSpec
from labseq.plugin.planning import check_plan
from labseq.testing import PlannerContract

from .planning import COMPACT, grid, in_the_middle, loadings, plan_and_check


class TestContractWhereEmptyTweezersLand(PlannerContract):
    """A square lattice, few tones, and landing on atoms."""

    n_examples: ClassVar[int] = 15

    def context(self, shape: tuple[int, int]) -> Context:
        motion = MotionSpec(empty_tweezers_may_land=True, max_row_tones=2, max_column_tones=5, eject_slots=2)
        return Context("planner", SiteGrid(*shape, lattice="square"), motion=motion)

    @pytest.fixture
    def factory(self) -> Callable[[Context], GridPlanner]:
        return lambda context: grid(context, 9)


class TestContractOfLanesThatWeave(PlannerContract):
    """On a lattice whose rows shift to the left on the way down; everywhere else they shift to the right."""

    n_examples: ClassVar[int] = 15

    def context(self, shape: tuple[int, int]) -> Context:
        return Context("planner", SiteGrid(*shape, shear=-1))

    @pytest.fixture
    def factory(self) -> Callable[[Context], GridPlanner]:
        return lambda context: GridPlanner(GridSettings(lanes="weaving"), context)


@pytest.mark.parametrize("dop", [7, 15])
@pytest.mark.parametrize("may_land", [False, True])
def test_losses_and_duration_on_a_square_lattice(dop: int, may_land: bool) -> None:
    ways: list[float] = []
    durations_s: list[float] = []
    n_lost: list[float] = []
    grid_of_sites = SiteGrid(20, 20, lattice="square")
    motion = MotionSpec(max_tweezers=dop, overhead_per_cycle_s=0.0, empty_tweezers_may_land=may_land)
    planner = grid(Context(grid=grid_of_sites, motion=motion), dop)
    for atoms in loadings(30):
        plan = planner.plan(atoms, COMPACT)
        report = check_plan(plan, atoms, COMPACT, dop, grid_of_sites, motion)
        assert report.meets_target
        assert plan.n_atom_moves == COMPACT.n_defects(atoms)
        ways.append(float(np.abs(plan.moves[:, 2:] - plan.moves[:, :2]).sum() / plan.n_atom_moves))
        durations_s.append(report.duration_s)
        survival = predict_survival(plan, report, atoms, COMPACT, grid_of_sites, motion)
        n_lost.append(survival.n_lost - survival.n_lost_landing)
    assert np.mean(ways) < 4.6
    assert np.mean(durations_s) < 5.6e-3
    assert np.mean(n_lost) < 2.75


@given(defects=st.sets(st.integers(0, 224), min_size=1, max_size=2), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_few_defects_take_few_batches(defects: set[int], seed: int) -> None:
    atoms = loadings(1, seed=seed)[0] | COMPACT.fill
    sites = np.argwhere(COMPACT.fill)[sorted(defects)]
    atoms[tuple(sites.T)] = False
    plan, report = plan_and_check(grid, atoms, COMPACT, 15)
    assert report.meets_target
    assert plan.n_batches <= plan.n_atom_moves == len(defects)


@pytest.mark.parametrize(
    ("site_grid", "motion", "text"),
    [
        (SiteGrid(), MotionSpec(clearance_m=2e-6), r"clearance.*2 um.*at most 1\.944 um"),
        (SiteGrid(1, 8), MotionSpec(eject_slots=0), "single line"),
        (SiteGrid(), MotionSpec(rf=RfSpec(min_spacing_hz=0.9e6)), r"row tone.*0\.8 MHz.*rf\.min_spacing"),
        (
            SiteGrid(),
            MotionSpec(rf=RfSpec(column_band_hz=(84e6, 118e6))),
            r"column tone.*83\.824 MHz.*84 to 118 MHz.*eject_slots to 0",
        ),
    ],
)
def test_a_machine_without_lanes_is_refused(site_grid: SiteGrid, motion: MotionSpec, text: str) -> None:
    with pytest.raises(LimitError, match=text):
        GridPlanner(GridSettings(), Context(grid=site_grid, motion=motion))
    atoms = np.ones(site_grid.shape, np.bool_)
    atoms[0, 0] = False
    target = TargetPattern(~atoms, np.zeros_like(atoms))
    in_lines = GridPlanner(GridSettings(without_lanes="psca"), Context(grid=site_grid, motion=motion))
    plan = in_lines.plan(atoms, target)
    assert check_plan(plan, atoms, target, 15, site_grid, motion).meets_target
    assert all(batch.tones is None for batch in plan.batches)


def test_unwanted_atoms_are_the_first_to_fill_vacancies() -> None:
    hole = np.ones((5, 5), np.bool_)
    hole[2, 2] = False
    target = in_the_middle(hole, (9, 9))
    atoms = np.ones((9, 9), np.bool_)
    atoms[3, 4] = False
    plan, report = plan_and_check(grid, atoms, target)
    assert report.meets_target
    assert plan.moves.tolist() == [[4, 4, 3, 4]]


def gain(
    lattice: Any, rows: Any, k: int, price: float, way: float, spare: float, goal: int, col: int
) -> float:
    """What a source column gains in a goal column, -inf if it cannot go there."""
    source, vacant, unavoidable = lattice
    atoms = [source[rows[0, i], col] for i in range(k)]
    total = -sum(way * (abs(goal - col) + abs(rows[1, i] - rows[0, i])) for i in range(k))
    for i, atom in enumerate(atoms):
        if atom == STAYS or (atom != EMPTY and not vacant[rows[1, i], goal]):
            return -np.inf
        if atom != EMPTY:
            total += price + unavoidable[rows[1, i], goal] - spare * (atom == SPARE)
            total -= way * (abs(goal - col) + abs(rows[1, i] - rows[0, i]))
    return total if any(atoms) else -np.inf


@given(data=st.data(), k=st.integers(1, 3), seed=st.integers(0, 2**32 - 1), band=st.integers(0, 5))
@settings(max_examples=80, deadline=None)
def test_columns_gain_as_much_as_the_best_of_all_choices(data: Any, k: int, seed: int, band: int) -> None:
    rng = np.random.default_rng(seed)
    shape, price, way, spare = (5, 5), 1.0, 0.07, data.draw(st.sampled_from([0.0, 0.3]))
    source = rng.choice([EMPTY, SPARE, UNWANTED, STAYS], shape, p=[0.4, 0.3, 0.1, 0.2]).astype(np.uint8)
    lattice = source, (rng.random(shape) < 0.6).astype(np.uint8), rng.random(shape) * 0.3
    rows = np.sort(np.array([rng.choice(5, k, replace=False) for _ in range(2)]), axis=1)
    columns, costs = np.zeros((3, 5), np.int64), (0.0, 0.0, 0.0, way, spare)
    n = match_columns((lattice, (5, 5, 5, band), costs, workspace(5)), rows, k, price, columns)
    parts = lattice, rows, k, price, way, spare
    best = 0.0
    for m in range(1, 6):
        for goals in combinations(range(5), m):
            for cols in combinations(range(5), m):
                if max(abs(a - b) for a, b in zip(goals, cols, strict=True)) <= band:
                    pairs = zip(goals, cols, strict=True)
                    best = max(best, sum(gain(*parts, goal, col) for goal, col in pairs))
    assert (np.diff(columns[1:, :n]) > 0).all()
    assert sum(gain(*parts, *columns[1:, j]) for j in range(n)) == pytest.approx(best, abs=1e-6)
