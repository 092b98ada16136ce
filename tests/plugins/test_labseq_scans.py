from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import labseq_scans
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_scans.pattern import InterleavedSettings
from labseq_scans.planners import Mta1Planner, Mta1Settings, TetrisPlanner, TetrisSettings
from numpy.typing import NDArray
from pydantic import ValidationError

from labseq import (
    Context,
    MotionSpec,
    Occupancy,
    Plan,
    PlanError,
    PlanReport,
    Registry,
    SiteGrid,
    TargetPattern,
    check_plan,
)
from labseq.roles import NeedsWarmUp
from labseq.testing import PlannerContract
from labseq.testing.strategies import cases

Bools = NDArray[np.bool_]
LinePlanner = Mta1Planner | TetrisPlanner


def mta1(dop: int = 7, grid: SiteGrid | None = None, **motion: Any) -> Mta1Planner:
    context = Context(grid=grid or SiteGrid(), motion=MotionSpec(**motion))
    return Mta1Planner(Mta1Settings(degree_of_parallelism=dop), context)


def tetris(dop: int = 7, grid: SiteGrid | None = None, **motion: Any) -> TetrisPlanner:
    context = Context(grid=grid or SiteGrid(), motion=MotionSpec(**motion))
    return TetrisPlanner(TetrisSettings(degree_of_parallelism=dop), context)


EACH = pytest.mark.parametrize("make", [mta1, tetris])


def plan_and_check(
    make: Callable[..., LinePlanner], atoms: Occupancy, target: TargetPattern, dop: int = 7, **motion: Any
) -> tuple[Plan, PlanReport]:
    planner = make(dop, **motion)
    plan = planner.plan(atoms, target)
    spec = MotionSpec(**motion)
    return plan, check_plan(plan, atoms, target, planner.degree_of_parallelism, motion=spec)


def loadings(n: int, shape: tuple[int, int] = (20, 20), filling: float = 0.75) -> Bools:
    return np.random.default_rng(1).random((n, *shape)) < filling


COMPACT = TargetPattern(
    np.pad(np.ones((15, 15), np.bool_), ((2, 3), (2, 3))), np.zeros((20, 20), np.bool_), "compact"
)


class TestMta1Contract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], Mta1Planner]:
        return partial(Mta1Planner, Mta1Settings())


class TestTetrisContract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], TetrisPlanner]:
        return partial(TetrisPlanner, TetrisSettings())


