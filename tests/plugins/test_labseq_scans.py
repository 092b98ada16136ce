"""Planners that scan lines: MTA, Tetris and their pattern fill targets with legal plans."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import labseq_scans
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_scans.pattern import InterleavedSettings, interleaved
from labseq_scans.planners import Mta1Planner, Mta1Settings, ScannedPlan, TetrisPlanner, TetrisSettings
from numpy.typing import NDArray
from pydantic import ValidationError

from labseq.plugin import (
    Context,
    LimitError,
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


EBADI = MotionSpec(
    pick_up_s=15e-6, drop_off_s=15e-6, speed_m_s=0.075, overhead_per_batch_s=0.0, overhead_per_cycle_s=0.0
)


def drawn(*rows: str) -> tuple[Bools, TargetPattern]:
    """Atoms and target of a drawing, with the marks of :func:`labseq.testing.strategies.drawn`."""
    marks = np.array([list(row) for row in rows])
    target = TargetPattern(np.isin(marks, ["#", "_"]), np.isin(marks, ["!", "."]))
    return np.isin(marks, ["#", "!", "o"]), target


def batches(plan: Plan) -> list[list[tuple[int, ...]]]:
    return [
        [tuple(move) for move in np.hstack([batch.from_sites, batch.to_sites]).tolist()]
        for batch in plan.batches
    ]


def test_the_side_with_more_atoms_to_spare_supplies_a_column() -> None:
    rows = ("o_# ", "o##o", "  _o")
    # Left of column 1 there are two to spare; right of it two, but column 2 lacks one.
    atoms, target = drawn(*rows)
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 0, 1)], [(2, 3, 2, 2)]]
    assert scanned.lines_passed.tolist() == [2, 2]
    atoms, target = drawn(*(row[::-1] for row in rows))
    assert batches(mta1().plan(atoms, target)) == [[(2, 0, 2, 1)], [(0, 3, 0, 2)]]


def test_the_nearest_atoms_come_first_and_their_columns_may_lack_atoms_afterwards() -> None:
    atoms, target = drawn(
        "_#oo",
        "# oo",
    )
    # Column 0 takes the atom of column 1, which then takes the nearest from column 2.
    assert batches(mta1().plan(atoms, target)) == [[(0, 1, 0, 0)], [(0, 2, 0, 1)]]


def test_a_horizontal_scan_gathers_atoms_of_several_columns() -> None:
    atoms, target = drawn(
        "_o  ",
        "_ o ",
        "_ o ",
        "_  o",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [
        [(3, 3, 3, 0)],
        [(1, 2, 1, 0), (2, 2, 2, 0)],
        [(0, 1, 0, 0)],
    ]
    assert scanned.lines_passed.tolist() == [4]
    assert mta1(2).scan(atoms, target).lines_passed.tolist() == [3, 4]


def test_a_scan_moves_one_atom_of_each_column_after_the_other() -> None:
    atoms, target = drawn(
        "oo",
        "__",
        "o ",
        "_ ",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 1, 0), (0, 1, 1, 1)], [(2, 0, 3, 0)]]
    assert scanned.lines_passed.tolist() == [4]


def test_a_blocked_atom_waits_for_the_next_scan() -> None:
    atoms, target = drawn("o", "o", "_", "_")
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(1, 0, 3, 0)], [(0, 0, 2, 0)]]
    assert scanned.lines_passed.tolist() == [4, 4]


def test_a_blocked_atom_goes_as_far_as_it_can() -> None:
    atoms, target = drawn("o", " ", "o", "_", "_")
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 1, 0)], [(2, 0, 4, 0)], [(1, 0, 3, 0)]]
    assert scanned.n_scans == 2


def test_downward_scans_come_before_upward_ones() -> None:
    atoms, target = drawn(
        "_o",
        "o_",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 1, 1, 1)], [(1, 0, 0, 0)]]
    assert scanned.lines_passed.tolist() == [2, 2]


def test_surplus_atoms_leave_below_the_last_row_lowest_first() -> None:
    atoms, target = drawn(
        "!.",
        "!!",
        "#_",
    )
    scanned = mta1().scan(atoms, target)
    assert batches(scanned.plan) == [[(1, 1, 2, 1)], [(2, 0, 3, 0)], [(1, 0, 3, 0)], [(0, 0, 2, 0)]]
    assert scanned.lines_passed.tolist() == [4, 4, 3]


def test_no_more_tweezers_than_allowed_are_on_in_a_scan() -> None:
    atoms, target = drawn("ooo", "   ", "___")
    assert mta1(3).scan(atoms, target).n_scans == 1
    scanned = mta1(2).scan(atoms, target)
    assert batches(scanned.plan) == [[(0, 0, 2, 0), (0, 1, 2, 1)], [(0, 2, 2, 2)]]
    assert scanned.n_scans == 2


def test_a_scan_waits_on_every_line() -> None:
    scanned = ScannedPlan(Plan.from_batches([]), np.array([3, 5]))
    grid = SiteGrid(5, 5, spacing_m=7.5e-6)
    assert scanned.duration_s(grid, EBADI) == pytest.approx(8 * 15e-6 + 6 * 100e-6)
    assert ScannedPlan(Plan.from_batches([]), np.zeros(0, np.int64)).duration_s(grid, EBADI) == 0.0


def test_where_no_row_of_a_side_helps_columns_are_supplied_all_the_same() -> None:
    atoms, target = drawn(
        "_##",
        "_##",
        "  o",
        "  o",
    )
    scanned = mta1().scan(atoms, target)
    report = check_plan(scanned.plan, atoms, target, 7)
    assert report.meets_target
    assert scanned.duration_s(SiteGrid(4, 3), EBADI) > 0


def test_scans_of_the_sources_geometry() -> None:
    grid = SiteGrid(33, 16)
    target = interleaved(InterleavedSettings(rows=16, cols=16), grid)
    planner = Mta1Planner(Mta1Settings(degree_of_parallelism=16), Context(grid=grid, motion=EBADI))
    n_scans: list[int] = []
    for atoms in np.random.default_rng(1).random((100, 33, 16)) < 0.55:
        scanned = planner.scan(atoms, target)
        assert check_plan(scanned.plan, atoms, target, 16, grid=grid, motion=EBADI).meets_target
        for batch in scanned.plan.batches:
            lines = [batch.from_sites, batch.to_sites]
            assert min(max(len(np.unique(ends[:, axis])) for ends in lines) for axis in (0, 1)) == 1
        assert set(scanned.lines_passed.tolist()) <= set(range(2, 17)) | {33}
        n_scans.append(scanned.n_scans)
    assert np.mean(n_scans) == pytest.approx(17.4, abs=0.5)


def test_the_rows_are_piled_up_from_the_top() -> None:
    atoms, target = drawn(
        " oo",
        "__o",
        "__ ",
        "oo ",
    )
    # Row 0 serves the first open row of both columns, row 1 the lower one of column 0.
    assert batches(tetris().plan(atoms, target)) == [
        [(0, 1, 0, 0), (0, 2, 0, 1)],
        [(1, 2, 1, 0)],
        [(3, 0, 2, 0)],
        [(0, 1, 1, 1), (3, 1, 2, 1)],
    ]


def test_columns_that_hold_an_atom_of_the_row_come_first() -> None:
    atoms, target = drawn(
        "__#",
        "oo ",
    )
    assert batches(tetris().plan(atoms, target)) == [[(1, 0, 0, 0)], [(1, 1, 0, 1)]]


def test_rows_are_left_alone_once_every_column_has_its_atoms() -> None:
    atoms, target = drawn("##", "o ", " o")
    assert tetris().plan(atoms, target).n_batches == 0


def test_a_row_with_more_atoms_than_allowed_takes_several_batches() -> None:
    atoms, target = drawn("  ooo", "___  ")
    assert [len(batch) for batch in tetris(2).plan(atoms, target).batches] == [2, 1, 1, 1, 1]


def test_surplus_atoms_leave_on_both_sides() -> None:
    atoms, target = drawn("!", "!", "!")
    assert batches(tetris().plan(atoms, target)) == [[(0, 0, -1, 0), (2, 0, 3, 0)], [(1, 0, -1, 0)]]


@pytest.mark.parametrize(("dop", "most_batches"), [(15, 31.0), (7, 48.5)])
def test_mean_number_of_batches_of_the_papers_array(dop: int, most_batches: float) -> None:
    fill = np.pad(np.ones((15, 15), np.bool_), ((2, 3), (2, 3)))
    target = TargetPattern(fill, np.zeros_like(fill))
    n_batches: list[int] = []
    for atoms in np.random.default_rng(1).random((200, 20, 20)) < 0.75:
        plan = tetris(dop).plan(atoms, target)
        assert check_plan(plan, atoms, target, dop).meets_target
        n_batches.append(plan.n_batches)
    assert np.mean(n_batches) <= most_batches


def test_it_is_centred_with_reservoir_around() -> None:
    target = interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(33, 18))
    rows, cols = np.nonzero(target.fill)
    assert sorted(set(rows.tolist())) == list(range(1, 33, 2))
    assert sorted(set(cols.tolist())) == list(range(1, 17))
    assert not target.clear.any()


def test_wider_gaps_an_origin_and_rows_between_to_be_cleared() -> None:
    made = InterleavedSettings(rows=2, cols=2, reservoir_rows=2, origin=(0, 1), clear="bounding_box")
    target = interleaved(made, SiteGrid(5, 3))
    assert target.fill.astype(int).tolist() == [[0, 1, 1], [0] * 3, [0] * 3, [0, 1, 1], [0] * 3]
    assert target.clear.astype(int).tolist() == [[0] * 3, [0, 1, 1], [0, 1, 1], [0] * 3, [0] * 3]


def test_without_rows_between_it_is_compact() -> None:
    target = interleaved(InterleavedSettings(rows=3, cols=2, reservoir_rows=0), SiteGrid(3, 2))
    assert target.fill.all()


def test_one_that_does_not_fit_is_refused() -> None:
    with pytest.raises(LimitError, match="31 rows x 16 columns"):
        interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(20, 20))
    with pytest.raises(ValidationError):
        InterleavedSettings(rows=0, cols=1)
