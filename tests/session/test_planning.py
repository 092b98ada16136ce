from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.assembly.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.errors import InvalidPlanError, PlanError
from labseq.model import SiteGrid
from labseq.plain import to_plain
from labseq.plans.plan import PlanReport
from tests.system.replay import replay

PLANNERS = '''
import numpy as np
import labseq

LABSEQ_API = 1


class Planner:
    def __init__(self, settings, context):
        self.context = context


class Raises(Planner):
    def plan(self, occupancy, target):
        raise ZeroDivisionError("oh")


class Refuses(Planner):
    def plan(self, occupancy, target):
        raise labseq.PlanError("no plan today")


class Lies(Planner):
    def plan(self, occupancy, target):
        return "a plan"


class Breaks(Planner):
    def plan(self, occupancy, target):
        return labseq.Plan.from_batches([([(0, 0)], [(1, 1)])])


class Writes(Planner):
    def plan(self, occupancy, target):
        occupancy[:] = False
        return labseq.Plan.from_batches([])


class Draws(Planner):
    """Ejects the topmost atom of a random column."""

    degree_of_parallelism = 2

    def plan(self, occupancy, target):
        col = int(self.context.random.machine().integers(occupancy.shape[1]))
        return labseq.Plan.from_batches([([(0, col)], [(-1, col)])])


@labseq.plugin.hookimpl
def labseq_register(registry):
    for planner in (Raises, Refuses, Lies, Breaks, Writes, Draws):
        registry.planner(planner.__name__.lower(), planner)
'''


def planned(
    occupancy: str, target: str = "{pattern: compact, rows: 3, cols: 3}", **options: Any
) -> PlannedMoves:
    return plan_moves(PlanRequest(occupancy, target, **options))


def written(moves: PlannedMoves) -> dict[str, Any]:
    return to_plain(PlanReport.of(moves))


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "planners.py").write_text(PLANNERS, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))


@settings(max_examples=10)
@given(
    st.integers(0, 10_000),
    st.sampled_from(
        [
            "{pattern: compact, rows: 6, cols: 6}",
            "{pattern: kagome, rows: 7, cols: 7}",
            "{pattern: sierpinski, rows: 8, cols: 8}",
            "{pattern: checkerboard, rows: 5, cols: 6}",
            "{pattern: ring, radius: 3}",
        ]
    ),
    st.integers(1, 20),
)
def test_the_json_is_enough_to_replay_a_plan(seed: int, target: str, dop: int) -> None:
    moves = planned("random:10x10@0.75", target, seed=seed, degree_of_parallelism=dop)
    document = written(moves)
    replay(document)
    assert document["predicted"] == moves.report.predicted.astype(int).tolist()
    assert (document["planner"], document["seed"], document["degree_of_parallelism"]) == ("psca", seed, dop)
    assert document["duration_s"] == moves.report.duration_s
    assert document["grid"].items() >= {"spacing_m": 4.49e-6, "lattice": "triangular", "shear": 1}.items()
    assert moves.n_ejected == np.sum(document["occupancy"]) - np.sum(document["predicted"])
    assert moves.n_filled == moves.target.n_atoms - moves.n_missing_atoms
    assert moves.max_tweezers <= dop


@pytest.mark.parametrize("occupancy", ["random:3x3@0", "random:3x3@1"])
def test_without_atoms_or_defects_nothing_is_moved(occupancy: str) -> None:
    moves = planned(occupancy, seed=1)
    assert (moves.plan.n_batches, moves.max_tweezers, moves.n_ejected) == (0, 0, 0)
    assert moves.report.duration_s == 0.0


def test_too_few_atoms_fill_the_sites_nearest_to_the_centre() -> None:
    moves = planned("random:6x6@0.2", "{pattern: compact, rows: 4, cols: 4}", seed=3)
    fill, sites_m = moves.target.fill, SiteGrid(6, 6).positions_m
    from_centre_m = np.linalg.norm(sites_m - sites_m[fill].mean(axis=0), axis=-1)
    filled = fill & moves.report.predicted
    assert from_centre_m[filled].max() <= from_centre_m[fill & ~filled].min() + 1e-9
    assert moves.n_missing_atoms == 16 - int(moves.occupancy.sum()) > 0
    assert moves.n_filled == int(moves.occupancy.sum())
    assert not moves.report.meets_target


def test_more_parallelism_than_the_machine_has_is_not_used() -> None:
    assert planned("random:5x5@0.7", seed=1, degree_of_parallelism=99).degree_of_parallelism == 20


@pytest.mark.usefixtures("plugins")
def test_the_seed_repeats_the_occupancy_and_what_the_planner_draws(tmp_path: Path) -> None:
    first, again, *others = (planned("random:4x9@1", planner="draws", seed=seed) for seed in (1, 1, 2, 3, 4))
    assert written(first) == written(again)
    assert len({move.plan.moves.tobytes() for move in (first, *others)}) > 1
    assert written(first)["batches"][0]["to"][0][0] == -1
    assert (first.n_ejected, first.degree_of_parallelism) == (1, 2)
    fresh = planned("random:4x9@1", planner="draws")
    assert written(planned("random:4x9@1", planner="draws", seed=fresh.seed)) == written(fresh)
    np.save(tmp_path / "full.npy", np.ones((4, 9), np.bool_))
    assert planned(str(tmp_path / "full.npy"), planner="draws", seed=5).seed == 5
    assert planned(str(tmp_path / "full.npy"), planner="draws").seed is None


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("planner", "error", "words"),
    [
        ("raises", PlanError, "planner 'raises': plan() raised ZeroDivisionError: oh"),
        ("refuses", PlanError, "planner 'refuses': no plan today"),
        ("lies", PlanError, "planner 'lies'"),
        ("breaks", InvalidPlanError, "planner 'breaks': batch 0, atom move 0 breaks the rule"),
    ],
)
def test_a_planner_that_fails_is_named(planner: str, error: Any, words: str) -> None:
    with pytest.raises(error) as caught:
        planned("random:4x4@1", planner=planner, seed=1)
    assert words in str(caught.value)


@pytest.mark.usefixtures("plugins")
def test_a_planner_cannot_change_the_occupancy() -> None:
    assert planned("random:4x4@1", planner="writes", seed=1).occupancy.all()