class TestMta1OneAtATime(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Callable[[Context], Mta1Planner]:
        return partial(Mta1Planner, Mta1Settings(degree_of_parallelism=1))


@EACH
@given(case=cases((7, 7)), dop=st.integers(1, 8), eject_slots=st.integers(1, 2))
@settings(max_examples=200, deadline=None)
def test_any_target_on_any_grid(
    make: Callable[..., LinePlanner], case: tuple[TargetPattern, Occupancy], dop: int, eject_slots: int
) -> None:
    target, atoms = case
    _, report = plan_and_check(make, atoms, target, dop, eject_slots=eject_slots)
    assert report.n_surplus == 0
    assert report.n_defects == max(0, target.n_atoms - int(np.count_nonzero(atoms)))


@EACH
@given(case=cases((6, 6)))
@settings(max_examples=60, deadline=None)
def test_without_ejection_slots_nothing_is_ejected(
    make: Callable[..., LinePlanner], case: tuple[TargetPattern, Occupancy]
) -> None:
    target, atoms = case
    _, report = plan_and_check(make, atoms, target, eject_slots=0)
    assert np.count_nonzero(report.predicted) == np.count_nonzero(atoms)
    assert report.n_defects == max(0, target.n_atoms - int(np.count_nonzero(atoms)))


@EACH
@given(
    seed=st.integers(0, 2**32 - 1),
    n_rows=st.integers(1, 64),
    n_cols=st.integers(1, 64),
    filling=st.floats(0, 1),
    wanted=st.floats(0, 1),
)
@settings(max_examples=20, deadline=None)
def test_large_grids(
    make: Callable[..., LinePlanner], seed: int, n_rows: int, n_cols: int, filling: float, wanted: float
) -> None:
    rng = np.random.default_rng(seed)
    atoms = rng.random((n_rows, n_cols)) < filling
    fill = rng.random((n_rows, n_cols)) < wanted * filling
    clear = ~fill & (rng.random((n_rows, n_cols)) < 0.3)
    target = TargetPattern(fill, clear)
    _, report = plan_and_check(make, atoms, target)
    missing = max(0, target.n_atoms - int(np.count_nonzero(atoms)))
    assert (report.n_defects, report.n_surplus) == (missing, 0)


@EACH
@pytest.mark.parametrize("upright", [True, False])
def test_atoms_on_one_side_reach_a_target_on_the_other(
    make: Callable[..., LinePlanner], upright: bool
) -> None:
    atoms, fill = np.zeros((8, 8), np.bool_), np.zeros((8, 8), np.bool_)
    atoms[:4] = True
    fill[:, :4] = True
    given_atoms, wanted = (atoms, fill) if upright else (atoms.T, fill.T)
    _, report = plan_and_check(make, given_atoms, TargetPattern(wanted, ~wanted))
    assert report.meets_target


@EACH
def test_nothing_to_do(make: Callable[..., LinePlanner]) -> None:
    nothing = np.zeros((20, 20), np.bool_)
    assert plan_and_check(make, ~nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(make, nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(make, loadings(1)[0], TargetPattern(nothing, nothing))[0].n_batches == 0


@EACH
@pytest.mark.parametrize("lattice", ["triangular", "square"])
@pytest.mark.parametrize("shear", [1, -1])
def test_too_few_atoms_fill_the_target_from_its_centre(
    make: Callable[..., LinePlanner], lattice: Any, shear: Any
) -> None:
    grid = SiteGrid(lattice=lattice, shear=shear)
    atoms = loadings(1, filling=0.3)[0]
    report = check_plan(make(grid=grid).plan(atoms, COMPACT), atoms, COMPACT, 7)
    filled = report.predicted & COMPACT.fill
    centre = grid.positions_m[COMPACT.fill].mean(axis=0)
    distance = np.linalg.norm(grid.positions_m - centre, axis=-1)
    assert np.count_nonzero(filled) == np.count_nonzero(atoms)
    assert distance[filled].max() <= distance[COMPACT.fill & ~filled].min() * (1 + 1e-9)


@EACH
@pytest.mark.parametrize(
    "limits", [{"max_tweezers": 3}, {"max_row_tones": 2}, {"max_column_tones": 1}, {"max_row_tones": 1}]
)
def test_the_profiles_limits_hold(make: Callable[..., LinePlanner], limits: dict[str, int]) -> None:
    for atoms in loadings(10):
        assert plan_and_check(make, atoms, COMPACT, **limits)[1].meets_target


def test_a_target_over_the_whole_grid_ejects_what_is_too_much() -> None:
    fill = np.indices((20, 20)).sum(axis=0) % 2 == 0
    for make in (mta1, tetris):
        for atoms in loadings(10):
            plan, report = plan_and_check(make, atoms, TargetPattern(fill, ~fill))
            assert report.meets_target
            outside = (plan.moves[:, 2:] < 0) | (plan.moves[:, 2:] > 19)
            assert np.count_nonzero(outside.any(axis=1)) == np.count_nonzero(atoms) - 200
            if make is mta1:
                assert not outside[plan.moves[:, 2] < 20].any()  # below the last row only


@EACH
def test_settings(make: Callable[..., LinePlanner]) -> None:
    assert make(30).degree_of_parallelism == 20
    for model in (Mta1Settings, TetrisSettings):
        assert model().degree_of_parallelism == 7
        for wrong in (0, -1, 2.5, "many"):
            with pytest.raises(ValidationError):
                model(degree_of_parallelism=wrong)  # pyright: ignore[reportArgumentType]


@EACH
@pytest.mark.parametrize(
    ("occupancy", "message"),
    [
        (np.ones((20, 19)), r"shape \(20, 19\); the grid has \(20, 20\)"),
        (np.full((20, 20), 0.5), "only 0 and 1"),
        (None, "has shape"),
    ],
)
def test_what_is_no_occupancy_is_refused(
    make: Callable[..., LinePlanner], occupancy: Any, message: str
) -> None:
    with pytest.raises(PlanError, match=message) as refusal:
        make().plan(occupancy, COMPACT)
    assert refusal.value.planner == make.__name__


@pytest.mark.parametrize(
    ("name", "model"), [("mta1", Mta1Settings), ("tetris", TetrisSettings)], ids=["mta1", "tetris"]
)
def test_they_register_themselves_and_can_be_warmed(name: str, model: type[Any]) -> None:
    registry = Registry()
    labseq_scans.labseq_register(registry)
    entry = registry.get("planner", name)
    planner = entry.factory(model(), Context())
    assert isinstance(planner, NeedsWarmUp)
    planner.warm()
    assert entry.settings_model is model
    assert registry.get("pattern", "interleaved").settings_model is InterleavedSettings
