"""The check of a plan: every rule that it must keep before it is played."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from labseq.errors import InvalidPlanError, LimitError
from labseq.model import MotionSpec, Plan, PlanReport, SiteGrid, TargetPattern, as_occupancy
from labseq.motion.axes import AXES
from labseq.motion.tones import default_grid, path_geometry, site_time_s
from labseq.units import format_quantity

RULES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "shape": "plan, occupancy, target and grid belong together, and no batch is empty",
        "grid": "atoms come from the grid, and go to a site of it or to an ejection slot",
        "straight": "an atom of a line batch moves along one row or one column, all along the same axis",
        "linked": "a linked batch starts from exactly the goals of the line batch before, none outside",
        "source": "an atom that is moved is there, and is moved once in a batch",
        "goal": "a goal is free once the batch's own atoms are lifted, and no two atoms share one",
        "tones": "one trajectory per tone, and no more tones than an axis can play",
        "order": "the tones of an axis keep their order and least distance: a site, with paths the clearance",
        "parallelism": "every crossing of a row tone and a column tone counts as a tweezer",
        "crossing": "a crossing that the plan does not name picks up no atom",
        "path": "no crossing, named or not, passes over, comes too near to or ends on an atom that stands",
        "ejection": "only the outermost atoms of a line are ejected",
    }
)
"""The rules of :func:`labseq.check_plan`: name -> meaning."""

FAULTS: Final[Mapping[str, tuple[str, str]]] = {
    "EMPTY_BATCH": ("shape", "it has no atom moves; leave it out"),
    "SOURCE_OUTSIDE": ("grid", "the source {site} lies outside of the grid of {n_rows} x {n_cols} sites"),
    "GOAL_OUTSIDE": ("grid", "the goal {site} is neither on the grid nor within {slots} site(s) of its edge"),
    "DIAGONAL": ("straight", "{source} -> {goal} changes row and column; split it into two linked batches"),
    "NO_LENGTH": ("straight", "{source} -> {goal} goes nowhere; only in linked batches may an atom wait"),
    "TWO_AXES": ("straight", "atom move {a} follows a row, {b} a column, so their crossing goes diagonally"),
    "LINKED_FIRST": ("linked", "the first batch has none before it to be linked to"),
    "LINKED_AFTER_EJECTION": ("linked", "the batch before it ejects, and tweezers ramp down there"),
    "LINKED_NUMBER": ("linked", "it moves {a} atoms while {b} are held from the batch before"),
    "LINKED_ELSEWHERE": ("linked", "its source {site} is not a goal of the batch before"),
    "NO_ATOM": ("source", "there is no atom on {site}"),
    "SOURCE_TWICE": ("source", "another atom move of the batch starts from {site} too"),
    "GOAL_TAKEN": ("goal", "{source} -> {goal} ends on an atom that stays there"),
    "GOAL_TWICE": ("goal", "another atom move of the batch ends on {site} too"),
    "ROW_TONE_SPLIT": ("tones", "{source} -> {goal}, but the tone of row {a} goes to row {b}"),
    "COLUMN_TONE_SPLIT": ("tones", "{source} -> {goal}, but the tone of column {a} goes to column {b}"),
    "ROW_TONES": ("tones", "it needs {a} row tones; the limit is {b}"),
    "COLUMN_TONES": ("tones", "it needs {a} column tones; the limit is {b}"),
    "ROW_ORDER": ("order", "the tones of rows {a} and {b} meet or pass each other"),
    "COLUMN_ORDER": ("order", "the tones of columns {a} and {b} meet or pass each other"),
    "TWEEZERS": (
        "parallelism",
        "{a} row x {b} column tones make {n_tweezers} tweezers; the limit is {limit}",
    ),
    "CROSSING_ON_ATOM": ("crossing", "its tones cross on the atom on {site} too, which it does not name"),
    "PATH_OVER_ATOM": ("path", "its tones cross the atom that stands on {site} on their way or at its end"),
    "LINKED_AFTER_PATHS": (
        "linked",
        "it or the batch before has paths of tones; only line batches are linked",
    ),
    "PATH_SHAPE": ("tones", "its paths have fewer than two knots, or an axis has no tone"),
    "PATH_POSITION": ("tones", "a position of {axis} tone {b} is not finite"),
    "PATH_OFF": (
        "tones",
        "{axis} tones go off at knots from 1 to the last, one at the last; not so tone {b}",
    ),
    "PATH_OUTSIDE": ("grid", "{axis} tone {b} goes further than {slots} site(s) beyond the grid's edge"),
    "PATH_ORDER": (
        "order",
        "{axis} tone {b} comes closer than {least} sites to the one before, or passes it",
    ),
    "PATH_NO_TONE": ("tones", "no {axis} tone starts at {source}"),
    "PATH_END": (
        "tones",
        "{source} -> {goal}, but its {axis} tone is elsewhere at knot {b}, where it is let go",
    ),
    "PATH_PICKS_UP": (
        "crossing",
        "a tweezer that it does not name comes on at the atom on {site} or too near to it",
    ),
    "PATH_NEAR_ATOM": ("path", "a tweezer comes closer than {clearance} to the atom that stands on {site}"),
    "PATH_LANDS": (
        "path",
        "a tweezer without an atom ends on the atom on {site}, and empty_tweezers_may_land is off",
    ),
    "INNER_EJECTION": ("ejection", "an atom would be ejected over the one on {site}; eject that one first"),
}
"""Faults of :mod:`labseq.motion.check_kernels`: name -> rule, wording."""
_AT_A_SITE: Final = {"INNER_EJECTION", *(name for name, (_, text) in FAULTS.items() if "{site}" in text)}
"""The faults whose two numbers are a site."""


def check_plan(
    plan: Plan,
    occupancy: ArrayLike,
    target: TargetPattern,
    degree_of_parallelism: int,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    planner: str = "",
) -> PlanReport:
    """Check a plan against all :data:`RULES` and work out what it will do.

    Why comparing the ends is enough for ``order``: the tones of a batch start
    together and have the same speed v until each reaches its goal. The gap of two
    neighbours is constant while they move the same way and changes at 2v, v or
    not at all otherwise, always with the same sign: towards each other it only
    shrinks, apart it only grows, and after the first has arrived it goes on
    monotonically until the second has. Where both move the same way, the gap is
    constant until the first arrival and monotonic from then on. So the gap is
    monotonic from start to end and never below the smaller of the two, which are
    whole numbers of sites: it is at least one site if the order is kept. With a course
    of the speed other than constant, and on paths from one knot to the next, all tones have made
    the same fraction of their ways at any time, so the gap goes evenly from the one at the start
    to the one at the end.

    Args:
        plan: The plan.
        occupancy: bool (n_rows, n_cols), the occupancy that it was made for.
        target: What it is to end with; not meeting it breaks no rule.
        degree_of_parallelism: Most tweezers on at once that the planner was allowed.
        grid: The grid of sites; by default one of the occupancy's shape with the
            paper's spacing.
        motion: How the tweezers move; by default as in the paper.
        planner: Name of the planner, for the error message.

    Returns:
        Predicted occupancy, times and numbers of tweezers.

    Raises:
        InvalidPlanError: The plan breaks a rule; it says which, where and how. Or plan,
            target, grid or motion is something else.
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
        _raise_plan_error(fault, fault_place, plan, grid, max_tweezers, motion, planner)
    n_defects, n_surplus = count_wrong(atoms, target.fill, target.clear)
    for array in (atoms, end_s, n_tweezers):
        array.flags.writeable = False
    return PlanReport(atoms, end_s, n_tweezers, n_defects, n_surplus)


