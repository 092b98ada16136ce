"""One plan without a run: for looking at what a planner does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.config import Settings
from labseq.errors import LabseqError, PlanError
from labseq.model import MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.roles import NeverStopped, Planner
from labseq.session.constructing import construct
from labseq.session.labs import parallelism_of
from labseq.session.occupancies import Source, read_source
from labseq.session.plan_inputs import PlanRequest, read_inputs


@dataclass(frozen=True, slots=True, eq=False)
class PlannedMoves:
    """A checked plan and everything it was made from.

    Attributes:
        source: Where the occupancy comes from, for people.
        occupancy: bool (n_rows, n_cols), before.
        target: What the array shall look like.
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        planner: Name of the planner.
        settings: Those of its settings that are not the defaults, SI, JSON-ready.
        degree_of_parallelism: Most tweezers on at once that the plan was checked for.
        seed: Seed of all random numbers, drawn or given; None if there is none.
        plan: The plan.
        report: What the check says of it.
    """

    source: str
    occupancy: Occupancy
    target: TargetPattern
    grid: SiteGrid
    motion: MotionSpec
    planner: str
    settings: Mapping[str, Any]
    degree_of_parallelism: int
    seed: int | None
    plan: Plan
    report: PlanReport

    @property
    def n_missing_atoms(self) -> int:
        """How many atoms are too few to fill the target."""
        return max(0, self.target.n_atoms - int(self.occupancy.sum()))

    @property
    def n_filled(self) -> int:
        """Target sites that hold an atom after the plan."""
        return self.target.n_atoms - self.report.n_defects

    @property
    def n_ejected(self) -> int:
        """Atoms that leave the grid."""
        return int(self.occupancy.sum()) - int(self.report.predicted.sum())

    @property
    def max_tweezers(self) -> int:
        """Most mobile tweezers on at once."""
        return int(self.report.n_tweezers.max(initial=0))

    def as_dict(self) -> dict[str, Any]:
        """Everything, JSON-ready; occupancies as rows of 0 and 1, ejected atoms at sites off the grid."""
        grid, report = self.grid, self.report
        return {
            "planner": self.planner,
            "grid": {
                "n_rows": grid.n_rows,
                "n_cols": grid.n_cols,
                "spacing_m": grid.spacing_m,
                "lattice": grid.lattice,
                "shear": grid.shear,
            },
            "degree_of_parallelism": self.degree_of_parallelism,
            "seed": self.seed,
            "occupancy": _bits(self.occupancy),
            "target": {"fill": _bits(self.target.fill), "clear": _bits(self.target.clear)},
            "n_batches": self.plan.n_batches,
            "n_atom_moves": self.plan.n_atom_moves,
            "duration_s": report.duration_s,
            "batches": [
                {"from": b.from_sites.tolist(), "to": b.to_sites.tolist(), "linked": b.linked}
                for b in self.plan.batches
            ],
            "predicted": _bits(report.predicted),
        }


def plan_moves(
    request: PlanRequest,
    source: Source | None = None,
    *,
    announce: Callable[[str], None] = lambda _: None,
) -> PlannedMoves:
    """Plan once, and check the plan as a run does.

    Args:
        request: What is to be planned.
        source: Its occupancy, if it has been read already.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: Something in the request is wrong; says what was expected.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
    """
    from labseq.kernels.compile import announcing

    source = source or read_source(request.occupancy, request.seed)
    occupancy, seed = source.occupancy, request.seed if source.seed is None else source.seed
    inputs = read_inputs(request, source)
    grid, motion, target = inputs.machine.grid, inputs.machine.motion, inputs.target
    made, _ = construct({"planner": inputs.planner}, grid, motion, NeverStopped(), seed or 0)
    planner: Planner = made["planner"]
    dop = parallelism_of(inputs.planner, planner, motion)
    with announcing(announce):
        plan = call_planner(planner, request.planner, occupancy, target)
        report = check_plan(plan, occupancy, target, dop, grid, motion, request.planner)
    return PlannedMoves(
        source=source.label,
        occupancy=occupancy,
        target=target,
        grid=grid,
        motion=motion,
        planner=request.planner,
        settings=changed_settings(inputs.planner.settings),
        degree_of_parallelism=dop,
        seed=seed,
        plan=plan,
        report=report,
    )


def call_planner(planner: Planner, name: str, occupancy: Occupancy, target: TargetPattern) -> Plan:
    """Call a planner with a copy, so that one that writes into its input harms only itself.

    Raises:
        PlanError: It raised; with its name.
    """
    try:
        return planner.plan(occupancy.copy(), target)
    except PlanError as error:
        raise error if error.planner else PlanError(str(error), name) from error
    except LabseqError:
        raise
    except Exception as error:
        raise PlanError(f"plan() raised {type(error).__name__}: {error}", name) from error


def changed_settings(settings: Settings | None) -> dict[str, Any]:
    """Those settings that are not the defaults, SI, JSON-ready."""
    return {} if settings is None else settings.model_dump(mode="json", exclude_defaults=True)


def _bits(sites: NDArray[np.bool_]) -> list[list[int]]:
    return sites.astype(int).tolist()
