"""The planners and their settings. The algorithms are in the kernels."""

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
from labseq.plugin.geometry import from_the_centre, nearest_to_centre
from labseq.plugin.motion import site_time_s
from labseq.plugin.plan_kernels import FinishedPlan, as_plan

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Sites:
    """The task of a planner.

    Attributes:
        atoms: bool (n_rows, n_cols), as detected.
        fill: The same shape, the fill sites for which there are enough atoms.
        clear: The same shape, the sites that must be empty.
        wanted: The same shape, the fill sites of the whole target.
    """

    atoms: Occupancy
    fill: Bools
    clear: Bools
    wanted: Bools


class RivalPlanner(ABC):
    """Base of all planners here.

    Args:
        context: Its grid determines which sites are nearest to the target's centre. Its motion limits
            tweezers and tones, and the ejection of atoms.

    Attributes:
        name: Name of the planner in a sequence.
        kernels: Its module of kernels.
        degree_of_parallelism: Maximum number of tweezers on at once. The tone limits of an axis may lower it
            further.
    """

    name: ClassVar[str]
    kernels: ClassVar[str]

    def __init__(self, settings: LineSettings | None, context: Context) -> None:
        motion = context.motion
        dop = 1 if settings is None else min(settings.degree_of_parallelism, motion.max_tweezers)
        self.degree_of_parallelism = dop
        self._row_tones = min(dop, motion.max_row_tones)
        self._column_tones = min(dop, motion.max_column_tones)
        self._eject_slots = motion.eject_slots
        self._grid = context.grid

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        importlib.import_module(f"labseq_rivals.{self.kernels}")

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target and clear what must be empty.

        With too few atoms, the fill sites nearest to the target's centre are filled.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The wanted pattern, of the same shape.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        return as_plan(self.finished_plan(self.sites(occupancy, target)))

    @abstractmethod
    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """Run the kernel."""

    def sites(self, occupancy: ArrayLike, target: TargetPattern) -> Sites:
        """The atoms and the wanted sites, with arguments and errors as for :meth:`plan`."""
        try:
            atoms = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), self.name) from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(atoms)), self._grid)
        return Sites(atoms, fill, target.clear, target.fill)


class LineSettings(Settings):
    """Settings of ``tetris`` and ``mta1``."""

    degree_of_parallelism: int = Field(
        default=7,
        ge=1,
        description="maximum number of mobile tweezers on at once; the profile's limits apply too",
    )


@dataclass(frozen=True, slots=True, eq=False)
class ScannedPlan:
    """A plan made from scans.

    In a scan, tweezers in a row (or column) move over the array and each picks up and drops atoms in passing.
    The tweezers of a plan pick up together and drop together. So a scan becomes one batch for every pair of a
    line where atoms are picked up and a line where they are dropped.

    Attributes:
        plan: The batches, in the order of the scans.
        lines_passed: int64 (n_scans,), rows (or columns) that each scan passes, including the first and the
            last.
    """

    plan: Plan
    lines_passed: NDArray[np.int64]

    @property
    def n_scans(self) -> int:
        """Number of scans, which the source counts as moves."""
        return len(self.lines_passed)

    def duration_s(self, grid: SiteGrid, motion: MotionSpec) -> float:
        """Time that the scans themselves would take, without hardware delays.

        A scan waits for one ramp on every line that it passes, with or without an atom to pick up or drop,
        and moves by one site in between.

        Args:
            grid: For the spacing of the sites.
            motion: For the speed and the longer of the ramps.

        Returns:
            Seconds.
        """
        n_stops = int(self.lines_passed.sum())
        wait_s = max(motion.pick_up_s, motion.drop_off_s)
        return n_stops * wait_s + (n_stops - self.n_scans) * site_time_s(grid, motion)


class Mta1Planner(RivalPlanner):
    """Pre-sorting between columns, then downward and upward scans, as in Ebadi et al.

    A batch consists of the atoms that a scan picks up on one line and drops on one line. Surplus atoms go to
    the reservoir of their column, or are ejected below the last row.

    Example:
        >>> target = TargetPattern(fill=[[False, True], [True, False]], clear=[[False, False]] * 2)
        >>> plan = Mta1Planner(LineSettings(), Context()).plan([[True, False], [False, True]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [1, 1, 0, 1]]
    """

    name = "mta1"
    kernels = "kernels_mta1"

    def scan(self, occupancy: ArrayLike, target: TargetPattern) -> ScannedPlan:
        """Make the same plan, and keep its scans, with arguments as for :meth:`plan`."""
        arrays, lines_passed = self._scans(self.sites(occupancy, target))
        return ScannedPlan(as_plan(arrays), lines_passed)

    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """See :meth:`RivalPlanner.finished_plan`."""
        return self._scans(sites)[0]

    def _scans(self, sites: Sites) -> tuple[FinishedPlan, Ints]:
        from labseq_rivals.kernels_mta1 import plan_mta1

        tones = self._row_tones, self._column_tones
        return plan_mta1(sites.atoms, sites.fill, sites.clear, *tones, self._eject_slots)


