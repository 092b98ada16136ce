"""PSCA: its variants, its limits, and plans of few batches; tests/plugins/test_planners.py has the rest."""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import labseq_psca
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from labseq_psca import kernels_fewest, kernels_lines, kernels_repair
from labseq_psca.planner import PscaPlanner, PscaSettings, ToneLimits
from labseq_psca.repair import RepairPlanner, RepairSettings
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from labseq import Occupancy, SiteGrid, TargetPattern, check_plan, make_target
from labseq.model import LossSpec
from labseq.motion import predict_survival
from labseq.plugin import ConfigError, Context, MotionSpec, Plan, Registry
from labseq.plugin.plan_kernels import empty_plan
from labseq.testing.strategies import cases

from .planning import COMPACT, loadings, plan_and_check, psca

Bools = NDArray[np.bool_]


def test_the_papers_variant_takes_fewest_batches_with_half_filled_rows_first() -> None:
    """As the paper says; the text gives fewer batches than the paper's own program has (29.61)."""
    n_batches = {
        order: np.mean(
            [
                psca(variant="paper", row_order=order)(Context(), 15).plan(a, COMPACT).n_batches
                for a in loadings(60)
            ]
        )
        for order in ("half_filled", "fullest")
    }
    assert n_batches["half_filled"] == pytest.approx(20.6, abs=0.8)
    assert n_batches["fullest"] > n_batches["half_filled"] + 1.0


