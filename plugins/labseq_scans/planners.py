"""The planners `tetris` and `mta1`, and their settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq.plugin import (
    Context,
    MotionSpec,
    Plan,
    PlanError,
    Settings,
    SiteGrid,
    TargetPattern,
    as_occupancy,
    nearest_to_centre,
    site_time_s,
)

Bools = NDArray[np.bool_]


class LineSettings(Settings):
    """Settings of a planner that moves atoms of one line at a time."""

    degree_of_parallelism: int = Field(
        default=7,
        ge=1,
        description="maximum number of mobile tweezers on at once; the profile's limits apply too",
    )


def read_task(
    occupancy: ArrayLike, target: TargetPattern, grid: SiteGrid, planner: str
) -> tuple[Bools, Bools]:
    """Read an occupancy, and choose the fill sites that its atoms suffice for.

    Args:
        occupancy: bool (n_rows, n_cols), as detected.
        target: What to end with, of the same shape.
        grid: Tells the lattice, on which the distances from the target's centre are taken.
        planner: Name of the planner, for the error message.

    Returns:
        The occupancy, and the fill sites: with too few atoms those nearest to the
        target's centre, of sites equally far the upper ones, then the left ones.

    Raises:
        PlanError: The occupancy is not an array of zeros and ones in the target's shape.
    """
    try:
        occupied = as_occupancy(occupancy, target.shape)
    except (TypeError, ValueError) as error:
        raise PlanError(str(error), planner) from error
    return occupied, nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), grid)


def as_plan(log: NDArray[np.int32], n_moves: int, n_batches: int) -> Plan:
    """Make a plan from the log of the kernels.

    Args:
        log: int32 (>= n_moves, 5): batch, from row, from column, to row, to column.
        n_moves: Number of atom moves.
        n_batches: Number of batches.
    """
    moves = log[:n_moves, 1:].astype(np.int16)
    offsets = np.searchsorted(log[:n_moves, 0], np.arange(n_batches + 1)).astype(np.int32)
    moves.flags.writeable = offsets.flags.writeable = False  # else Plan would copy them
    return Plan(moves, offsets)


class TetrisSettings(LineSettings):
    """Settings of the planner ``tetris``."""


class TetrisPlanner:
    """Rows piled up one after the other from the top, then columns compressed, as Wang et al. do it.

    Args:
        settings: The planner's settings.
        context: Its grid settles which sites are nearest to the target's centre,
            its motion how many tweezers and tones there may be and how far out
            atoms can be ejected.

    Attributes:
        degree_of_parallelism: Most atoms that a batch moves; the tone limits of
            the moving axis may lower it further.

    Example:
        >>> target = TargetPattern(fill=[[False, False], [True, True]], clear=[[True, True], [False, False]])
        >>> plan = TetrisPlanner(TetrisSettings(), Context()).plan([[True, True], [False, False]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [0, 1, 1, 1]]
    """

    def __init__(self, settings: TetrisSettings, context: Context) -> None:
        motion = context.motion
        self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._row_limit = min(self.degree_of_parallelism, motion.max_column_tones)
        self._column_limit = min(self.degree_of_parallelism, motion.max_row_tones)
        self._eject_slots = motion.eject_slots
        self._grid = context.grid
        self._kernel: Callable[..., Any] | None = None

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_scans.kernels import plan_tetris

        self._kernel = plan_tetris

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to the reservoir of their column, or are ejected
        where there is no room.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: What to end with, of the same shape.

        Returns:
            Batches of one line each, of at most ``degree_of_parallelism`` atoms.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        occupied, fill = read_task(occupancy, target, self._grid, "tetris")
        if self._kernel is None:
            self.warm()
        assert self._kernel is not None
        log, n_moves, n_batches = self._kernel(
            occupied, fill, target.clear, self._row_limit, self._column_limit, self._eject_slots
        )
        return as_plan(log, n_moves, n_batches)


@dataclass(frozen=True, slots=True, eq=False)
class ScannedPlan:
    """A plan that was made of scans.

    In a scan, tweezers in a row (or column) move over the array and each picks up
    and drops atoms in passing. A plan has no such thing: its tweezers pick up
    together and drop together. So a scan becomes one batch for every pair of a line
    where atoms are picked up and a line where they are dropped.

    Attributes:
        plan: The batches, in the order of the scans.
        lines_passed: int64 (n_scans,), rows (or columns) that each scan passes,
            the first and the last included.
    """

    plan: Plan
    lines_passed: NDArray[np.int64]

    @property
    def n_scans(self) -> int:
        """Number of scans, which the source counts as moves."""
        return len(self.lines_passed)

    def duration_s(self, grid: SiteGrid, motion: MotionSpec) -> float:
        """Time that the scans themselves would take, hardware delays left out.

        A scan waits on every line that it passes for one ramp, whether or not an
        atom is picked up or dropped there, and moves by one site in between.

        Args:
            grid: Tells the spacing of the sites.
            motion: Tells the speed and the ramps, of which the longer one counts.

        Returns:
            Seconds.

        Raises:
            LimitError: The speed profile is none that exists.
        """
        n_stops = int(self.lines_passed.sum())
        wait_s = max(motion.pick_up_s, motion.drop_off_s)
        return n_stops * wait_s + (n_stops - self.n_scans) * site_time_s(grid, motion)


class Mta1Settings(LineSettings):
    """Settings of the planner ``mta1``."""


class Mta1Planner:
    """Pre-sorting between columns, then downward and upward scans, as Ebadi et al. do it.

    Args:
        settings: The planner's settings.
        context: Its grid settles which sites are nearest to the target's centre,
            its motion how many tweezers and tones there may be and whether atoms
            can be ejected.

    Attributes:
        degree_of_parallelism: Most tweezers on at once; the tone limits of the axis
            across a scan may lower it further.

    Example:
        >>> target = TargetPattern(fill=[[False, True], [True, False]], clear=[[False, False]] * 2)
        >>> plan = Mta1Planner(Mta1Settings(), Context()).plan([[True, False], [False, True]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [1, 1, 0, 1]]
    """

    def __init__(self, settings: Mta1Settings, context: Context) -> None:
        motion = context.motion
        self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._row_tones = min(self.degree_of_parallelism, motion.max_row_tones)
        self._column_tones = min(self.degree_of_parallelism, motion.max_column_tones)
        self._eject_slots = motion.eject_slots
        self._grid = context.grid
        self._kernel: Callable[..., Any] | None = None

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_scans.kernels import plan_mta1

        self._kernel = plan_mta1

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to the reservoir of their column, or are ejected
        below the last row where there is no room.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: What to end with, of the same shape.

        Returns:
            Batches of atoms that a scan picks up on one line and drops on one line.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        return self.scan(occupancy, target).plan

    def scan(self, occupancy: ArrayLike, target: TargetPattern) -> ScannedPlan:
        """Plan the same, and tell the scans that the plan is made of. Arguments as for :meth:`plan`."""
        occupied, fill = read_task(occupancy, target, self._grid, "mta1")
        if self._kernel is None:
            self.warm()
        assert self._kernel is not None
        log, n_moves, n_batches, passed, n_scans = self._kernel(
            occupied, fill, target.clear, self._row_tones, self._column_tones, self._eject_slots
        )
        return ScannedPlan(as_plan(log, n_moves, n_batches), passed[:n_scans].copy())
