"""Loadings, targets and plans for the planners with a single tweezer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from labseq_single.planner import (
    SingleTweezerPlanner,
)
from numpy.typing import NDArray

from labseq.plugin import Context, MotionSpec, Occupancy, Plan, PlanReport, TargetPattern, check_plan

Bools = NDArray[np.bool_]
Site = tuple[int, int]


def plan_and_check(
    planner: type[SingleTweezerPlanner], atoms: Occupancy, target: TargetPattern, eject_slots: int = 1
) -> tuple[Plan, PlanReport]:
    motion = MotionSpec(eject_slots=eject_slots)
    plan = planner(None, Context(motion=motion)).plan(atoms, target)
    return plan, check_plan(plan, atoms, target, 1, motion=motion)


def loadings(n: int, shape: Site = (20, 20), filling: float = 0.75) -> Bools:
    return np.random.default_rng(1).random((n, *shape)) < filling


def in_the_middle(pattern: Any, shape: Site = (20, 20), *, clear: bool = True) -> TargetPattern:
    """A pattern in the middle of the grid; the other sites of its bounding box are to be empty."""
    small = np.asarray(pattern, np.bool_)
    top, left = (shape[0] - small.shape[0]) // 2, (shape[1] - small.shape[1]) // 2
    box = (slice(top, top + small.shape[0]), slice(left, left + small.shape[1]))
    fill, empty = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    fill[box] = small
    empty[box] = ~small & clear
    return TargetPattern(fill, empty)


def in_a_row(atoms: Sequence[int], fill: Sequence[int]) -> tuple[Bools, TargetPattern]:
    """One row of atoms, and the target that wants some of its sites filled."""
    wanted = np.array([fill], np.bool_)
    return np.array([atoms], np.bool_), TargetPattern(wanted, np.zeros_like(wanted))


def journeys(plan: Plan) -> list[list[Site]]:
    """The corners of each atom's way, from pick-up to drop-off."""
    ways: list[list[Site]] = []
    for batch in plan.batches:
        if not batch.linked:
            ways.append([tuple(batch.from_sites[0].tolist())])
        ways[-1].append(tuple(batch.to_sites[0].tolist()))
    return ways


def distance(plan: Plan) -> int:
    return int(np.abs(plan.moves[:, 2:].astype(int) - plan.moves[:, :2]).sum())
