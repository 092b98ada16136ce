"""Checks a plan against every rule that it must keep before it is played."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from labseq.errors import InvalidPlanError, LimitError
from labseq.model import MotionSpec, Plan, PlanReport, SiteGrid, TargetPattern, as_occupancy
from labseq.motion.tones import default_grid, path_geometry, site_time_s

RULES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "shape": "plan, occupancy, target and grid belong together, and no batch is empty",
        "grid": "atoms come from the grid, and go to a site of the grid or to an ejection slot",
        "straight": "an atom of a line batch moves along one row or one column, all along the same axis",
        "linked": "a linked batch starts from exactly the goals of the line batch before, none outside",
        "source": "an atom that is moved is there, and is moved once in a batch",
        "goal": "a goal is free once the batch's own atoms are lifted, and no two atoms share one",
        "tones": "one trajectory per tone, and no more tones than an axis can play",
        "order": "the tones of an axis keep their order, and stay a site apart, or the clearance with paths",
        "parallelism": "every crossing of a row tone and a column tone counts as a tweezer",
        "crossing": "a crossing that the plan does not name picks up no atom",
        "path": "no crossing, named or not, passes over, comes too near to or ends on an atom at rest",
        "ejection": "only the outermost atoms of a line are ejected",
    }
)
"""Meaning of each rule of :func:`labseq.check_plan`, by name."""


def check_plan(
    plan: Plan,
    occupancy: ArrayLike,
    target: TargetPattern,
    degree_of_parallelism: int,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    planner: str = "",
) -> PlanReport:
    """Check a plan against all :data:`RULES` and predict what it will do.

    The rule ``order`` only compares the ends, for this reason. The tones of a batch start together and have
    the same speed v until each reaches its goal. While two neighbours move the same way, their gap is
    constant. Otherwise it changes at 2v, v or not at all, always with the same sign. It only shrinks if they
    move towards each other and only grows if they move apart, and after the first has arrived it stays
    monotonic until the second has. So the gap is monotonic from start to end and never below the smaller of
    its values at the two ends. These are whole numbers of sites, so it is at least one site if the order is
    kept. If the speed is not constant, and on paths from one knot to the next, all tones have made the same
    fraction of their paths at any time, so the gap changes evenly from start to end.

    Args:
        plan: The plan.
        occupancy: bool (n_rows, n_cols), the occupancy that the plan was made for.
        target: The wanted pattern. A plan that misses it breaks no rule.
        degree_of_parallelism: Most tweezers on at once that the planner was allowed.
        grid: The grid of sites. By default it has the occupancy's shape and the paper's spacing.
        motion: How the tweezers move. By default as in the paper.
        planner: Name of the planner, for the error message.

    Returns:
        Predicted occupancy, times and numbers of tweezers.

    Raises:
        InvalidPlanError: The plan breaks a rule, which the error names with place and cause. Or plan, target,
            grid or motion has the wrong type.
        LimitError: The degree of parallelism is not a whole number, or below 1.

    Example:
        >>> target = TargetPattern(fill=[[False, True]], clear=[[True, False]])
        >>> plan = Plan.from_batches([([(0, 0)], [(0, 1)])])
        >>> check_plan(plan, [[True, False]], target, degree_of_parallelism=1).meets_target
        True
    """
    from labseq.motion.check_kernels import check, count_wrong

    _check_types(plan, target, degree_of_parallelism, grid, motion, planner)
    if degree_of_parallelism < 1:
        raise LimitError("the degree of parallelism", degree_of_parallelism, "at least 1")
    motion = motion or MotionSpec()
    try:
        atoms = as_occupancy(occupancy, target.shape if grid is None else grid.shape).copy()
    except (TypeError, ValueError) as error:
        raise InvalidPlanError("shape", str(error), planner=planner) from error
    if target.shape != atoms.shape:
        detail = f"the target has shape {target.shape}; the occupancy has {atoms.shape}"
        raise InvalidPlanError("shape", detail, planner=planner)
    grid = grid or default_grid(*target.shape)
    max_tweezers = min(degree_of_parallelism, motion.max_tweezers)
    overheads_s = motion.overhead_per_cycle_s, motion.overhead_per_batch_s
    times_s = np.array(
        [*overheads_s, motion.pick_up_s, site_time_s(grid, motion), motion.drop_off_s], np.float64
    )
    end_s = np.empty(plan.n_batches, np.float64)
    n_tweezers = np.empty(plan.n_batches, np.int32)
    fault, *fault_place = check(
        plan.moves,
        plan.batch_offsets,
        plan.linked,
        (plan.path_shapes, plan.path_positions, plan.path_off),
        atoms,
        max_tweezers,
        motion.max_row_tones,
        motion.max_column_tones,
        motion.eject_slots,
        path_geometry(grid, motion),
        times_s,
        end_s,
        n_tweezers,
    )
    if fault:
        from labseq.motion.faults import raise_plan_error  # a plan without faults needs no explanation

        raise_plan_error(fault, fault_place, plan, grid, max_tweezers, motion, planner)
    n_defects, n_surplus = count_wrong(atoms, target.fill, target.clear)
    for array in (atoms, end_s, n_tweezers):
        array.flags.writeable = False
    return PlanReport(atoms, end_s, n_tweezers, n_defects, n_surplus)


def _check_types(plan: Any, target: Any, dop: Any, grid: Any, motion: Any, planner: str) -> None:
    """Refuse arguments of the wrong type, which a script may mix up."""
    if not isinstance(dop, (int, np.integer)):
        raise LimitError("the degree of parallelism", repr(dop), "a whole number, at least 1")
    if not isinstance(plan, Plan):
        expected, argument = "a Plan (labseq.plugin.Plan.from_batches makes one)", plan
    elif not isinstance(target, TargetPattern):
        expected, argument = "a TargetPattern as target", target
    elif grid is not None and not isinstance(grid, SiteGrid):
        expected, argument = "a SiteGrid as grid", grid
    elif motion is not None and not isinstance(motion, MotionSpec):
        expected, argument = "a MotionSpec as motion", motion
    else:
        return
    raise InvalidPlanError("shape", f"expected {expected}, not {type(argument).__name__}", planner=planner)
