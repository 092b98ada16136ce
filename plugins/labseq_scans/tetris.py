"""The planner ``tetris``; the algorithm itself is in the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from labseq.plugin import Context, Plan, TargetPattern
from labseq_scans._planning import LineSettings, as_plan, read_task


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
        from labseq_scans._kernels_tetris import plan_tetris

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
