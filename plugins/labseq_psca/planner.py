"""The planner and its settings; the algorithm itself is in the kernels."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq.plugin import Context, Occupancy, Plan, PlanError, Settings, SiteGrid, TargetPattern, as_occupancy
from labseq.plugin.geometry import nearest_to_centre
from labseq.plugin.planning import choose_plan

Kernel = Callable[..., tuple[NDArray[np.int16], NDArray[np.int32]]]
RowOrder = Literal["half_filled", "fullest", "emptiest"]


class ToneLimits(Settings):
    """Maximum number of simultaneous tones on each axis."""

    row: Annotated[int, Field(ge=1)] | None = Field(
        default=None,
        description="maximum number of row tones, and so of atoms that move along a column at once",
    )
    col: Annotated[int, Field(ge=1)] | None = Field(
        default=None,
        description="maximum number of column tones, and so of atoms that move along a row at once",
    )


class PscaSettings(Settings):
    """Settings of the planner ``psca``."""

    degree_of_parallelism: int = Field(
        default=7,
        ge=1,
        description="maximum number of mobile tweezers on at once; the profile's limits hold too",
    )
    max_tones: ToneLimits = Field(
        default=ToneLimits(),
        description="maximum number of tones on each axis, for cards with few tones",
    )
    variant: Literal["fewest", "paper"] = Field(
        default="fewest",
        description="fewest: few batches; paper: the paper's text taken literally, for comparison",
    )
    row_order: RowOrder = Field(
        default="half_filled",
        description="which row is sorted first: among equally useful ones, or among all with variant paper",
    )
    repair_below: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="fraction of defects up to which repair with few atom moves is considered too",
    )


class PscaPlanner:
    """Row sorting, then column compression, or the reverse if that takes fewer batches.

    Args:
        settings: The planner's settings.
        context: Its grid determines which sites are nearest to the target's centre;
            its motion limits tweezers and tones, and how far out atoms can be ejected.

    Attributes:
        degree_of_parallelism: Maximum number of atoms that a batch moves; the tone
            limits of the moving axis may lower it further.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> plan = PscaPlanner(PscaSettings(), Context()).plan([[True, False, True]], target)
        >>> plan.moves.tolist()
        [[0, 2, 0, 1]]
    """

    def __init__(self, settings: PscaSettings, context: Context) -> None:
        motion, tones = context.motion, settings.max_tones
        dop = self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._limits = (
            min(dop, motion.max_column_tones, tones.col or dop),  # along a row
            min(dop, motion.max_row_tones, tones.row or dop),  # along a column
        )
        self._settings = settings
        self._repair_below = settings.repair_below if settings.variant == "fewest" else 0.0
        self._eject_slots = motion.eject_slots
        # as in kernels_rows, which is not imported here: it takes numba
        self._order = {"half_filled": 0, "fullest": -1, "emptiest": 1}[settings.row_order]
        self._grid = context.grid
        self._motion = motion

    @cached_property
    def _kernel(self) -> Kernel:
        if self._settings.variant == "paper":
            from labseq_psca.kernels_paper import plan_as_in_paper as kernel
        else:
            from labseq_psca.kernels_fewest import plan_fewest as kernel
        return kernel

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        _ = self._kernel
        if self._repair_below > 0:
            importlib.import_module("labseq_psca.kernels_repair")

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to the reservoir, or are ejected if there is no
        room in their line.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The pattern to make, of the same shape.

        Returns:
            Batches of one line each, of at most ``degree_of_parallelism`` atoms.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "psca") from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(occupied)), self._grid)
        plan = _plan(*self._sort_and_compress(occupied, fill, target.clear))
        if self._repair_below > 0:
            n_defects = int(np.count_nonzero(fill > occupied))
            if 0 < n_defects <= self._repair_below * target.n_atoms:
                plans = (plan, self._repair(occupied, fill, target))
                grid, dop = self._grid, self.degree_of_parallelism
                if grid.shape != target.shape:  # a planner may be called for another array than the profile's
                    grid = SiteGrid(*target.shape, grid.spacing_m, lattice=grid.lattice, shear=grid.shear)
                return choose_plan(plans, occupied, target, dop, grid, self._motion)
        return plan

    def _sort_and_compress(
        self, occupied: Occupancy, fill: NDArray[np.bool_], clear: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int16], NDArray[np.int32]]:
        return self._kernel(occupied, fill, clear, *self._limits, self._eject_slots, self._order)

    def _repair(self, occupied: Occupancy, fill: NDArray[np.bool_], target: TargetPattern) -> Plan:
        """Fill each defect in the way that is expected to lose fewest atoms; then sort and compress."""
        from labseq_psca.kernels_repair import plan_repair

        motion, spacing_m = self._motion, self._grid.spacing_m
        losses = motion.losses
        per_second = target.n_atoms / losses.lifetime_s  # of all atoms, which wait while some move
        batch_s = motion.overhead_per_batch_s + motion.pick_up_s + motion.drop_off_s
        costs = (
            -math.log1p(-losses.move),
            per_second * batch_s,
            spacing_m * (per_second / motion.speed_m_s + losses.distance_per_m),
        )
        moves, offsets, linked, atoms = plan_repair(occupied, fill, target.clear, *self._limits, costs)
        more_moves, more_offsets = self._sort_and_compress(atoms, fill, target.clear)
        return _plan(
            np.concatenate([moves, more_moves]),
            np.concatenate([offsets, more_offsets[1:] + offsets[-1]]),
            np.concatenate([linked, np.zeros(len(more_offsets) - 1, np.bool_)]),
        )


def _plan(*arrays: NDArray[Any]) -> Plan:
    """A plan of arrays that nothing else holds."""
    for array in arrays:
        array.flags.writeable = False  # otherwise Plan would copy them
    return Plan(*arrays)
