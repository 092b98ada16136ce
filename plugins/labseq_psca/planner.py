"""The planner and its settings; the algorithm itself is in the kernels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from labseq import Context, Plan, PlanError, Settings, SiteGrid, TargetPattern, as_occupancy

Kernel = Callable[..., tuple[NDArray[np.int16], NDArray[np.int32]]]


class PscaSettings(Settings):
    """Settings of the planner ``psca``."""

    degree_of_parallelism: int = Field(
        default=7, ge=1, description="most mobile tweezers on at once; the profile's limits hold besides"
    )


class PscaPlanner:
    """Row sorting, then column compression, or the other way round where that takes fewer batches.

    Args:
        settings: The planner's settings.
        context: Its grid settles which sites are nearest to the target's centre,
            its motion how many tweezers and tones there may be and how far out
            atoms can be ejected.

    Attributes:
        degree_of_parallelism: Most atoms that a batch moves; the tone limits of
            the moving axis may lower it further.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> plan = PscaPlanner(PscaSettings(), Context()).plan([[True, False, True]], target)
        >>> plan.moves.tolist()
        [[0, 2, 0, 1]]
    """

    def __init__(self, settings: PscaSettings, context: Context) -> None:
        motion = context.motion
        self.degree_of_parallelism = min(settings.degree_of_parallelism, motion.max_tweezers)
        self._row_limit = min(self.degree_of_parallelism, motion.max_column_tones)
        self._column_limit = min(self.degree_of_parallelism, motion.max_row_tones)
        self._eject_slots = motion.eject_slots
        self._grid = context.grid
        self._kernel: Kernel | None = None

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        from labseq_psca._kernels import plan_best_way

        self._kernel = plan_best_way

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to the reservoir, or are ejected where there is no
        room in their line.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: What to end with, of the same shape.

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
        if self._kernel is None:
            self.warm()
        assert self._kernel is not None
        fill = target.fill
        n_atoms = int(np.count_nonzero(occupied))
        if n_atoms < target.n_atoms:
            fill = nearest_to_centre(fill, n_atoms, self._grid)
        moves, offsets = self._kernel(
            occupied, fill, target.clear, self._row_limit, self._column_limit, self._eject_slots
        )
        moves.flags.writeable = offsets.flags.writeable = False  # else Plan would copy them
        return Plan(moves, offsets)


def nearest_to_centre(fill: NDArray[np.bool_], n_sites: int, grid: SiteGrid) -> NDArray[np.bool_]:
    """Keep the fill sites that lie nearest to their common centre.

    Distances are those on the lattice; of sites equally far the one in the upper
    row, then in the left column, is kept.

    Args:
        fill: bool (n_rows, n_cols).
        n_sites: How many sites to keep.
        grid: Tells the lattice.

    Returns:
        bool (n_rows, n_cols) with ``n_sites`` sites.

    Example:
        >>> nearest_to_centre(np.ones((1, 5), np.bool_), 2, SiteGrid()).tolist()
        [[False, True, True, False, False]]
    """
    rows, cols = np.nonzero(fill)
    down = len(rows) * rows - rows.sum()  # from the centre, times the number of sites: exact in integers
    right = len(cols) * cols - cols.sum()
    shear = grid.shear if grid.lattice == "triangular" else 0
    distance = down**2 + right**2 + shear * down * right  # |right a1 + down a2|^2 / a^2
    kept = np.lexsort((cols, rows, distance))[:n_sites]
    nearest = np.zeros_like(fill)
    nearest[rows[kept], cols[kept]] = True
    return nearest