@pytest.mark.parametrize(("order", "row"), [("half_filled", 1), ("fullest", 0), ("emptiest", 2)])
def test_the_papers_variant_sorts_rows_in_the_order_that_is_set(order: Any, row: int) -> None:
    atoms = np.array([[1, 1, 0, 1], [1, 1, 0, 0], [0, 1, 0, 0]], np.bool_)
    fill = np.array([[0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], np.bool_)
    planner = PscaPlanner(PscaSettings(variant="paper", row_order=order), Context())
    plan = planner.plan(atoms, TargetPattern(fill, np.zeros_like(fill)))
    assert plan.moves[0, 0] == row


def test_the_papers_variant_repairs_nothing() -> None:
    atoms = np.random.default_rng(2).random((20, 20)) > np.where(COMPACT.fill, 0.02, 0.5)
    moves = [
        psca(variant="paper", repair_below=share)(Context(), 7).plan(atoms, COMPACT).moves.tolist()
        for share in (0.1, 0.0)
    ]
    assert moves[0] == moves[1]


def test_few_defects_are_repaired_with_few_atom_moves() -> None:
    rng = np.random.default_rng(1)
    repairing, plain = (PscaPlanner(PscaSettings(repair_below=x), Context()) for x in (0.1, 0))
    n_defects, moves = 0, np.zeros(2, np.int64)
    for atoms in loadings(40):
        plan, report = plan_and_check(psca(), atoms, COMPACT)
        lost = np.zeros((22, 22), np.bool_)
        lost[tuple(plan.moves[:, 2:].T + 1)] = True
        seen = report.predicted & ~(lost[1:-1, 1:-1] & (rng.random((20, 20)) < 0.02))
        n_defects += COMPACT.n_defects(seen)
        for i, planner in enumerate((repairing, plain)):
            plan = planner.plan(seen, COMPACT)
            assert check_plan(plan, seen, COMPACT, 7).meets_target
            moves[i] += n_picked_up(plan)
    assert moves[0] <= 3.0 * n_defects
    assert moves[0] < 0.6 * moves[1]


def test_many_defects_are_not_repaired() -> None:
    for atoms in loadings(5):
        plans = [
            psca(**settings)(Context(), 7).plan(atoms, COMPACT) for settings in ({}, {"repair_below": 0})
        ]
        assert np.array_equal(plans[0].moves, plans[1].moves)


@pytest.mark.parametrize(
    ("tones", "motion", "most"),
    [
        ({}, {}, (7, 7)),
        ({}, {"max_tweezers": 3}, (3, 3)),
        ({}, {"max_row_tones": 2}, (2, 7)),
        ({}, {"max_column_tones": 1}, (7, 1)),
        ({"row": 3, "col": 5}, {}, (3, 5)),
        ({"row": 4}, {}, (4, 7)),
        ({"col": 1}, {}, (7, 1)),
    ],
)
def test_limits_of_profile_and_settings_are_kept_and_used(
    tones: dict[str, int], motion: dict[str, int], most: tuple[int, int]
) -> None:
    used = np.ones(2, np.int64)
    for atoms in loadings(10):
        plan, report = plan_and_check(psca(max_tones=ToneLimits(**tones)), atoms, COMPACT, **motion)
        assert report.meets_target
        for batch in plan.batches:
            used = np.maximum(used, [len(np.unique(batch.from_sites[:, axis])) for axis in (0, 1)])
    assert tuple(used) == most


def test_the_better_of_both_ways_is_taken() -> None:
    atoms, fill = np.zeros((2, 4, 4), np.bool_)
    atoms[0] = fill[3] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    assert plan_and_check(psca(), atoms, target)[0].n_batches == 4
    assert plan_and_check(psca(), atoms.T, TargetPattern(fill.T, target.clear))[0].n_batches == 4
    fill = np.zeros((4, 4), np.bool_)
    fill[0, 1:] = fill[1, 0] = True
    plan, _ = plan_and_check(psca(), atoms, TargetPattern(fill, np.zeros_like(fill)))
    assert plan.moves.tolist() == [[0, 0, 1, 0]]


ROOT = Path(__file__).parents[2]
N_SEEDS = int(os.environ.get("LABSEQ_SEEDS", "1"))
replay: Callable[[dict[str, Any]], None] = runpy.run_path(str(ROOT / "tests" / "system" / "replay.py"))[
    "replay"
]

PATTERNS: dict[str, tuple[str, SiteGrid, dict[str, Any]]] = {
    "compact": ("compact", SiteGrid(), {"rows": 15, "cols": 15}),
    "whole grid": ("checkerboard", SiteGrid(lattice="square"), {"rows": 20, "cols": 20}),
    "corner": ("sierpinski", SiteGrid(lattice="square"), {"order": 4, "origin": (4, 4)}),
    "ring": ("ring", SiteGrid(), {"radius": 7}),
    "bitmap": ("bitmap", SiteGrid(), {"file": str(ROOT / "sequences" / "lion_head.txt")}),
    "kagome": ("kagome", SiteGrid(), {"rows": 15, "cols": 15}),
    "honeycomb": ("honeycomb", SiteGrid(shear=-1), {"rows": 20, "cols": 20}),
    "link_kagome": ("link_kagome", SiteGrid(shear=-1), {"rows": 17, "cols": 17}),
}


def replay_plan(atoms: Bools, target: TargetPattern, grid: SiteGrid) -> None:
    """Plan, and replay the plan with the array that is expected at its end."""
    plan = psca()(Context(grid=grid), 7).plan(atoms, target)
    after = atoms.copy()
    for batch in plan.batches:
        inside = np.logical_and(batch.to_sites >= 0, batch.to_sites < grid.shape).all(axis=1)
        after[tuple(batch.from_sites.T)] = False
        after[tuple(batch.to_sites[inside].T)] = True
    replay(
        {
            "grid": {"n_rows": grid.n_rows, "n_cols": grid.n_cols},
            "degree_of_parallelism": 7,
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


def exactly(n_atoms: int, order: NDArray[np.intp], shape: tuple[int, int]) -> Bools:
    """Atoms on the first sites of an order of all sites."""
    atoms = np.zeros(shape, np.bool_)
    atoms.flat[order[:n_atoms]] = True
    return atoms


def enough_atoms(target: TargetPattern, rng: np.random.Generator) -> Iterator[tuple[str, Bools]]:
    """Loadings with enough atoms, some with exactly enough of them, and one that lacks an atom."""
    shape, n_sites, n_atoms = target.shape, target.fill.size, target.n_atoms
    shuffled = rng.permutation(n_sites)
    column_by_column = np.arange(n_sites).reshape(shape).T[::-1].ravel()
    off_target = shuffled[np.argsort(target.fill.flat[shuffled], kind="stable")]
    yield "random", rng.random(shape) < 0.75
    yield "full", np.ones(shape, np.bool_)
    yield "all but one", exactly(n_sites - 1, shuffled, shape)
    yield "exactly enough, anywhere", exactly(n_atoms, shuffled, shape)
    yield "exactly enough, from the top", exactly(n_atoms, np.arange(n_sites), shape)
    yield "exactly enough, from the right", exactly(n_atoms, column_by_column, shape)
    yield "exactly enough, where they are not wanted", exactly(n_atoms, off_target, shape)
    yield "met already", target.fill.copy()
    yield "one too few", exactly(n_atoms - 1, shuffled, shape)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_extreme_loadings_end_right(pattern: str) -> None:
    """By a replay of the plan, one site at a time, that uses nothing of labseq."""
    name, grid, values = PATTERNS[pattern]
    target = make_target(name, grid=grid, **values)
    for seed in range(N_SEEDS):
        for loading, atoms in enough_atoms(target, np.random.default_rng(seed)):
            try:
                replay_plan(atoms, target, grid)
            except Exception as error:
                raise AssertionError(f"{loading}, seed {seed}: {error}") from error


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
        plan, report = plan_and_check(psca(), atoms, COMPACT, dop)
        assert report.meets_target
        n_batches[i], n_lines[i] = plan.n_batches, line_cover(COMPACT.fill & ~atoms)
    assert (n_batches >= n_lines).all()
    assert n_batches.mean() == pytest.approx(batches, rel=0.005)
    if dop == 15:
        assert n_batches.mean() < 1.27 * n_lines.mean()


def plans_of_both_ways(
    planner: PscaPlanner, atoms: Bools, target: TargetPattern
) -> list[tuple[tuple[int, int, int], int]]:
    """Costs of the plan, and the lower bound of its batches: rows first, columns first."""
    found: list[tuple[tuple[int, int, int], int]] = []
    along, across = planner._limits
    for grids in ((atoms, target.fill, target.clear), (atoms.T, target.fill.T, target.clear.T)):
        after, fill, clear = (np.array(grid, order="C") for grid in grids)
        plan = kernels_fewest.sort_rows(empty_plan(after.size), after, fill, clear, along, 0)
        bound = plan[3] + kernels_fewest.least_batches(after, fill, clear, across)
        plan = kernels_lines.compress_columns(plan, after, fill, clear, across, planner._eject_slots)
        found.append((kernels_fewest.costs(plan), bound))
        along, across = across, along
    return found


@given(cases((7, 7)), st.integers(1, 4))
@settings(max_examples=80, deadline=None)
def test_the_search_stops_early_only_where_the_other_way_is_no_better(
    case: tuple[TargetPattern, Occupancy], dop: int
) -> None:
    target, atoms = case
    assume(np.count_nonzero(atoms) >= target.n_atoms)
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop, repair_below=0), Context())
    plan = planner.plan(atoms, target)
    both = plans_of_both_ways(planner, atoms, target)
    assert all(bound <= costs[0] for costs, bound in both)
    distance = np.abs(plan.moves[:, 2:] - plan.moves[:, :2]).sum()
    assert (plan.n_batches, plan.n_atom_moves, distance) == min(costs for costs, _ in both)


def test_repair_is_chosen_by_expected_survival() -> None:
    """Where a move loses little, batches and so time decide; where it loses much, atoms do."""
    rng = np.random.default_rng(2)
    n_moves: list[int] = []
    for loss, lifetime_s in ((0.05, 1000.0), (1e-6, 1.0)):
        motion = MotionSpec(losses=LossSpec(move=loss, lifetime_s=lifetime_s), overhead_per_batch_s=1e-3)
        planner, plain = (
            PscaPlanner(PscaSettings(repair_below=share), Context(motion=motion)) for share in (0.1, 0.0)
        )
        n_moves.append(0)
        for _ in range(30):
            seen = rng.random((20, 20)) > np.where(COMPACT.fill, 0.02, 0.5)
            plans = planner.plan(seen, COMPACT), plain.plan(seen, COMPACT)
            chances = [chance(plan, seen, motion) for plan in plans]
            assert chances[0] >= chances[1]
            n_moves[-1] += n_picked_up(plans[0])
    assert n_moves[0] < 0.9 * n_moves[1]


def test_repair_after_another_planner_is_that_of_psca() -> None:
    rng = np.random.default_rng(3)
    after = RepairPlanner(RepairSettings(), Context(), PscaPlanner(PscaSettings(repair_below=0), Context()))
    within = PscaPlanner(PscaSettings(), Context())
    for n_lost in (0.02, 0.3):
        seen = rng.random((20, 20)) > np.where(COMPACT.fill, n_lost, 0.5)
        assert after.plan(seen, COMPACT).is_same(within.plan(seen, COMPACT))


@pytest.mark.parametrize(
    ("after", "text"),
    [
        ({"use": "tetris"}, "'tetris'; expected one of psca$"),
        ({"use": "repair"}, "'repair'; expected one of psca$"),
        ({"degree_of_parallelism": 7}, "None; expected one of psca$"),
        ({"use": "psca", "row_order": "random"}, r"after\.row_order: .*half_filled"),
        (
            {"use": "psca", "rows": "half_filled"},
            r"after\.rows: .*the settings of .psca. are",
        ),
    ],
)
def test_a_planner_that_repair_cannot_follow_is_refused(after: dict[str, Any], text: str) -> None:
    registry = Registry()
    plugin: Any = labseq_psca
    plugin.labseq_register(registry)
    entry: Any = registry.get("planner", "repair")
    with pytest.raises(ConfigError, match=text):
        entry.factory(RepairSettings(after=after), Context())
    assert entry.factory(RepairSettings(), Context()).degree_of_parallelism == 7


def test_a_repair_costs_the_time_that_the_check_predicts(monkeypatch: pytest.MonkeyPatch) -> None:
    motion = MotionSpec(losses=LossSpec(move=0.01, lifetime_s=10.0), overhead_per_batch_s=1e-3)
    found: list[tuple[float, float, float]] = []

    def repair(*arguments: Any) -> Any:
        found.append(arguments[-1])
        return plan_repair(*arguments)

    plan_repair = kernels_repair.plan_repair
    monkeypatch.setattr(kernels_repair, "plan_repair", repair)
    atoms = COMPACT.fill.copy()
    atoms[10, 10], atoms[0, 0] = False, True
    PscaPlanner(PscaSettings(), Context(motion=motion)).plan(atoms, COMPACT)
    ((move, batch, site),) = found
    for n_sites in (1, 3):
        plan = Plan.from_batches([([(0, 0)], [(0, n_sites)])])
        report = check_plan(plan, atoms, COMPACT, 1, SiteGrid(), motion)
        lost = COMPACT.n_atoms * (report.duration_s - motion.overhead_per_cycle_s) / 10.0
        assert batch + n_sites * site == pytest.approx(lost)
    assert move == pytest.approx(-np.log(0.99))


def n_picked_up(plan: Plan) -> int:
    """Atoms that are moved, those that turn counted once."""
    return sum(len(batch) for batch in plan.batches if not batch.linked)


def chance(plan: Plan, atoms: Bools, motion: MotionSpec) -> float:
    """Predicted probability that the array is defect-free."""
    grid = SiteGrid()
    report = check_plan(plan, atoms, COMPACT, 7, grid, motion)
    return predict_survival(plan, report, atoms, COMPACT, grid, motion).p_defect_free