def _check_types(plan: Any, target: Any, dop: Any, grid: Any, motion: Any, planner: str) -> None:
    """Refuse arguments that a script may mix up, before they are used."""
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


def _raise_plan_error(
    fault: int,
    fault_place: list[int],
    plan: Plan,
    grid: SiteGrid,
    max_tweezers: int,
    motion: MotionSpec,
    planner: str,
) -> NoReturn:
    """Raise the error for a fault."""
    from labseq.motion import check_kernels, path_kernels

    batch, move, a, b = (int(number) for number in fault_place)
    name = next(name for name in FAULTS if (vars(path_kernels) | vars(check_kernels)).get(name) == fault)
    rule, wording = FAULTS[name]
    row = col = to_row = to_col = -1  # only used in messages about an atom move
    if move >= 0:
        row, col, to_row, to_col = plan.moves[plan.batch_offsets[batch] + move].tolist()
    detail = wording.format(
        source=(row, col),
        goal=(to_row, to_col),
        site=(a, b),
        a=a,
        b=b,
        n_tweezers=a * b,
        limit=max_tweezers,
        n_rows=grid.n_rows,
        n_cols=grid.n_cols,
        slots=motion.eject_slots,
        axis=AXES[a] if a in (0, 1) else "",
        least=f"{path_geometry(grid, motion)[2]:.3g}",
        clearance=format_quantity(motion.clearance_m, "length"),
    )
    site = (a, b) if name in _AT_A_SITE else None
    raise InvalidPlanError(rule, detail, batch=batch, move=move, planner=planner, site=site)
