"""The planner and its settings. The algorithm is in the kernels."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
from labseq_psca.planner import PscaPlanner, PscaSettings
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq.plugin import (
    Context,
    LimitError,
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
from labseq.plugin.plan_kernels import as_plan
from labseq.plugin.planning import pass_hazard


class GridSettings(Settings):
    """Settings of the planner ``grid``."""

    degree_of_parallelism: int = Field(
        default=15,
        ge=1,
        description="maximum number of mobile tweezers on at once, including empty ones; the "
        "profile's limits also apply",
    )
    lanes: Literal["straight", "weaving"] = Field(
        default="weaving",
        description="'weaving' goes around the atoms of a triangular lattice and loses fewer; 'straight' has "
        "tone programs with fewer segments, as on a square lattice",
    )
    without_lanes: Literal["refuse", "psca"] = Field(
        default="refuse",
        description="behaviour if the profile's clearance, band or tones leave no lane between the sites; "
        "'refuse' is an error, 'psca' makes batches of single lines with the planner psca",
    )


OUTERMOST: Final = 0.61
"""How far beyond the last line of sites a tone in a lane goes, in lines (half a line and the swing)."""


def lane_m(grid: SiteGrid) -> float:
    """Distance of a straight lane from the sites on both sides, in metres."""
    a1, a2 = grid.axes
    return abs(float(a1[0] * a2[1] - a1[1] * a2[0])) / grid.spacing_m / 2


def check_lanes(grid: SiteGrid, motion: MotionSpec) -> None:
    """Raise a LimitError if there is no lane in which tweezers can pass the atoms."""
    if lane_m(grid) < motion.clearance_m:
        clearance, lane = (f"{length_m * 1e6:.4g} um" for length_m in (motion.clearance_m, lane_m(grid)))
        raise LimitError(
            "the clearance of moving tweezers",
            clearance,
            f"at most {lane}, half-way between two lines of sites",
            f"lower mobile_tweezers.clearance in the profile, or {OTHERWISE}",
        )
    if motion.eject_slots == 0 and min(grid.shape) == 1:
        raise LimitError(
            "the number of ejection slots",
            0,
            "at least 1, because a grid with a single line needs a lane",
            f"raise mobile_tweezers.eject_slots in the profile, or {OTHERWISE}",
        )
    axes = (("row", grid.row_frequency_hz), ("column", grid.column_frequency_hz))
    for (axis, hz), band in zip(axes, (motion.rf.row_band_hz, motion.rf.column_band_hz), strict=True):
        if len(hz) > 1:
            _check_tones(axis, np.sort(hz), band, motion)


OTHERWISE: Final = "choose a planner of line batches such as psca, or set `without_lanes: psca`"


def _check_tones(axis: str, hz: NDArray[np.float64], band: tuple[float, float], motion: MotionSpec) -> None:
    """Raise a LimitError if tones in lanes are too near to tones on lines, or out of the band."""
    half_hz = float(np.diff(hz).min()) / 2
    if not motion.empty_tweezers_may_land and half_hz < motion.rf.min_spacing_hz * (1 - 1e-9):
        raise LimitError(
            f"the distance of a {axis} tone in a lane from a tone on the next line",
            f"{half_hz / 1e6:.6g} MHz",
            f"{motion.rf.min_spacing_hz / 1e6:.6g} MHz at least",
            f"lower mobile_tweezers.rf.min_spacing in the profile, or {OTHERWISE}",
        )
    ends = hz[0] - OUTERMOST * (hz[1] - hz[0]), hz[-1] + OUTERMOST * (hz[-1] - hz[-2])
    if motion.eject_slots > 0 and not (band[0] <= ends[0] and ends[1] <= band[1]):
        outside = ends[0] if ends[0] < band[0] else ends[1]
        raise LimitError(
            f"the frequency of a {axis} tone in the outermost lane",
            f"{outside / 1e6:.6g} MHz",
            f"the band of {band[0] / 1e6:.6g} to {band[1] / 1e6:.6g} MHz",
            f"set mobile_tweezers.eject_slots to 0 in the profile to avoid outer lanes, or {OTHERWISE}",
        )


WEAVE: Final = 0.11
"""Swing of a lane of the triangular lattice, in lines, so that tweezers keep about 2.2 um from atoms."""


def lane_weave(grid: SiteGrid, motion: MotionSpec) -> float:
    """How far lanes swing. 0 on a square lattice, and if each leg starts and ends at rest."""
    if motion.speed_profile != "constant":
        return 0.0
    a1, a2 = grid.axes / grid.spacing_m
    return 2.0 * WEAVE * float(a1 @ a2)


# Chosen from plans for square lattices of 20 x 20 to 100 x 100 sites, see docs/explanation/grid-planner.md.
TIME: Final = 8.0
"""Weight of the atoms lost while a batch lasts, because short plans are worth more than these."""
WOVEN: Final = 0.49
"""How near tweezers in a weaving lane come to atoms, in spacings. The middles of the edges are at 0.5."""


def batch_costs(
    occupied: Occupancy, has_unwanted: bool, grid: SiteGrid, motion: MotionSpec, weave: float
) -> tuple[float, float, float, float, float]:
    """Expected losses that a batch causes, as :data:`labseq_grid.kernels_columns.Costs`, in atoms.

    Args:
        occupied: bool (n_rows, n_cols).
        has_unwanted: True if there are atoms on sites that must be empty.
        motion: Its ramps, speed and losses.
        weave: How far lanes swing, from :func:`lane_weave`.
    """
    losses, n_atoms = motion.losses, int(np.count_nonzero(occupied))
    hazard = pass_hazard(motion, lane_m(grid) if weave == 0 else WOVEN * grid.spacing_m)
    per_s = TIME * n_atoms / losses.lifetime_s
    site_s = grid.spacing_m / motion.speed_m_s
    ramps_s = motion.overhead_per_batch_s + motion.pick_up_s + motion.drop_off_s
    return (
        per_s * (ramps_s + math.sqrt(2) * site_s),  # from sites to lanes and back
        per_s * site_s,
        0.0 if motion.empty_tweezers_may_land else per_s * (motion.drop_off_s + site_s),
        2.0 * hazard * n_atoms / occupied.size,  # a lane has sites on both sides
        losses.move if has_unwanted else 0.0,
    )


class GridPlanner:
    """Moves rows x columns of reservoir atoms directly to vacancies, through lanes between the sites.

    Args:
        context: Its grid determines the lanes and which sites are nearest to the target's centre. Its motion
            limits tweezers and tones, and how far out atoms can be ejected.

    Attributes:
        degree_of_parallelism: Maximum number of tweezers on at once.

    Raises:
        LimitError: There is no lane in which tweezers keep the clearance and whose tones can be played, and
            the settings do not allow line batches instead.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> plan = GridPlanner(GridSettings(), Context()).plan([[True, False, True]], target)
        >>> plan.moves.tolist()
        [[0, 2, 0, 1]]
    """

    def __init__(self, settings: GridSettings, context: Context) -> None:
        motion = context.motion
        dop = self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._in_lines: PscaPlanner | None = None
        try:
            check_lanes(context.grid, motion)
        except LimitError:
            if settings.without_lanes == "refuse":
                raise
            self._in_lines = PscaPlanner(PscaSettings(degree_of_parallelism=dop), context)
        self._grid = context.grid
        limits = dop, motion.max_row_tones, motion.max_column_tones
        weave = lane_weave(context.grid, motion) if settings.lanes == "weaving" else 0.0
        self._machine = limits, motion.eject_slots, motion.empty_tweezers_may_land, weave
        self._motion, self._weave = motion, weave

    @cached_property
    def _kernel(self) -> Callable[..., Any]:
        from labseq_grid.kernels_plan import plan_grid

        return plan_grid

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        if self._in_lines is not None:
            self._in_lines.warm()
        else:
            _ = self._kernel

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
        if self._in_lines is not None:
            return self._in_lines.plan(occupancy, target)
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "grid") from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), self._grid)
        has_unwanted = bool((occupied & target.clear).any())
        costs = batch_costs(occupied, has_unwanted, self._grid, self._motion, self._weave)
        return as_plan(self._kernel(occupied, fill, target.fill, target.clear, (*self._machine, costs)))
