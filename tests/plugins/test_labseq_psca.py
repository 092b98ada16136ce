from __future__ import annotations

from typing import Any

import labseq_psca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_psca.planner import PscaPlanner, PscaSettings, ToneLimits
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
from labseq.testing.strategies import cases

Bools = NDArray[np.bool_]


def make_planner(dop: int = 7, grid: SiteGrid | None = None, **motion: Any) -> PscaPlanner:
    context = Context(grid=grid or SiteGrid(), motion=MotionSpec(**motion))
    return PscaPlanner(PscaSettings(degree_of_parallelism=dop), context)


def plan_and_check(
    atoms: Occupancy, target: TargetPattern, dop: int = 7, **motion: Any
) -> tuple[Plan, PlanReport]:
    planner = make_planner(dop, **motion)
    plan = planner.plan(atoms, target)
    spec = MotionSpec(**motion)
    return plan, check_plan(plan, atoms, target, planner.degree_of_parallelism, motion=spec)


def loadings(n: int, shape: tuple[int, int] = (20, 20), filling: float = 0.75) -> Bools:
    return np.random.default_rng(1).random((n, *shape)) < filling


def in_the_middle(pattern: Any, shape: tuple[int, int] = (20, 20), *, clear: bool = True) -> TargetPattern:
    """A pattern in the middle of the grid; the other sites of its bounding box are to be empty."""
    small = np.asarray(pattern, np.bool_)
    top, left = (shape[0] - small.shape[0]) // 2, (shape[1] - small.shape[1]) // 2
    box = (slice(top, top + small.shape[0]), slice(left, left + small.shape[1]))
    fill, empty = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    fill[box] = small
    empty[box] = ~small & clear
    return TargetPattern(fill, empty)


COMPACT = in_the_middle(np.ones((15, 15)))
ROWS, COLS = np.indices((15, 15))


@given(cases((7, 7)), st.integers(1, 8), st.integers(1, 2))
@settings(max_examples=300, deadline=None)
def test_any_target_on_any_grid(case: tuple[TargetPattern, Occupancy], dop: int, eject_slots: int) -> None:
    target, atoms = case
    _, report = plan_and_check(atoms, target, dop, eject_slots=eject_slots)
    n_atoms = int(np.count_nonzero(atoms))
    assert report.n_surplus == 0
    if n_atoms < target.n_atoms:
        assert target.n_atoms - report.n_defects == n_atoms
    else:
        assert report.n_defects == 0


@given(cases((6, 6)))
@settings(max_examples=100, deadline=None)
def test_without_ejection_slots_nothing_is_ejected(case: tuple[TargetPattern, Occupancy]) -> None:
    target, atoms = case
    _, report = plan_and_check(atoms, target, eject_slots=0)
    assert np.count_nonzero(report.predicted) == np.count_nonzero(atoms)
    assert report.n_defects == max(0, target.n_atoms - int(np.count_nonzero(atoms)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 64), st.integers(1, 64), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=25, deadline=None)
def test_large_grids(seed: int, n_rows: int, n_cols: int, filling: float, wanted: float) -> None:
    rng = np.random.default_rng(seed)
    atoms = rng.random((n_rows, n_cols)) < filling
    fill = rng.random((n_rows, n_cols)) < wanted * filling
    clear = ~fill & (rng.random((n_rows, n_cols)) < 0.3)
    target = TargetPattern(fill, clear)
    _, report = plan_and_check(atoms, target)
    missing = max(0, target.n_atoms - int(np.count_nonzero(atoms)))
    assert (report.n_defects, report.n_surplus) == (missing, 0)


@given(cases((7, 7)), st.sampled_from([{"variant": "paper"}, {"repair_below": 1}]))
@settings(max_examples=200, deadline=None)
def test_any_target_in_every_variant(case: tuple[TargetPattern, Occupancy], variant: dict[str, Any]) -> None:
    target, atoms = case
    planner = PscaPlanner(PscaSettings(**variant), Context())
    report = check_plan(planner.plan(atoms, target), atoms, target, 7)
    assert report.n_surplus == 0
    assert report.n_defects == max(0, target.n_atoms - int(np.count_nonzero(atoms)))


@pytest.mark.parametrize(("dop", "paper"), [(15, 29.61), (2, 160.0)])
def test_the_papers_variant_comes_near_its_numbers_of_batches(dop: int, paper: float) -> None:
    planner = PscaPlanner(PscaSettings(variant="paper", degree_of_parallelism=dop), Context())
    plans = [planner.plan(atoms, COMPACT) for atoms in loadings(200)]
    assert np.mean([plan.n_batches for plan in plans]) == pytest.approx(paper, rel=0.12)


