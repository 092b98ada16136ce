"""Planning, checking and tone programs, beside one linear assignment of the same atoms.

Each group holds the assignment too, so that pytest-benchmark's table gives the
ratios within one run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from labseq.plugin import Context, MotionSpec, Plan, SiteGrid, TargetPattern
from labseq.plugin.motion import tone_program
from labseq.plugin.planning import check_plan

Bools = NDArray[np.bool_]
SIZES = {"20 -> 15": (20, 15), "64 -> 48": (64, 48)}
PAPER = "20 -> 15"


def compact(n_grid: int, n_target: int) -> TargetPattern:
    fill = np.zeros((n_grid, n_grid), np.bool_)
    start = (n_grid - n_target) // 2
    fill[start : start + n_target, start : start + n_target] = True
    return TargetPattern(fill, np.zeros_like(fill))


def loading(n_grid: int) -> Bools:
    return np.random.default_rng(1).random((n_grid, n_grid)) < 0.75


def squared_distances(atoms: Bools, target: TargetPattern) -> NDArray[np.int64]:
    gap = np.argwhere(target.fill)[:, None, :] - np.argwhere(atoms)[None, :, :]
    return (gap**2).sum(axis=2)


class Case:
    """One loading, its plan, and all that is needed to make and check it."""

    def __init__(self, n_grid: int, n_target: int, dop: int, lanes: str = "") -> None:
        self.dop = dop
        self.atoms, self.target = loading(n_grid), compact(n_grid, n_target)
        self.grid = SiteGrid(n_grid, n_grid)
        self.motion = MotionSpec(max_row_tones=n_grid, max_column_tones=n_grid)
        context = Context(grid=self.grid, motion=self.motion)
        self.planner: PscaPlanner | GridPlanner = PscaPlanner(
            PscaSettings(degree_of_parallelism=dop), context
        )
        if lanes:
            settings = GridSettings.model_validate({"degree_of_parallelism": dop, "lanes": lanes})
            self.planner = GridPlanner(settings, context)
        self.planner.warm()
        self.plan = self.make_plan()

    def make_plan(self) -> Plan:
        return self.planner.plan(self.atoms, self.target)

    def check(self) -> Any:
        return check_plan(self.plan, self.atoms, self.target, self.dop, self.grid, self.motion)

    def tones(self) -> Any:
        return tone_program(self.plan, self.grid, self.motion)


@pytest.mark.parametrize("dop", [15, 7, 2])
@pytest.mark.parametrize("size", SIZES)
def test_psca(benchmark: Any, size: str, dop: int) -> None:
    benchmark.group = size
    case = Case(*SIZES[size], dop)
    plan = benchmark(case.make_plan)
    benchmark.extra_info["batches"] = plan.n_batches


@pytest.mark.parametrize("work", ["check", "tones"])
@pytest.mark.parametrize("dop", [15, 2])
def test_playing(benchmark: Any, work: str, dop: int) -> None:
    benchmark.group = PAPER
    case = Case(*SIZES[PAPER], dop)
    call: Callable[[], Any] = getattr(case, work)
    assert benchmark(call) is not None


@pytest.mark.parametrize("work", ["make_plan", "check", "tones"])
@pytest.mark.parametrize("lanes", ["straight", "weaving"])
def test_lanes(benchmark: Any, work: str, lanes: str) -> None:
    """Straight lanes, whose paths have fewer knots, beside those that weave."""
    benchmark.group = PAPER
    case = Case(*SIZES[PAPER], 15, lanes)
    call: Callable[[], Any] = getattr(case, work)
    assert benchmark(call) is not None


def test_linear_sum_assignment(benchmark: Any) -> None:
    benchmark.group = PAPER
    case = Case(*SIZES[PAPER], 15)
    cost = squared_distances(case.atoms, case.target)
    sites, _ = benchmark(linear_sum_assignment, cost)
    assert len(sites) == case.target.n_atoms
