"""PSCA: any target is filled, limits are kept, and plans take few batches."""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import labseq_psca
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from labseq_psca import kernels
from labseq_psca.planner import PscaPlanner, PscaSettings, ToneLimits
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from labseq import (
    LimitError,
    MotionSpec,
    Occupancy,
    Plan,
    PlanError,
    PlanReport,
    SiteGrid,
    TargetPattern,
    check_plan,
    make_target,
)
from labseq.plugin import Context, Registry
from labseq.roles import NeedsWarmUp
from labseq.testing import PlannerContract
from labseq.testing.strategies import cases


class TestPscaContract(PlannerContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings())


class TestPaperVariantContract(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(variant="paper"))


class TestRepairContract(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(repair_below=1))


class TestPscaOneAtATime(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=1))


class TestPscaWithFewTones(PlannerContract):
    n_examples: ClassVar[int] = 20

    def context(self, shape: tuple[int, int]) -> Context:
        context = super().context(shape)
        return replace(context, motion=replace(context.motion, max_row_tones=2, max_column_tones=3))

    @pytest.fixture
    def factory(self) -> Callable[[Context], PscaPlanner]:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=15))


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


def loadings(n: int, shape: tuple[int, int] = (20, 20), filling: float = 0.75, seed: int = 1) -> Bools:
    return np.random.default_rng(seed).random((n, *shape)) < filling


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


ROOT = Path(__file__).parents[2]
N_SEEDS = int(os.environ.get("LABSEQ_SEEDS", "3"))
replay: Callable[[dict[str, Any]], None] = runpy.run_path(str(ROOT / "tests" / "system" / "replay.py"))[
    "replay"
]

EVERYWHERE: dict[str, dict[str, Any]] = {
    "compact": {"rows": 15, "cols": 15},
    "checkerboard": {"rows": 15, "cols": 15},
    "checkerboard of the whole grid": {"rows": 20, "cols": 20},
    "sierpinski": {"order": 4},
    "sierpinski at a corner": {"order": 4, "origin": (4, 4)},
    "ring": {"radius": 7},
    "bitmap": {"file": str(ROOT / "sequences" / "lion_head.txt")},
}

TRIANGULAR: dict[str, dict[str, Any]] = {
    "kagome": {"rows": 15, "cols": 15},
    "honeycomb": {"rows": 15, "cols": 15},
    "honeycomb of the whole grid": {"rows": 20, "cols": 20},
    "link_kagome": {"rows": 17, "cols": 17},
}

GRIDS = {
    "triangular": SiteGrid(),
    "mirrored": SiteGrid(shear=-1),
    "square": SiteGrid(lattice="square"),
}

PATTERNS = [
    pytest.param(name, values, GRIDS[grid], id=f"{name}, {grid}")
    for grid in GRIDS
    for name, values in (EVERYWHERE if grid == "square" else EVERYWHERE | TRIANGULAR).items()
]


def replay_plan(atoms: NDArray[np.bool_], target: TargetPattern, grid: SiteGrid, dop: int = 7) -> None:
    """Plan, and replay the plan with the array that is expected at its end."""
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop), Context(grid=grid))
    plan = planner.plan(atoms, target)
    after = atoms.copy()
    for batch in plan.batches:
        inside = np.logical_and(batch.to_sites >= 0, batch.to_sites < grid.shape).all(axis=1)
        after[tuple(batch.from_sites.T)] = False
        after[tuple(batch.to_sites[inside].T)] = True
    replay(
        {
            "grid": {"n_rows": grid.n_rows, "n_cols": grid.n_cols},
            "degree_of_parallelism": dop,
            "occupancy": atoms.tolist(),
            "target": {"fill": target.fill.tolist(), "clear": target.clear.tolist()},
            "n_batches": plan.n_batches,
            "n_atom_moves": plan.n_atom_moves,
            "batches": [
                {"from": b.from_sites.tolist(), "to": b.to_sites.tolist(), "linked": b.linked}
                for b in plan.batches
            ],
            "predicted": after.tolist(),
        }
    )


