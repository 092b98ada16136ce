"""Batches of rows and columns; tests/plugins/test_planners.py has what all planners promise."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_grid.planner import GridPlanner, GridSettings

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


@pytest.mark.parametrize(("dop", "most"), [(7, 12.6), (15, 8.0), (20, 7.7)])
@pytest.mark.parametrize("may_land", [False, True])
def test_mean_number_of_batches_of_the_papers_array(dop: int, most: float, may_land: bool) -> None:
    n_batches: list[int] = []
    landing = {"empty_tweezers_may_land": may_land}
    for atoms in loadings(30):
        plan, report = plan_and_check(grid, atoms, COMPACT, dop, max_tweezers=dop, **landing)
        assert report.meets_target
        assert plan.n_atom_moves == COMPACT.n_defects(atoms)
        n_batches.append(plan.n_batches)
    assert np.mean(n_batches) <= most


@given(defects=st.sets(st.integers(0, 224), min_size=1, max_size=2), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_few_defects_take_one_batch(defects: set[int], seed: int) -> None:
    atoms = loadings(1, seed=seed)[0] | COMPACT.fill
    sites = np.argwhere(COMPACT.fill)[sorted(defects)]
    atoms[tuple(sites.T)] = False
    plan, report = plan_and_check(grid, atoms, COMPACT, 15)
    assert report.meets_target
    assert (plan.n_batches, plan.n_atom_moves) == (1, len(defects))


@pytest.mark.parametrize(
    ("site_grid", "motion", "text"),
    [
        (SiteGrid(), MotionSpec(clearance_m=2e-6), r"clearance.*2 um.*at most 1\.944 um"),
        (SiteGrid(1, 8), MotionSpec(eject_slots=0), "single line"),
        (SiteGrid(), MotionSpec(rf=RfSpec(min_spacing_hz=0.9e6)), r"row tone.*0\.8 MHz.*rf\.min_spacing"),
        (
            SiteGrid(),
            MotionSpec(rf=RfSpec(column_band_hz=(84e6, 118e6))),
            r"column tone.*83\.824 MHz.*84 to 118 MHz.*eject_slots: 0",
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
