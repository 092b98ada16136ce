"""Repairs few defects with few atom moves, after any planner. The algorithm is in ``kernels_repair``."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError

from labseq.plugin import (
    ConfigError,
    Context,
    Occupancy,
    Plan,
    PlanError,
    Planner,
    Registry,
    Settings,
    SiteGrid,
    TargetPattern,
    as_occupancy,
)
from labseq.plugin.geometry import nearest_to_centre
from labseq.plugin.plan_kernels import as_plan
from labseq.plugin.planning import choose_plan


class RepairSettings(Settings):
    """Settings of the planner ``repair``."""

    after: dict[str, Any] = Field(
        default={"use": "psca"},
        description="planner and its settings, for arrays with more defects and for the rest after a repair",
    )
    below: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="fraction of defects up to which repair with few atom moves is considered",
    )


class Repair:
    """Makes a second plan if defects are few, and chooses between the two.

    Args:
        below: Fraction of defects up to which a repair is considered.
        limits: Maximum number of atoms in a batch that moves along a row, and along a column.
        degree_of_parallelism: Maximum number of mobile tweezers on at once, for both plans.
        context: Its grid and its motion, whose losses are the costs.
    """

    def __init__(
        self, below: float, limits: tuple[int, int], degree_of_parallelism: int, context: Context
    ) -> None:
        self._below = below
        self._limits = limits
        self._dop = degree_of_parallelism
        self._grid = context.grid
        self._motion = context.motion

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        importlib.import_module("labseq_psca.kernels_repair")

    def improve(
        self,
        plan: Plan,
        atoms: Occupancy,
        fill: NDArray[np.bool_],
        target: TargetPattern,
        plan_rest: Callable[[Occupancy], Plan],
    ) -> Plan:
        """Return the given plan or a repair, whichever is more likely to leave the target complete.

        Args:
            plan: Another planner's plan.
            atoms: bool (n_rows, n_cols), as detected.
            fill: The same shape, the fill sites of the target for which there are enough atoms.
            target: The pattern to make, of the same shape.
            plan_rest: Called with the occupancy after the repair, to plan for the remaining defects.
        """
        n_defects = int(np.count_nonzero(fill > atoms))
        if not 0 < n_defects <= self._below * target.n_atoms:
            return plan
        from labseq_psca.kernels_repair import plan_repair

        costs = self._costs(target.n_atoms)
        arrays, after = plan_repair(atoms, fill, target.clear, *self._limits, costs)
        repair = joined(as_plan(arrays), plan_rest(after))
        grid = self._grid
        if grid.shape != target.shape:  # the array of a call may not be the profile's
            grid = SiteGrid(*target.shape, grid.spacing_m, lattice=grid.lattice, shear=grid.shear)
        return choose_plan((plan, repair), atoms, target, self._dop, grid, self._motion)

    def _costs(self, n_atoms: int) -> tuple[float, float, float]:
        """Atoms lost by moving an atom, by the time of a batch, and by the time of one site of way."""
        motion = self._motion
        losses = motion.losses
        per_second = n_atoms / losses.lifetime_s  # of all atoms, because they wait while some move
        batch_s = motion.overhead_per_batch_s + motion.pick_up_s + motion.drop_off_s
        way = self._grid.spacing_m * (per_second / motion.speed_m_s + losses.distance_per_m)
        return -math.log1p(-losses.move), per_second * batch_s, way


def joined(first: Plan, then: Plan) -> Plan:
    """Join two plans. The first has only line batches.

    Example:
        >>> plan = Plan.from_batches([([(0, 0)], [(0, 3)])])
        >>> joined(plan, plan).batch_offsets.tolist()
        [0, 1, 2]
    """
    shapes = then.path_shapes
    if len(shapes):
        shapes = np.concatenate([np.zeros((first.n_batches, 3), np.int32), shapes])
    moves = np.concatenate([first.moves, then.moves])
    offsets = np.concatenate([first.batch_offsets, then.batch_offsets[1:] + first.batch_offsets[-1]])
    linked = np.concatenate([first.linked, then.linked])
    return as_plan((moves, offsets, linked, shapes, then.path_positions, then.path_off))


def construct_other(registry: Registry, choice: Mapping[str, Any], context: Context) -> Planner:
    """Construct the planner that ``after`` names.

    Raises:
        ConfigError: There is no such planner, or its settings are wrong.
    """
    settings = dict(choice)
    name, known = settings.pop("use", None), [name for name in registry.names("planner") if name != "repair"]
    if name not in known:
        raise ConfigError(f"after.use is {name!r}; expected one of {', '.join(known)}")
    entry = registry.get("planner", name)
    model: Any = entry.settings_model or Settings
    try:
        validated = model.model_validate(settings)
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, ("after", *problem["loc"])))
        known_keys = ", ".join(model.model_fields)
        raise ConfigError(f"{key}: {problem['msg']}; the settings of '{name}' are {known_keys}") from error
    return entry.factory(validated if entry.settings_model else None, context)


class RepairPlanner:
    """Uses another planner, but fills few defects with few atom moves if that loses fewer atoms.

    Args:
        context: Its motion limits tweezers and tones. Its losses decide between the plans.
        planner: The other planner.

    Attributes:
        degree_of_parallelism: That of the other planner.
    """

    def __init__(self, settings: RepairSettings, context: Context, planner: Planner) -> None:
        motion = context.motion
        dop = getattr(planner, "degree_of_parallelism", motion.max_tweezers)
        limits = min(dop, motion.max_column_tones), min(dop, motion.max_row_tones)
        self.degree_of_parallelism = dop
        self._grid = context.grid
        self._planner = planner
        self._repair = Repair(settings.below, limits, dop, context)

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        getattr(self._planner, "warm", lambda: None)()
        self._repair.warm()

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan as the other planner does, or repair.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The pattern to make, of the same shape.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the
                target's shape.
        """
        try:
            atoms = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "repair") from error
        fill = nearest_to_centre(target.fill, int(np.count_nonzero(atoms)), self._grid)
        plan = self._planner.plan(atoms, target)
        return self._repair.improve(
            plan, atoms, fill, target, lambda after: self._planner.plan(after, target)
        )
