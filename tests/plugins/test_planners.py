"""What all planners promise, beside the contract: any target, every limit, too few atoms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import labseq_grid
import labseq_psca
import labseq_rivals
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from labseq.plugin import Context, Occupancy, PlanError, Registry, SiteGrid, TargetPattern
from labseq.plugin.planning import check_plan
from labseq.roles import NeedsWarmUp
from labseq.testing import PlannerContract
from labseq.testing.strategies import cases

from .planning import COMPACT, PLANNERS, SINGLE, VARIANTS, in_the_middle, loadings, plan_and_check

ROWS, COLS = np.indices((15, 15))
SPARSE = {
    "kagome": ~((ROWS % 2 == 1) & (COLS % 2 == 1)),
    "honeycomb": (ROWS + COLS) % 3 > 0,
    "checkerboard": (ROWS + COLS) % 2 == 0,
    "sierpinski": (ROWS & COLS) == 0,
}

EACH = PLANNERS | VARIANTS
each = pytest.mark.parametrize("name", EACH)


@each
class TestContract(PlannerContract):
    n_examples: ClassVar[int] = 15

    @pytest.fixture
    def factory(self, name: str) -> Callable[[Context], Any]:
        return lambda context: EACH[name](context, 7)


@each
@given(
    case=cases((7, 7)),
    dop=st.integers(1, 8),
    slots=st.integers(0, 2),
    tones=st.tuples(st.integers(1, 8), st.integers(1, 8)),
)
@settings(max_examples=40, deadline=None)
def test_any_target_is_filled_within_the_limits(
    name: str, case: tuple[TargetPattern, Occupancy], dop: int, slots: int, tones: tuple[int, int]
) -> None:
    target, atoms = case
    assume("grid" not in name or slots > 0 or min(target.shape) > 1)  # it needs a lane
    limits = {"eject_slots": slots, "max_row_tones": tones[0], "max_column_tones": tones[1]}
    _, report = plan_and_check(EACH[name], atoms, target, dop, **limits)
    n_atoms = int(np.count_nonzero(atoms))
    assert report.n_defects == max(0, target.n_atoms - n_atoms)
    if slots > 0:
        assert report.n_surplus == 0
    else:
        assert np.count_nonzero(report.predicted) == n_atoms
    if slots == 0 and name in SINGLE:
        assert report.n_surplus == max(0, n_atoms - int(np.count_nonzero(~target.clear)))


@each
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 48), st.integers(1, 48)),
    filling=st.floats(0, 1),
    wanted=st.floats(0, 1),
)
@settings(max_examples=6, deadline=None)
def test_large_grids(name: str, seed: int, shape: tuple[int, int], filling: float, wanted: float) -> None:
    rng = np.random.default_rng(seed)
    atoms = rng.random(shape) < filling
    fill = rng.random(shape) < wanted * filling
    target = TargetPattern(fill, ~fill & (rng.random(shape) < 0.3))
    _, report = plan_and_check(EACH[name], atoms, target)
    missing = max(0, target.n_atoms - int(np.count_nonzero(atoms)))
    assert (report.n_defects, report.n_surplus) == (missing, 0)


@each
@pytest.mark.parametrize("pattern", SPARSE)
def test_sparse_targets_are_filled_and_cleared(name: str, pattern: str) -> None:
    for atoms, dop in zip(loadings(2), (2, 15), strict=True):
        assert plan_and_check(EACH[name], atoms, in_the_middle(SPARSE[pattern]), dop)[1].meets_target


@each
def test_a_target_over_the_whole_grid_ejects_the_surplus_atoms(name: str) -> None:
    fill = np.indices((20, 20)).sum(axis=0) % 2 == 0
    for atoms in loadings(2):
        plan, report = plan_and_check(EACH[name], atoms, TargetPattern(fill, ~fill))
        assert report.meets_target
        outside = (plan.moves[:, 2:] < 0) | (plan.moves[:, 2:] > 19)
        assert np.count_nonzero(outside.any(axis=1)) == np.count_nonzero(atoms) - 200
        if name == "mta1":
            assert not outside[plan.moves[:, 2] < 20].any(), "MTA1 ejects below the last row only"


@each
def test_atoms_on_one_side_reach_a_target_on_the_other(name: str) -> None:
    atoms, fill = np.zeros((8, 8), np.bool_), np.zeros((8, 8), np.bool_)
    atoms[:4] = fill[:, :4] = True
    for held, wanted in ((atoms, fill), (atoms.T, fill.T)):
        assert plan_and_check(EACH[name], held, TargetPattern(wanted, ~wanted))[1].meets_target


@each
@pytest.mark.parametrize("grid", [SiteGrid(shear=-1), SiteGrid(lattice="square")], ids=["mirrored", "square"])
def test_too_few_atoms_fill_the_target_from_its_centre(name: str, grid: SiteGrid) -> None:
    atoms = loadings(1, filling=0.3)[0]
    plan = EACH[name](Context(grid=grid), 7).plan(atoms, COMPACT)
    report = check_plan(plan, atoms, COMPACT, 7, grid)
    filled = report.predicted & COMPACT.fill
    centre = grid.positions_m[COMPACT.fill].mean(axis=0)
    distance = np.linalg.norm(grid.positions_m - centre, axis=-1)
    assert np.count_nonzero(filled) == np.count_nonzero(atoms)
    assert distance[filled].max() <= distance[COMPACT.fill & ~filled].min() * (1 + 1e-9)


@each
def test_nothing_to_do(name: str) -> None:
    nothing = np.zeros((20, 20), np.bool_)
    for atoms, target in (
        (~nothing, COMPACT),
        (nothing, COMPACT),
        (loadings(1)[0], TargetPattern(nothing, nothing)),
    ):
        assert plan_and_check(EACH[name], atoms, target)[0].n_batches == 0


@pytest.mark.parametrize("name", PLANNERS)
def test_an_occupancy_of_another_shape_is_refused(name: str) -> None:
    with pytest.raises(PlanError, match=r"shape \(20, 19\), but the grid has \(20, 20\)") as refusal:
        PLANNERS[name](Context(), 7).plan(np.ones((20, 19)), COMPACT)
    assert refusal.value.planner == name


def test_all_are_registered_and_can_be_warmed() -> None:
    registry, modules = Registry(), (labseq_grid, labseq_psca, labseq_rivals)
    for module in modules:
        plugin: Any = module
        plugin.labseq_register(registry)
    assert {*registry.names("planner")} == {*PLANNERS}
    for name in PLANNERS:
        entry = registry.get("planner", name)
        planner = entry.factory(entry.settings_model and entry.settings_model(), Context())
        assert isinstance(planner, NeedsWarmUp)
        planner.warm()
