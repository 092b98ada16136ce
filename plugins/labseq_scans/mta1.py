"""The planner ``mta1``; the algorithm itself is in the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from labseq.plugin import Context, Plan, TargetPattern
from labseq_scans._planning import LineSettings, as_plan, read_task
from labseq_scans.scans import ScannedPlan


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
        from labseq_scans._kernels_mta1 import plan_mta1

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
