"""The planners `tetris` and `mta1`, and their settings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

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

Growing = tuple[NDArray[np.int32], int, int]
"""Log of atom moves (batch, from row, from column, to row, to column); how many moves and batches."""


class LineSettings(Settings):
    """Settings of a planner that moves atoms of one line at a time."""

    degree_of_parallelism: int = Field(
        default=7,
        ge=1,
        description="maximum number of mobile tweezers on at once; the profile's limits apply too",
    )


class TetrisSettings(LineSettings):
    """Settings of the planner ``tetris``."""


class Mta1Settings(LineSettings):
    """Settings of the planner ``mta1``."""


class LinePlanner(ABC):
    """Base of the planners that scan lines.

    Args:
        settings: The planner's settings.
        context: Its grid determines which sites are nearest to the target's centre;
            its motion limits tweezers and tones, and the ejection of atoms.

    Attributes:
        name: What a sequence calls the planner.
        degree_of_parallelism: Maximum number of tweezers on at once; the tone limits
            of an axis may lower it further.
    """

    name: ClassVar[str]

    def __init__(self, settings: LineSettings, context: Context) -> None:
        motion = context.motion
        dop = self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._row_tones = min(dop, motion.max_row_tones)
        self._column_tones = min(dop, motion.max_column_tones)
        self._eject_slots = motion.eject_slots
        self._grid = context.grid
        self._kernel: Callable[..., Any] | None = None

    @abstractmethod
    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""

    @abstractmethod
    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to the reservoir of their column, or are ejected
        where there is no room.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The wanted pattern, of the same shape.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """

    def _run(self, occupancy: ArrayLike, target: TargetPattern, tones: tuple[int, int]) -> Any:
        """Run the kernel for an occupancy, with the fill sites that its atoms suffice for."""
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), self.name) from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), self._grid)
        if self._kernel is None:
            self.warm()
        assert self._kernel is not None
        return self._kernel(occupied, fill, target.clear, *tones, self._eject_slots)


def as_plan(grown: Growing) -> Plan:
    """Make a plan of what the kernels return."""
    log, n_moves, n_batches = grown
    moves = log[:n_moves, 1:].astype(np.int16)
    offsets = np.searchsorted(log[:n_moves, 0], np.arange(n_batches + 1)).astype(np.int32)
    moves.flags.writeable = offsets.flags.writeable = False  # otherwise Plan would copy them
    return Plan(moves, offsets)


class TetrisPlanner(LinePlanner):
    """Rows piled up one after the other from the top, then columns compressed, as Wang et al. do it.

    A batch moves atoms of one line.

    Example:
        >>> target = TargetPattern(fill=[[False, False], [True, True]], clear=[[True, True], [False, False]])
        >>> plan = TetrisPlanner(TetrisSettings(), Context()).plan([[True, True], [False, False]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [0, 1, 1, 1]]
    """

    name = "tetris"

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_scans.kernels_tetris import plan_tetris

        self._kernel = plan_tetris

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """See :meth:`LinePlanner.plan`."""
        return as_plan(self._run(occupancy, target, (self._column_tones, self._row_tones)))


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
            grid: For the spacing of the sites.
            motion: For the speed and the ramps, of which the longer one counts.

        Returns:
            Seconds.

        Raises:
            LimitError: The speed profile does not exist.
        """
        n_stops = int(self.lines_passed.sum())
        wait_s = max(motion.pick_up_s, motion.drop_off_s)
        return n_stops * wait_s + (n_stops - self.n_scans) * site_time_s(grid, motion)


class Mta1Planner(LinePlanner):
    """Pre-sorting between columns, then downward and upward scans, as Ebadi et al. do it.

    A batch is made of the atoms that a scan picks up on one line and drops on one line.
    Atoms are ejected below the last row only.

    Example:
        >>> target = TargetPattern(fill=[[False, True], [True, False]], clear=[[False, False]] * 2)
        >>> plan = Mta1Planner(Mta1Settings(), Context()).plan([[True, False], [False, True]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [1, 1, 0, 1]]
    """

    name = "mta1"

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_scans.kernels_mta1 import plan_mta1

        self._kernel = plan_mta1

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """See :meth:`LinePlanner.plan`."""
        return self.scan(occupancy, target).plan

    def scan(self, occupancy: ArrayLike, target: TargetPattern) -> ScannedPlan:
        """Make the same plan, and keep the scans that it is made of; arguments as for :meth:`plan`."""
        grown, (passed, n_scans) = self._run(occupancy, target, (self._row_tones, self._column_tones))
        return ScannedPlan(as_plan(grown), passed[:n_scans].copy())
