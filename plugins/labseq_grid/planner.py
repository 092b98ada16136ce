"""The planner and its settings; the algorithm itself is in the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from labseq.plugin import (
    Context,
    LimitError,
    MotionSpec,
    Plan,
    PlanError,
    Settings,
    SiteGrid,
    TargetPattern,
    as_occupancy,
    nearest_to_centre,
)


class GridSettings(Settings):
    """Settings of the planner ``grid``."""

    degree_of_parallelism: int = Field(
        default=15,
        ge=1,
        description="maximum number of mobile tweezers on at once, those without an atom included; the "
        "profile's limits hold too",
    )


def check_lanes(grid: SiteGrid, motion: MotionSpec) -> None:
    """Raise a LimitError if there is no lane in which tweezers can pass the atoms."""
    a1, a2 = grid.axes
    area = abs(float(a1[0] * a2[1] - a1[1] * a2[0]))
    lane_m = area / grid.spacing_m / 2
    other = "planners of line batches such as psca need no lanes"
    if lane_m < motion.clearance_m:
        clearance, lane = (f"{length_m * 1e6:.4g} um" for length_m in (motion.clearance_m, lane_m))
        raise LimitError(
            "the clearance of moving tweezers",
            clearance,
            f"at most {lane}, half-way between two lines; {other}",
        )
    if motion.eject_slots == 0 and min(grid.shape) == 1:
        raise LimitError(
            "the number of ejection slots",
            0,
            f"at least 1 where the grid has a single line, for a lane; {other}",
        )


WEAVE: Final = 0.11
"""How far a lane of the triangular lattice swings, in lines: tweezers so keep about 2.2 um from atoms."""


def lane_weave(grid: SiteGrid, motion: MotionSpec) -> float:
    """How far lanes swing: 0 on a square lattice, and where each leg starts and ends at rest."""
    if motion.speed_profile != "constant":
        return 0.0
    a1, a2 = grid.axes / grid.spacing_m
    return 2.0 * WEAVE * float(a1 @ a2)


class GridPlanner:
    """Rows x columns of reservoir atoms go straight to vacancies, through lanes between the sites.

    Args:
        settings: The planner's settings.
        context: Its grid determines the lanes and which sites are nearest to the target's
            centre; its motion limits tweezers and tones, and how far out atoms can be ejected.

    Attributes:
        degree_of_parallelism: Maximum number of tweezers on at once.

    Raises:
        LimitError: There is no lane in which tweezers keep the clearance.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> plan = GridPlanner(GridSettings(), Context()).plan([[True, False, True]], target)
        >>> plan.moves.tolist()
        [[0, 2, 0, 1]]
    """

    def __init__(self, settings: GridSettings, context: Context) -> None:
        motion = context.motion
        dop = self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        check_lanes(context.grid, motion)
        self._limits = dop, motion.max_row_tones, motion.max_column_tones
        self._slots = motion.eject_slots
        self._may_land = motion.empty_tweezers_may_land
        self._grid = context.grid
        self._weave = lane_weave(context.grid, motion)
        self._kernel: Callable[..., Any] | None = None

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_grid.kernels_plan import plan_grid

        self._kernel = plan_grid

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Unwanted atoms fill vacancies, go to the reservoir, or are ejected if there is no room.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The wanted pattern, of the same shape.

        Returns:
            Batches with paths of tones, of at most ``degree_of_parallelism`` crossings.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "grid") from error
        if self._kernel is None:
            self.warm()
        assert self._kernel is not None
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), self._grid)
        arrays = self._kernel(
            occupied, fill, target.fill, target.clear, self._limits, self._slots, self._may_land, self._weave
        )
        for array in arrays:
            array.flags.writeable = False  # otherwise Plan would copy them
        moves, offsets, *paths = arrays
        return Plan(moves, offsets, np.zeros(len(offsets) - 1, np.bool_), *paths)
