"""Planners, loadings and targets for the tests of the planners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from labseq_grid.planner import GridPlanner, GridSettings
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_psca.repair import RepairPlanner, RepairSettings
from labseq_rivals.planners import (
    CompressionPlanner,
    HcaPlanner,
    LineSettings,
    LsapPlanner,
    LsapSquaredPlanner,
    Mta1Planner,
    TetrisPlanner,
)
from numpy.typing import NDArray

from labseq.plugin import Context, MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern
from labseq.plugin.planning import PlanReport, check_plan

Bools = NDArray[np.bool_]
MakePlanner = Callable[[Context, int], Any]
"""Makes a planner for a context and a degree of parallelism."""


def psca(**settings: Any) -> MakePlanner:
    return lambda context, dop: PscaPlanner(PscaSettings(degree_of_parallelism=dop, **settings), context)


def grid(context: Context, dop: int) -> GridPlanner:
    return GridPlanner(GridSettings(degree_of_parallelism=dop), context)


def repair(make: MakePlanner) -> MakePlanner:
    return lambda context, dop: RepairPlanner(RepairSettings(below=1), context, make(context, dop))


def mta1(context: Context, dop: int) -> Mta1Planner:
    return Mta1Planner(LineSettings(degree_of_parallelism=dop), context)


def tetris(context: Context, dop: int) -> TetrisPlanner:
    return TetrisPlanner(LineSettings(degree_of_parallelism=dop), context)


def single(planner: type[Any]) -> MakePlanner:
    return lambda context, dop: planner(None, context)


SINGLE = {cls.name: single(cls) for cls in (LsapPlanner, LsapSquaredPlanner, CompressionPlanner, HcaPlanner)}
"""Planners with one mobile tweezer: name -> how to make them."""
PLANNERS: dict[str, MakePlanner] = {
    "psca": psca(),
    "repair": repair(tetris),
    "grid": grid,
    "mta1": mta1,
    "tetris": tetris,
    **SINGLE,
}
VARIANTS = {
    "psca, as in the paper": psca(variant="paper"),
    "psca, repair": psca(repair_below=1),
    "repair, after grid": repair(grid),
}


def plan_and_check(
    make: MakePlanner, atoms: Occupancy, target: TargetPattern, dop: int = 7, **motion: Any
) -> tuple[Plan, PlanReport]:
    spec = MotionSpec(**motion)
    planner = make(Context(grid=SiteGrid(), motion=spec), dop)
    plan = planner.plan(atoms, target)
    return plan, check_plan(plan, atoms, target, planner.degree_of_parallelism, motion=spec)


def loadings(n: int, shape: tuple[int, int] = (20, 20), filling: float = 0.75, seed: int = 1) -> Bools:
    return np.random.default_rng(seed).random((n, *shape)) < filling


def in_the_middle(pattern: Any, shape: tuple[int, int] = (20, 20)) -> TargetPattern:
    """A pattern in the middle of the grid; the other sites of its bounding box are to be empty."""
    small = np.asarray(pattern, np.bool_)
    top, left = (shape[0] - small.shape[0]) // 2, (shape[1] - small.shape[1]) // 2
    box = (slice(top, top + small.shape[0]), slice(left, left + small.shape[1]))
    fill, empty = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    fill[box], empty[box] = small, ~small
    return TargetPattern(fill, empty)


COMPACT = in_the_middle(np.ones((15, 15)))