@pytest.mark.parametrize(("order", "row"), [("half_filled", 1), ("fullest", 0), ("emptiest", 2)])
def test_the_papers_variant_sorts_rows_in_the_order_that_is_set(order: Any, row: int) -> None:
    atoms = np.array([[1, 1, 0, 1], [1, 1, 0, 0], [0, 1, 0, 0]], np.bool_)
    fill = np.array([[0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], np.bool_)
    planner = PscaPlanner(PscaSettings(variant="paper", row_order=order), Context())
    plan = planner.plan(atoms, TargetPattern(fill, np.zeros_like(fill)))
    assert plan.moves[0, 0] == row


def test_few_defects_are_repaired_with_few_atom_moves() -> None:
    rng = np.random.default_rng(1)
    repairing, plain = (PscaPlanner(PscaSettings(repair_below=x), Context()) for x in (0.1, 0))
    n_defects, moves = 0, np.zeros(2, np.int64)
    for atoms in loadings(200):
        plan, report = plan_and_check(atoms, COMPACT)
        lost = np.zeros((22, 22), np.bool_)
        lost[tuple(plan.moves[:, 2:].T + 1)] = True
        seen = report.predicted & ~(lost[1:-1, 1:-1] & (rng.random((20, 20)) < 0.02))
        n_defects += COMPACT.n_defects(seen)
        for i, planner in enumerate((repairing, plain)):
            plan = planner.plan(seen, COMPACT)
            assert check_plan(plan, seen, COMPACT, 7).meets_target
            moves[i] += plan.n_atom_moves
    assert moves[0] <= 4.5 * n_defects
    assert moves[0] < 0.8 * moves[1]


def test_many_defects_are_sorted_and_compressed_in_few_batches() -> None:
    plain = PscaPlanner(PscaSettings(repair_below=0), Context())
    for atoms in loadings(20):
        assert np.array_equal(make_planner().plan(atoms, COMPACT).moves, plain.plan(atoms, COMPACT).moves)


@pytest.mark.parametrize("limits", [{"row": 3, "col": 5}, {"row": 4}, {"col": 1}])
def test_tone_limits_of_each_axis_are_kept(limits: dict[str, int]) -> None:
    tones = ToneLimits(**limits)
    planner = PscaPlanner(PscaSettings(max_tones=tones, degree_of_parallelism=6), Context())
    for atoms in loadings(10):
        plan = planner.plan(atoms, COMPACT)
        assert check_plan(plan, atoms, COMPACT, 6).meets_target
        for batch in plan.batches:
            for axis, limit in ((0, tones.row), (1, tones.col)):
                assert len(np.unique(batch.from_sites[:, axis])) <= (limit or 6)


@pytest.mark.parametrize(("dop", "most_batches"), [(15, 18.6), (7, 33.8), (2, 97.0)])
def test_mean_number_of_batches_of_the_papers_array(dop: int, most_batches: float) -> None:
    plans = [plan_and_check(atoms, COMPACT, dop) for atoms in loadings(1000)]
    assert all(report.meets_target for _, report in plans)
    assert np.mean([plan.n_batches for plan, _ in plans]) <= most_batches


@pytest.mark.parametrize("dop", [2, 15])
@pytest.mark.parametrize(
    "pattern",
    [~((ROWS % 2 == 1) & (COLS % 2 == 1)), (ROWS + COLS) % 3 > 0, (ROWS + COLS) % 2 == 0, (ROWS & COLS) == 0],
    ids=["kagome", "honeycomb", "checkerboard", "sierpinski"],
)
def test_sparse_targets_are_filled_and_cleared(pattern: Bools, dop: int) -> None:
    target = in_the_middle(pattern)
    for atoms in loadings(20):
        plan, report = plan_and_check(atoms, target, dop)
        assert report.meets_target
        assert (np.diff(plan.batch_offsets) <= dop).all()


def test_a_target_over_the_whole_grid_ejects_what_is_too_much() -> None:
    fill = np.indices((20, 20)).sum(axis=0) % 2 == 0
    for atoms in loadings(10):
        plan, report = plan_and_check(atoms, TargetPattern(fill, ~fill))
        assert report.meets_target
        outside = (plan.moves[:, 2:] < 0) | (plan.moves[:, 2:] > 19)
        assert np.count_nonzero(outside.any(axis=1)) == np.count_nonzero(atoms) - 200


def test_no_row_helps_at_first() -> None:
    atoms = np.zeros((8, 8), np.bool_)
    atoms[:4] = True
    fill = np.zeros((8, 8), np.bool_)
    fill[:, :4] = True
    _, report = plan_and_check(atoms, TargetPattern(fill, ~fill))
    assert report.meets_target
    _, report = plan_and_check(atoms.T.copy(), TargetPattern(fill.T, ~fill.T))
    assert report.meets_target


@pytest.mark.parametrize("lattice", ["triangular", "square"])
@pytest.mark.parametrize("shear", [1, -1])
def test_too_few_atoms_fill_the_target_from_its_centre(lattice: Any, shear: Any) -> None:
    grid = SiteGrid(lattice=lattice, shear=shear)
    atoms = loadings(1, filling=0.3)[0]
    planner = make_planner(grid=grid)
    report = check_plan(planner.plan(atoms, COMPACT), atoms, COMPACT, 7)
    filled = report.predicted & COMPACT.fill
    centre = grid.positions_m[COMPACT.fill].mean(axis=0)
    distance = np.linalg.norm(grid.positions_m - centre, axis=-1)
    assert np.count_nonzero(filled) == np.count_nonzero(atoms)
    assert distance[filled].max() <= distance[COMPACT.fill & ~filled].min() * (1 + 1e-9)


def test_the_better_way_round_is_taken() -> None:
    atoms = np.zeros((4, 4), np.bool_)
    atoms[0] = True
    fill = np.zeros((4, 4), np.bool_)
    fill[3] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    assert plan_and_check(atoms, target)[0].n_batches == 4
    assert plan_and_check(atoms.T, TargetPattern(fill.T, target.clear))[0].n_batches == 4
    fill = np.zeros((4, 4), np.bool_)
    fill[0, 1:] = fill[1, 0] = True
    plan, _ = plan_and_check(atoms, TargetPattern(fill, np.zeros_like(fill)))
    assert plan.moves.tolist() == [[0, 0, 1, 0]]


def test_nothing_to_do() -> None:
    nothing = np.zeros((20, 20), np.bool_)
    assert plan_and_check(~nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(nothing, COMPACT)[0].n_batches == 0
    assert plan_and_check(loadings(1)[0], TargetPattern(nothing, nothing))[0].n_batches == 0


@pytest.mark.parametrize(
    ("limits", "row_tones", "column_tones"),
    [
        ({}, 7, 7),
        ({"max_tweezers": 3}, 3, 3),
        ({"max_row_tones": 2}, 2, 7),
        ({"max_column_tones": 1}, 7, 1),
    ],
)
def test_the_profiles_limits_hold(limits: dict[str, int], row_tones: int, column_tones: int) -> None:
    seen = [1, 1]
    for atoms in loadings(20):
        plan, report = plan_and_check(atoms, COMPACT, **limits)
        assert report.meets_target
        for batch in plan.batches:
            for axis in (0, 1):
                seen[axis] = max(seen[axis], len(set(batch.from_sites[:, axis].tolist())))
    assert seen == [row_tones, column_tones]


def test_settings() -> None:
    assert PscaSettings().degree_of_parallelism == 7
    assert make_planner(30).degree_of_parallelism == 20
    for wrong in (0, -1, 2.5, "many"):
        with pytest.raises(ValidationError):
            PscaSettings(degree_of_parallelism=wrong)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("occupancy", "message"),
    [
        (np.ones((20, 19)), r"shape \(20, 19\); the grid has \(20, 20\)"),
        (np.ones(400), r"has shape \(n_rows, n_cols\); this one has \(400,\)"),
        (np.full((20, 20), 0.5), "only 0 and 1"),
        (np.full((20, 20), np.nan), "only 0 and 1"),
        (np.full((20, 20), "full"), "only 0 and 1"),
        (None, "has shape"),
    ],
)
def test_what_is_no_occupancy_is_refused(occupancy: Any, message: str) -> None:
    with pytest.raises(PlanError, match=message) as refusal:
        make_planner().plan(occupancy, COMPACT)
    assert refusal.value.planner == "psca"


def test_it_registers_itself_and_can_be_warmed() -> None:
    registry = Registry()
    labseq_psca.labseq_register(registry)
    entry = registry.get("planner", "psca")
    planner = entry.factory(PscaSettings(), Context())
    assert isinstance(planner, NeedsWarmUp)
    planner.warm()
    assert entry.settings_model is PscaSettings