class TetrisPlanner(RivalPlanner):
    """Rows piled up one after the other from the top, then columns compressed, as in Wang et al.

    A batch moves atoms of one line. Surplus atoms go to the reservoir of their column, or are ejected.

    Example:
        >>> target = TargetPattern(fill=[[False, False], [True, True]], clear=[[True, True], [False, False]])
        >>> plan = TetrisPlanner(LineSettings(), Context()).plan([[True, True], [False, False]], target)
        >>> plan.moves.tolist()
        [[0, 0, 1, 0], [0, 1, 1, 1]]
    """

    name = "tetris"
    kernels = "kernels_tetris"

    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """See :meth:`RivalPlanner.finished_plan`."""
        from labseq_rivals.kernels_tetris import plan_tetris

        tones = self._column_tones, self._row_tones
        return plan_tetris(sites.atoms, sites.fill, sites.clear, *tones, self._eject_slots)


class LsapPlanner(RivalPlanner):
    """Linear sum assignment, which minimises the total travel distance from atoms to fill sites.

    Attributes:
        power: Power of the distance in the sum.

    Example:
        >>> target = TargetPattern(fill=[[True, True, False]], clear=[[False, False, False]])
        >>> LsapPlanner(None, Context()).plan([[True, False, True]], target).moves.tolist()
        [[0, 2, 0, 1]]
    """

    name = "lsap"
    kernels = "kernels_lsap"
    power: ClassVar[int] = 1

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache, and import scipy."""
        super().warm()
        importlib.import_module("scipy.optimize")

    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """See :meth:`RivalPlanner.finished_plan`."""
        from scipy.optimize import linear_sum_assignment

        from labseq_rivals.kernels_lsap import plan_assignment

        sources = np.flatnonzero(sites.atoms)
        order = from_the_centre(sites.wanted, self._grid)[: len(sources)]
        stays = ~sites.clear.reshape(-1)[sources]  # among equal sums, leave the fewest atoms to clear
        cost = travel(order, sources, sites.fill.shape[1]) ** self.power * (len(order) + 1) + stays
        _, assigned = linear_sum_assignment(cost)
        masks = sites.atoms, sites.fill, sites.clear
        return plan_assignment(*masks, sources[assigned], order, self._eject_slots > 0)


class LsapSquaredPlanner(LsapPlanner):
    """The modified linear sum assignment, which minimises the sum of the squared travel distances."""

    name = "lsap_squared"
    power = 2


class CompressionPlanner(RivalPlanner):
    """The compression algorithm, which fills layers from the centre from the nearest atoms outside."""

    name = "compression"
    kernels = "kernels_compression"

    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """See :meth:`RivalPlanner.finished_plan`."""
        from labseq_rivals.kernels_compression import plan_compression

        masks = sites.atoms, sites.fill, sites.clear
        return plan_compression(*masks, layers(sites.fill), self._eject_slots > 0)


class HcaPlanner(RivalPlanner):
    """The heuristic cluster algorithm, which opens closed regions of defects and fills open regions."""

    name = "hca"
    kernels = "kernels_hca"

    def finished_plan(self, sites: Sites) -> FinishedPlan:
        """See :meth:`RivalPlanner.finished_plan`."""
        from labseq_rivals.kernels_hca import plan_clusters

        return plan_clusters(sites.atoms, sites.fill, sites.clear, self._eject_slots > 0)


def travel(goals: Ints, sources: Ints, n_cols: int) -> Ints:
    """Distances along rows and columns, in sites.

    Args:
        goals: int64 (n_goals,), sites as row * n_cols + col.
        sources: int64 (n_sources,), sites as row * n_cols + col.
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
    """List the fill sites in layers around their common centre, the corners of each layer first.

    A layer is what a square around the centre adds to the next smaller square.

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
