"""What the planners of this package have in common: the way from their input to the kernels and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq.plugin import Plan, PlanError, Settings, SiteGrid, TargetPattern, as_occupancy, nearest_to_centre

Bools = NDArray[np.bool_]


class LineSettings(Settings):
    """Settings of a planner that moves atoms of one line at a time."""

    degree_of_parallelism: int = Field(
        default=7, ge=1, description="most mobile tweezers on at once; the profile's limits hold besides"
    )


def read_task(
    occupancy: ArrayLike, target: TargetPattern, grid: SiteGrid, planner: str
) -> tuple[Bools, Bools]:
    """Read an occupancy, and choose what can be filled with so many atoms.

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
    """Make a plan of what the kernels have logged.

    Args:
        log: int32 (>= n_moves, 5): batch, from row, from column, to row, to column.
        n_moves: Number of atom moves.
        n_batches: Number of batches.
    """
    moves = log[:n_moves, 1:].astype(np.int16)
    offsets = np.searchsorted(log[:n_moves, 0], np.arange(n_batches + 1)).astype(np.int32)
    moves.flags.writeable = offsets.flags.writeable = False  # else Plan would copy them
    return Plan(moves, offsets)
