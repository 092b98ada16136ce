"""The planners `tetris` and `mta1`, and their settings."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq.plugin import (
    Context,
    MotionSpec,
    Occupancy,
    Plan,
    PlanError,
    Settings,
    SiteGrid,
    TargetPattern,
    as_occupancy,
)
from labseq.plugin.geometry import nearest_to_centre
from labseq.plugin.motion import site_time_s

Growing = tuple[NDArray[np.int32], int, int]
"""Log of atom moves (batch, from row, from column, to row, to column); how many moves and batches."""


class LineSettings(Settings):
    """Settings of ``tetris`` and ``mta1``."""

    degree_of_parallelism: int = Field(
        default=7,
        ge=1,
        description="maximum number of mobile tweezers on at once; the profile's limits apply too",
    )


class LinePlanner(ABC):
    """Base of the planners that scan lines: Tetris and MTA1 differ in their kernel, and what it returns.

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

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        importlib.import_module(f"labseq_scans.kernels_{self.name}")

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

    def _sites(self, occupancy: ArrayLike, target: TargetPattern) -> tuple[Occupancy, Occupancy, Occupancy]:
        """What the kernels take: the atoms, the fill sites that they suffice for, the sites to clear."""
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), self.name) from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), self._grid)
        return occupied, fill, target.clear


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
        >>> plan = TetrisPlanner(LineSettings(), Context()).plan([[True, True], [False, False]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [0, 1, 1, 1]]
    """

    name = "tetris"

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """See :meth:`LinePlanner.plan`."""
        from labseq_scans.kernels_tetris import plan_tetris

        sites = self._sites(occupancy, target)
        return as_plan(plan_tetris(*sites, self._column_tones, self._row_tones, self._eject_slots))


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
        >>> plan = Mta1Planner(LineSettings(), Context()).plan([[True, False], [False, True]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [1, 1, 0, 1]]
    """

    name = "mta1"

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """See :meth:`LinePlanner.plan`."""
        return self.scan(occupancy, target).plan

    def scan(self, occupancy: ArrayLike, target: TargetPattern) -> ScannedPlan:
        """Make the same plan, and keep the scans that it is made of; arguments as for :meth:`plan`."""
        from labseq_scans.kernels_mta1 import plan_mta1

        sites = self._sites(occupancy, target)
        grown, (passed, n_scans) = plan_mta1(*sites, self._row_tones, self._column_tones, self._eject_slots)
        return ScannedPlan(as_plan(grown), passed[:n_scans].copy())