def make(name: str, grid: SiteGrid, values: dict[str, Any]) -> TargetPattern:
    return make_target(name.partition(" ")[0], grid=grid, **values)


def exactly(n_atoms: int, order: NDArray[np.intp], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Atoms on the first sites of an order of all sites."""
    atoms = np.zeros(shape, np.bool_)
    atoms.flat[order[:n_atoms]] = True
    return atoms


def extremes(target: TargetPattern, rng: np.random.Generator) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Loadings with enough atoms, and some with exactly enough of them."""
    shape, n_sites, n_atoms = target.shape, target.fill.size, target.n_atoms
    shuffled = rng.permutation(n_sites)
    column_by_column = np.arange(n_sites).reshape(shape).T[::-1].ravel()
    off_target = shuffled[np.argsort(target.fill.flat[shuffled], kind="stable")]
    yield "full", np.ones(shape, np.bool_)
    yield "all but one", exactly(n_sites - 1, shuffled, shape)
    yield "exactly enough, anywhere", exactly(n_atoms, shuffled, shape)
    yield "exactly enough, from the top", exactly(n_atoms, np.arange(n_sites), shape)
    yield "exactly enough, from the right", exactly(n_atoms, column_by_column, shape)
    yield "exactly enough, where they are not wanted", exactly(n_atoms, off_target, shape)
    yield "met already", target.fill.copy()
    yield "one too few", exactly(n_atoms - 1, shuffled, shape)


@pytest.mark.parametrize(("name", "values", "grid"), PATTERNS)
def test_every_loading_with_enough_atoms_ends_right(
    name: str, values: dict[str, Any], grid: SiteGrid
) -> None:
    target = make(name, grid, values)
    for seed in range(N_SEEDS):
        atoms = np.random.default_rng(seed).random(grid.shape) < 0.75
        replay_plan(atoms, target, grid, dop=(7, 2, 15)[seed % 3])


@pytest.mark.parametrize(("name", "values", "grid"), PATTERNS)
def test_extreme_loadings_end_right(name: str, values: dict[str, Any], grid: SiteGrid) -> None:
    target = make(name, grid, values)
    for seed in range(N_SEEDS):
        for loading, atoms in extremes(target, np.random.default_rng(seed)):
            try:
                replay_plan(atoms, target, grid)
            except Exception as error:
                raise AssertionError(f"{loading}, seed {seed}: {error}") from error


@st.composite
def patterns(draw: st.DrawFn) -> tuple[TargetPattern, SiteGrid]:
    """A pattern of any kind, size and place that fits on a small grid."""
    grid = SiteGrid(draw(st.integers(2, 9)), draw(st.integers(2, 9)), shear=draw(st.sampled_from((1, -1))))
    name = draw(
        st.sampled_from(
            ("checkerboard", "compact", "honeycomb", "kagome", "link_kagome", "ring", "sierpinski")
        )
    )
    rows, cols = draw(st.integers(1, grid.n_rows)), draw(st.integers(1, grid.n_cols))
    values: dict[str, Any] = {"rows": rows, "cols": cols}
    values["origin"] = draw(st.tuples(st.integers(0, grid.n_rows - rows), st.integers(0, grid.n_cols - cols)))
    if name != "compact":
        values["clear"] = draw(st.sampled_from(("bounding_box", "none")))
    try:
        return make_target(name, grid=grid, **values), grid
    except LimitError:  # a single site may be one that the pattern leaves out
        return make_target("compact", grid=grid, rows=rows, cols=cols), grid


@given(patterns(), st.randoms(use_true_random=False), st.integers(1, 9))
@settings(max_examples=75, deadline=None)
def test_any_size_and_place_ends_right(case: tuple[TargetPattern, SiteGrid], random: Any, dop: int) -> None:
    target, grid = case
    n_sites = target.fill.size
    order = np.array(random.sample(range(n_sites), n_sites))
    replay_plan(exactly(random.randint(target.n_atoms, n_sites), order, grid.shape), target, grid, dop)


BATCHES = {2: 95.18, 7: 33.72, 15: 18.56}
"""Mean number of batches of 50 loadings of the paper's array at each degree of parallelism, as measured."""


def line_cover(defects: Bools) -> int:
    """Fewest rows and columns that cover all defects: as many as a largest matching has (König's theorem)."""
    return int((maximum_bipartite_matching(csr_array(defects), perm_type="column") >= 0).sum())


@pytest.mark.parametrize(("dop", "batches"), BATCHES.items())
def test_plans_of_the_papers_array_take_few_batches(dop: int, batches: float) -> None:
    """A batch moves the atoms of one line: no fewer batches than lines that cover the defects."""
    n_batches, n_lines = np.zeros(50), np.zeros(50)
    for i, atoms in enumerate(loadings(50, seed=5)):
        plan, report = plan_and_check(atoms, COMPACT, dop)
        assert report.meets_target
        n_batches[i], n_lines[i] = plan.n_batches, line_cover(COMPACT.fill & ~atoms)
    assert (n_batches >= n_lines).all()
    assert n_batches.mean() == pytest.approx(batches, rel=0.005)
    if dop == 15:
        assert n_batches.mean() < 1.27 * n_lines.mean()


def plans_of_both_ways(
    planner: PscaPlanner, atoms: Bools, target: TargetPattern
) -> list[tuple[int, int, int, int]]:
    """Batches, atom moves and distance of each way round, and the lower bound of its batches."""
    found: list[tuple[int, int, int, int]] = []
    row_limit, column_limit = planner._limits
    for swapped in (False, True):
        grids = (atoms, target.fill, target.clear)
        after, fill, clear = (np.ascontiguousarray(grid.T if swapped else grid).copy() for grid in grids)
        along, across = (column_limit, row_limit) if swapped else (row_limit, column_limit)
        moves, offsets = kernels.empty_plan(after.size)
        moves, offsets, n = kernels.sort_rows(
            moves, offsets, 0, after, fill, clear, along, across, kernels.HALF_FILLED
        )
        bound = n + kernels.least_batches(after, fill, clear, across)
        slots = planner._eject_slots
        moves, offsets, n = kernels.compress_columns(moves, offsets, n, after, fill, clear, across, slots)
        n_moves = int(offsets[n])
        found.append((n, n_moves, kernels.distance(moves[:n_moves]), bound))
    return found


@given(cases((7, 7)), st.integers(1, 4))
@settings(max_examples=200, deadline=None)
def test_the_search_stops_early_only_where_the_other_way_is_no_better(
    case: tuple[TargetPattern, Occupancy], dop: int
) -> None:
    target, atoms = case
    assume(np.count_nonzero(atoms) >= target.n_atoms)
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop, repair_below=0), Context())
    plan = planner.plan(atoms, target)
    both = plans_of_both_ways(planner, atoms, target)
    assert all(bound <= n_batches for n_batches, _, _, bound in both)
    best = min(way[:3] for way in both)
    assert (plan.n_batches, plan.n_atom_moves, kernels.distance(plan.moves.copy())) == best


def test_repair_is_chosen_by_atom_moves_and_batches_together() -> None:
    """A moved atom weighs three times as much as a batch; here, batches settle some of the choices."""
    fill = np.zeros((10, 10), np.bool_)
    fill[2:8, 2:8] = True
    target, grid = TargetPattern(fill, np.zeros_like(fill)), SiteGrid(10, 10)
    planner, plain = (
        PscaPlanner(PscaSettings(repair_below=share), Context(grid=grid)) for share in (1.0, 0.0)
    )
    n_settled_by_batches = 0
    for atoms in loadings(100, (10, 10), 0.6):
        moves, offsets = planner._repair(atoms, fill, target.clear)
        repaired, sorted_ = (len(moves), len(offsets) - 1), plain.plan(atoms, target)
        choices = [repaired, (sorted_.n_atom_moves, sorted_.n_batches)]
        costs = [3 * n_moves + n_batches for n_moves, n_batches in choices]
        plan = planner.plan(atoms, target)
        assert 3 * plan.n_atom_moves + plan.n_batches == min(costs)
        n_settled_by_batches += (choices[0][0] < choices[1][0]) != (costs[0] < costs[1])
    assert n_settled_by_batches > 3
