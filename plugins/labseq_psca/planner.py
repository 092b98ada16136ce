"""The planner and its settings. The algorithm is in the kernels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from labseq.plugin import Context, Occupancy, Plan, PlanError, Settings, TargetPattern, as_occupancy
from labseq.plugin.geometry import nearest_to_centre
from labseq.plugin.plan_kernels import FinishedPlan, as_plan
from labseq_psca.repair import Repair

Kernel = Callable[..., FinishedPlan]
RowOrder = Literal["half_filled", "fullest", "emptiest"]
"""In the order of their numbers in ``kernels_lines``, whose ``place_in_order`` defines each."""


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
        description="maximum number of mobile tweezers on at once; the profile's limits also apply",
    )
    max_tones: ToneLimits = Field(
        default=ToneLimits(),
        description="maximum number of tones on each axis, for cards with few tones",
    )
    variant: Literal["fewest", "paper"] = Field(
        default="fewest",
        description="'fewest' is a generalised PSCA with fewer batches; 'paper' takes the text of Tian et "
        "al. literally, to compare with that paper",
    )
    row_order: RowOrder = Field(
        default="half_filled",
        description="row to sort first, among equally useful rows with variant fewest, among all rows with "
        "variant paper",
    )
    repair_below: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="fraction of defects up to which repair with few atom moves is also considered; variant "
        "paper never repairs",
    )

    def algorithm_text(self) -> str:
        """The variant of PSCA in words."""
        if self.variant == "paper":
            return "PSCA as in the text of Tian et al."
        return "generalised PSCA, with fewer batches than variant: paper"


class PscaPlanner:
    """A generalised PSCA (parallel sort-and-compression) with fewer batches than the text of Tian et al.

    It sorts the rows that help most and then compresses columns, or the reverse if that takes fewer batches.
    With ``variant: paper`` it follows the text of that paper.

    Args:
        context: Its grid determines which sites are nearest to the target's centre. Its motion limits
            tweezers and tones, and how far out atoms can be ejected.

    Attributes:
        degree_of_parallelism: Maximum number of atoms that a batch moves. The tone limits of the moving axis
            may lower it further.

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
        self._eject_slots = motion.eject_slots
        self._order = get_args(RowOrder).index(settings.row_order)
        self._grid = context.grid
        self._repair: Repair | None = None
        if settings.variant == "fewest" and settings.repair_below > 0:
            self._repair = Repair(settings.repair_below, self._limits, dop, context)

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
        if self._repair is not None:
            self._repair.warm()

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
            atoms = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "psca") from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(atoms)), self._grid)

        def sort_and_compress(atoms: Occupancy) -> Plan:
            limits = *self._limits, self._eject_slots, self._order
            return as_plan(self._kernel(atoms, fill, target.clear, *limits))

        plan = sort_and_compress(atoms)
        return self._repair.improve(plan, atoms, fill, target, sort_and_compress) if self._repair else plan
