"""Plans once more: what a planner makes of the images that a run was planned on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from labseq.errors import LabseqError
from labseq.model import CycleRecord, MotionSpec, Plan, PlanReport, SiteGrid, StageTiming, TargetPattern
from labseq.model.estimate import Estimate, mean
from labseq.motion import check_plan
from labseq.recording import Shot
from labseq.roles import Planner
from labseq.session.occupancies import image_before
from labseq.session.planning import call_planner


@dataclass(frozen=True, slots=True)
class PlanCounts:
    """A plan in numbers.

    Attributes:
        n_batches: Its batches.
        n_atom_moves: Its atom moves.
        duration_s: From the start of the cycle to the end of its last batch.
        planning_s: Time that it took to plan on this computer, or then on that of the run; nan if unknown.
        filling: Filling of the target after it, if no atom is lost.
        meets_target: Whether the target is then met.
    """

    n_batches: int
    n_atom_moves: int
    duration_s: float
    planning_s: float
    filling: float
    meets_target: bool

    @classmethod
    def of(cls, plan: Plan, report: PlanReport, target: TargetPattern, planning_s: float) -> PlanCounts:
        """Count a plan that was checked."""
        filling = 1.0 - report.n_defects / target.n_atoms if target.n_atoms else 1.0
        return cls(
            plan.n_batches, plan.n_atom_moves, report.duration_s, planning_s, filling, report.meets_target
        )


@dataclass(frozen=True, slots=True)
class ReplayedPlan:
    """A plan that was recorded, and what a planner plans on the same image.

    Attributes:
        shot: Index of the shot, from 0.
        step: Index of the step in the shot.
        cycle: Counted from 1.
        recorded: The plan of the run.
        replayed: The planner's; None if it failed, or its plan breaks a rule.
        same: Whether both are the same, move by move.
        failure: Why there is none, or "".
    """

    shot: int
    step: int
    cycle: int
    recorded: PlanCounts
    replayed: PlanCounts | None
    same: bool
    failure: str = ""


@dataclass(frozen=True, slots=True)
class MeanCounts:
    """Plans, summed up.

    Attributes:
        n_plans: How many.
        n_met: How many of them meet the target, if no atom is lost.
        n_batches: Batches.
        n_atom_moves: Atom moves.
        duration_s: From the start of the cycle to the end of the last batch.
        planning_s: Time that planning took.
        filling: Filling of the target afterwards, if no atom is lost.
    """

    n_plans: int
    n_met: int
    n_batches: Estimate
    n_atom_moves: Estimate
    duration_s: Estimate
    planning_s: Estimate
    filling: Estimate

    @classmethod
    def over(cls, plans: Sequence[PlanCounts]) -> MeanCounts:
        """Sum up plans; times that are not known are left out."""
        return cls(
            n_plans=len(plans),
            n_met=sum(plan.meets_target for plan in plans),
            n_batches=mean([plan.n_batches for plan in plans]),
            n_atom_moves=mean([plan.n_atom_moves for plan in plans]),
            duration_s=mean([plan.duration_s for plan in plans]),
            planning_s=mean([s for plan in plans if not math.isnan(s := plan.planning_s)]),
            filling=mean([plan.filling for plan in plans]),
        )


def replay_plans(
    shot: Shot, planner: Planner, name: str, degree_of_parallelism: int, grid: SiteGrid, motion: MotionSpec
) -> list[ReplayedPlan]:
    """Plan again on every image of a shot that was planned on.

    Args:
        shot: The shot.
        planner: What plans.
        name: Its name, for messages.
        degree_of_parallelism: Most tweezers on at once that its plans are checked for.
        grid: The grid of sites.
        motion: How the mobile tweezers move.

    Raises:
        RecordingError: The shot cannot be read.
    """
    found: list[ReplayedPlan] = []
    for cycle in shot.cycles:
        seen = image_before(cycle, shot.images)
        if seen is None:
            continue
        recorded = PlanCounts.of(cycle.plan, cycle.report, shot.target, _planning_s(shot.timing, cycle))
        replayed, same, failure = None, False, ""
        try:
            start_s = perf_counter()
            plan = call_planner(planner, name, seen.occupancy, shot.target)
            planning_s = perf_counter() - start_s
            report = check_plan(plan, seen.occupancy, shot.target, degree_of_parallelism, grid, motion, name)
            replayed, same = PlanCounts.of(plan, report, shot.target, planning_s), is_same(plan, cycle.plan)
        except LabseqError as error:
            failure = str(error)
        found.append(ReplayedPlan(shot.index, cycle.step, cycle.cycle, recorded, replayed, same, failure))
    return found


def is_same(one: Plan, other: Plan) -> bool:
    """Whether two plans are the same, move by move."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("moves", "batch_offsets", "linked")
    )


def _planning_s(timing: Sequence[StageTiming], cycle: CycleRecord) -> float:
    """How long it took to plan, on the run's computer; nan if nobody wrote that down."""
    place = ("plan", cycle.step, cycle.cycle)
    return next((one.host_s for one in timing if (one.stage, one.step, one.cycle) == place), math.nan)
