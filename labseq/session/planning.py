"""One plan without a run: for looking at what a planner does."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from labseq.config import (
    MOTION_KEYS,
    Choice,
    Document,
    MotionSettings,
    Override,
    load_profile,
    load_sequence,
    plugin_paths,
    validate_values,
)
from labseq.config.fields import PatternChoice
from labseq.config.profile import GridSettings
from labseq.config.reading import YAML_SUFFIXES
from labseq.config.sequence import DEFAULT_PLANNER
from labseq.config.wording import clean
from labseq.errors import ConfigError, LabseqError, PlanError, Problem
from labseq.model import MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.plugins import PluginHost
from labseq.roles import NeverStopped, Planner
from labseq.session.assembly import load_plugins
from labseq.session.choosing import construct, make_target, resolve
from labseq.session.occupancies import Source, read_source

_COMMAND_LINE: Final = "the command line"
_TARGET: Final = re.compile(r"([^\W\d][\w-]*)(?::(.*))?", re.DOTALL)
_SIZE: Final = re.compile(r"(\d{1,6})\s*[xX]\s*(\d{1,6})")
_ORIGIN: Final = re.compile(r"\s*(-?\d{1,6})\s*,\s*(-?\d{1,6})\s*")
_NEXT_SETTING: Final = re.compile(r",(?=\s*[^\W\d]\w*\s*=)")


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What is to be planned, in the words of the command line.

    Attributes:
        occupancy: See :func:`labseq.session.occupancies.read_source`.
        target: "kagome:15x15", "kagome:rows=15,cols=15" or a sequence file; None
            for the target that a shot was taken with.
        planner: Its name.
        degree_of_parallelism: The planner's setting of that name; None for its default.
        overrides: Further settings of the planner, ``"key=value"`` each.
        seed: Seed of a drawn occupancy; None for a fresh one.
        origin: "R,C", the top left site of the target; None for the pattern's own.
        profile: Name or path of a profile for grid, motion and plugin folders.
    """

    occupancy: str
    target: str | None = None
    planner: str = DEFAULT_PLANNER
    degree_of_parallelism: int | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    origin: str | None = None
    profile: str | None = None


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
        settings: Its settings.
        degree_of_parallelism: Most tweezers on at once that the plan was checked for.
        seed: Seed that the occupancy was drawn with; None if it was not drawn.
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
    *,
    stdin: BinaryIO | None = None,
    announce: Callable[[str], None] = lambda _: None,
) -> PlannedMoves:
    """Plan once, and check the plan as a run does.

    Args:
        request: What is to be planned.
        stdin: What an occupancy "-" is read from; standard input if None.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: Something in the request is wrong; says what was expected.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
    """
    from labseq.kernels.compile import announcing

    source = read_source(request.occupancy, request.seed, stdin)
    setting = _Setting.of(request, source)
    target = _target(request, source, setting)
    chosen = resolve(setting.host, setting.document, "planner", Choice(use=request.planner).placed("planner"))
    made, _ = construct(
        {"planner": chosen}, setting.grid, setting.motion, NeverStopped(), request.seed or 0
    )
    planner: Planner = made["planner"]
    dop = getattr(planner, "degree_of_parallelism", setting.motion.max_tweezers)
    dop = dop if isinstance(dop, int) else setting.motion.max_tweezers
    with announcing(announce):
        plan = _plan(planner, request.planner, source.occupancy, target)
        report = check_plan(
            plan, source.occupancy, target, dop, setting.grid, setting.motion, request.planner
        )
    settings = {key: value for key, value in chosen.dump().items() if key != "use"}
    return PlannedMoves(
        source=source.label,
        occupancy=source.occupancy,
        target=target,
        grid=setting.grid,
        motion=setting.motion,
        planner=request.planner,
        settings=settings,
        degree_of_parallelism=dop,
        seed=source.seed,
        plan=plan,
        report=report,
    )
