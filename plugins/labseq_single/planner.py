"""The planners; the algorithms themselves are in the kernels."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from typing import ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.plugin import Context, Plan, PlanError, TargetPattern, as_occupancy
from labseq.plugin.geometry import from_the_centre

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Moves = tuple[NDArray[np.int16], Bools, int]
"""Batches of one atom move, int16 (>= n, 4), whether each is linked, and their number n."""


class SingleTweezerPlanner(ABC):
    """Base of the planners with one mobile tweezer; they differ in which atom goes to which fill site.

    Args:
        settings: None; there is nothing to set.
        context: Its grid determines which sites are nearest to the target's centre,
            its motion whether atoms can be ejected.

    Attributes:
        name: What a sequence calls the planner.
        degree_of_parallelism: 1.
    """

    name: ClassVar[str]
    degree_of_parallelism: Final = 1

    def __init__(self, settings: None, context: Context) -> None:
        del settings  # the signature of every factory
        self._may_eject = context.motion.eject_slots > 0
        self._grid = context.grid

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        importlib.import_module("labseq_single.kernels")

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are
        filled. Surplus atoms go to free reservoir sites, or are ejected where none
        can be reached by as few moves.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The wanted pattern, of the same shape.

        Returns:
            Batches of one atom each; those after a turn are linked to the one before.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), self.name) from error
        order = from_the_centre(target.fill, self._grid)[: np.count_nonzero(occupied)]
        fill = np.zeros_like(target.fill)
        fill.reshape(-1)[order] = True
        moves, linked, n = self._moves(occupied, fill, target.clear, order)
        return Plan(moves[:n], np.arange(n + 1, dtype=np.int32), linked[:n])

    @abstractmethod
    def _moves(self, occupied: Bools, fill: Bools, clear: Bools, order: Ints) -> Moves:
        """Run the kernel; ``order`` lists the fill sites, row * n_cols + col, the innermost first."""


class LsapPlanner(SingleTweezerPlanner):
    """Linear sum assignment: the total travel distance from atoms to fill sites is least.

    Attributes:
        power: Power of the distance that is summed.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> LsapPlanner(None, Context()).plan([[True, False, True]], target).moves.tolist()
        [[0, 2, 0, 1]]
    """

    name = "lsap"
    power: ClassVar[int] = 1

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache, and import scipy."""
        super().warm()
        importlib.import_module("scipy.optimize")

    def _moves(self, occupied: Bools, fill: Bools, clear: Bools, order: Ints) -> Moves:
        from scipy.optimize import linear_sum_assignment

        from labseq_single.kernels import plan_assignment

        sources = np.flatnonzero(occupied)
        stays = ~clear.reshape(-1)[sources]  # of equal sums, the one that leaves fewest atoms to clear
        cost = travel(order, sources, fill.shape[1]) ** self.power * (len(order) + 1) + stays
        _, chosen = linear_sum_assignment(cost)
        return plan_assignment(occupied, fill, clear, sources[chosen], order, self._may_eject)


class LsapSquaredPlanner(LsapPlanner):
    """The modified linear sum assignment: the sum of the squares of the travel distances is least."""

    name = "lsap_squared"
    power = 2


class CompressionPlanner(SingleTweezerPlanner):
    """The compression algorithm: layer by layer from the centre, each site from the nearest atom outside."""

    name = "compression"

    def _moves(self, occupied: Bools, fill: Bools, clear: Bools, order: Ints) -> Moves:
        from labseq_single.kernels import plan_compression

        del order
        return plan_compression(occupied, fill, clear, layers(fill), self._may_eject)


class HcaPlanner(SingleTweezerPlanner):
    """The heuristic cluster algorithm: closed regions of defects are opened, open ones are filled."""

    name = "hca"

    def _moves(self, occupied: Bools, fill: Bools, clear: Bools, order: Ints) -> Moves:
        from labseq_single.kernels import plan_clusters

        del order
        return plan_clusters(occupied, fill, clear, self._may_eject)


def travel(goals: Ints, sources: Ints, n_cols: int) -> Ints:
    """Distances along rows and columns, in sites.

    Args:
        goals: int64 (n_goals,), sites as row * n_cols + col.
        sources: int64 (n_sources,), likewise.
        n_cols: Columns of the grid.

    Returns:
        int64 (n_goals, n_sources).

    Example:
        >>> travel(np.array([0]), np.array([0, 2, 5]), 3).tolist()
        [[0, 2, 3]]
    """
    rows, cols = np.divmod(goals, n_cols)
    from_rows, from_cols = np.divmod(sources, n_cols)
    return np.abs(rows[:, None] - from_rows) + np.abs(cols[:, None] - from_cols)


def layers(fill: Bools) -> Ints:
    """List the fill sites in layers around their common centre, and of each layer the corners first.

    A layer is what a square around the centre adds to the next smaller one.

    Args:
        fill: bool (n_rows, n_cols).

    Returns:
        int64 (n_fill,), row * n_cols + col of each.

    Example:
        >>> layers(np.ones((3, 3), np.bool_)).tolist()
        [4, 0, 2, 6, 8, 1, 3, 5, 7]
    """
    rows, cols = np.nonzero(fill)
    down = np.abs(len(rows) * rows - rows.sum())  # from the centre, times the number of sites
    right = np.abs(len(cols) * cols - cols.sum())
    return (rows * fill.shape[1] + cols)[np.lexsort((cols, rows, -down - right, np.maximum(down, right)))]
