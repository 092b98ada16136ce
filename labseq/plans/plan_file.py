"""Reads the JSON that ``labseq plan --json`` writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Self, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from labseq.assembly.occupancies import Source
from labseq.assembly.planning import PlannedMoves, PlanRequest, read_machine
from labseq.assembly.recorded import Machine
from labseq.config.addresses import split_overrides
from labseq.config.profile import Sites
from labseq.config.validation import validate_values
from labseq.errors import ConfigError, PlanError, Problem
from labseq.model import Batch, MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern, TonePaths
from labseq.motion import check_plan
from labseq.settings import Name, Settings, setting_error
from labseq.text_files import decode

MAX_BYTES: Final = 4 << 20
"""Maximum size of a plan, in bytes, enough for 500 x 500 sites."""

_EXPECTED: Final = "what 'labseq plan --json' writes"

Bit: TypeAlias = Annotated[int, Field(ge=0, le=1)]
Rows: TypeAlias = tuple[tuple[Bit, ...], ...]
Index: TypeAlias = Annotated[int, Field(ge=-1000, le=2000)]
"""Index of a row or column. An ejected atom ends off the grid."""


class GridFile(Settings):
    """The sites that a plan is for."""

    n_rows: Sites = Field(description="number of rows")
    n_cols: Sites = Field(description="number of columns")
    spacing_m: float = Field(gt=0, le=1e-3, description="distance between neighbouring sites, in metres")
    lattice: Literal["triangular", "square"] = Field(description="kind of lattice")
    shear: Literal[1, -1] = Field(
        description="1 if rows shift to the right on the way down, -1 if to the left"
    )

    def model(self) -> SiteGrid:
        """The grid, with the tones of the paper's spacing."""
        return SiteGrid(self.n_rows, self.n_cols, self.spacing_m, self.lattice, self.shear)


class TargetFile(Settings):
    """The pattern of atoms to reach."""

    fill: Rows = Field(description="sites that must hold an atom")
    clear: Rows = Field(description="sites that must be empty")


Position: TypeAlias = Annotated[float, Field(ge=-1000, le=2000)]
"""Row or column of a tone, in sites."""
Path: TypeAlias = tuple[tuple[Position, ...], ...]
Knots: TypeAlias = tuple[Annotated[int, Field(ge=1, le=100_000)], ...]


class PathsFile(Settings):
    """Paths of the tones of a batch."""

    row: Path = Field(description="positions of the row tones, in sites, at each knot")
    column: Path = Field(description="the same for the column tones")
    row_off: Knots = Field(description="knot at which each row tone goes off, from 0")
    column_off: Knots = Field(description="the same for the column tones")

    @model_validator(mode="after")
    def _are_paths(self) -> Self:
        try:
            self.model()
        except ValueError as error:
            raise setting_error(str(error), "paths of tones as 'labseq plan --json' writes them") from None
        return self

    def model(self) -> TonePaths:
        """The paths."""
        return TonePaths(*map(np.array, (self.row, self.column, self.row_off, self.column_off)))


class BatchFile(Settings):
    """A batch of a plan."""

    from_sites: tuple[tuple[Index, Index], ...] = Field(
        alias="from", description="[row, column] of each atom"
    )
    to_sites: tuple[tuple[Index, Index], ...] = Field(alias="to", description="[row, column] of each goal")
    linked: bool = Field(default=False, description="true if the tweezers stay on from the batch before")
    tones: PathsFile | None = Field(
        default=None, description="paths of the tones, where rows and columns move at once"
    )

    @model_validator(mode="after")
    def _has_a_goal_for_each_atom(self) -> Self:
        if len(self.from_sites) != len(self.to_sites):
            what = f"'from' has {len(self.from_sites)} sites, but 'to' has {len(self.to_sites)}"
            raise setting_error(what, "the same number")
        if self.linked and self.tones is not None:
            raise setting_error("a batch with 'tones' is linked", "only line batches to be linked")
        return self

    def model(self) -> Batch:
        """The batch."""
        from_sites, to_sites = (
            np.array(sites, np.int16).reshape(-1, 2) for sites in (self.from_sites, self.to_sites)
        )
        return Batch(from_sites, to_sites, self.linked, self.tones and self.tones.model())


class _File(Settings):
    """The keys of a plan's file. Derived values in it are ignored."""

    model_config = ConfigDict(extra="ignore")

    planner: Name = Field(description="name of the planner")
    grid: GridFile = Field(description="the sites that the plan is for")
    degree_of_parallelism: int = Field(ge=1, le=1_000_000, description="most mobile tweezers on at once")
    seed: int | None = Field(default=None, ge=0, description="seed of all random numbers, or null")
    occupancy: Rows = Field(description="before the plan, rows of 0 and 1")
    target: TargetFile = Field(description="the pattern of atoms to reach")
    batches: tuple[BatchFile, ...] = Field(description="the batches")


@dataclass(frozen=True, slots=True, eq=False)
class PlanFile:
    """A plan and its inputs, as read from a file. The plan is not checked yet.

    Attributes:
        planner: Name of the planner.
        degree_of_parallelism: Maximum number of tweezers on at once that the planner was allowed.
        seed: Seed of all random numbers, or None.
        grid: The grid of sites, with the tones that a grid of its size has by default.
        occupancy: bool (n_rows, n_cols), before the plan.
        target: The pattern of atoms to reach.
        plan: The batches.
    """

    planner: str
    degree_of_parallelism: int
    seed: int | None
    grid: SiteGrid
    occupancy: Occupancy
    target: TargetPattern
    plan: Plan


def parse_plan(data: bytes, name: str) -> PlanFile:
    """Read the JSON of a plan.

    Args:
        data: UTF-8.

    Raises:
        ConfigError: It is not JSON, not a plan, or a value in it is invalid. The message says what was
            expected.
    """
    if len(data) > MAX_BYTES:
        raise ConfigError(Problem(f"it is larger than {MAX_BYTES >> 20} MiB", name, expected=_EXPECTED))
    text = decode(data, name)
    try:
        values: Any = json.loads(text)
    except json.JSONDecodeError as error:
        what = f"this is not JSON: {error.msg[:1].lower()}{error.msg[1:]}"
        raise ConfigError(Problem(what, name, error.lineno, error.colno, _EXPECTED)) from error
    except (RecursionError, ValueError) as error:  # or a number of thousands of digits
        reason = "it is nested too deep" if isinstance(error, RecursionError) else error
        raise ConfigError(Problem(f"this is not a plan: {reason}", name, expected=_EXPECTED)) from error
    if not isinstance(values, dict) or not {"planner", "batches"} & values.keys():
        raise ConfigError(Problem("this is not a plan", name, expected=_EXPECTED))
    file = validate_values(_File, cast("Mapping[str, Any]", values), name)
    grid = file.grid.model()
    return PlanFile(
        planner=file.planner,
        degree_of_parallelism=file.degree_of_parallelism,
        seed=file.seed,
        grid=grid,
        occupancy=_bits(file.occupancy, "occupancy", grid.shape, name),
        target=_target(file.target, grid.shape, name),
        plan=Plan.from_batches([batch.model() for batch in file.batches]),
    )


def _target(target: TargetFile, shape: tuple[int, int], name: str) -> TargetPattern:
    fill, clear = _bits(target.fill, "fill", shape, name), _bits(target.clear, "clear", shape, name)
    try:
        return TargetPattern(fill, clear)
    except ValueError as error:
        raise ConfigError(Problem(str(error), name)) from error


def _bits(rows: Rows, key: str, shape: tuple[int, int], name: str) -> NDArray[np.bool_]:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        expected = f"{shape[0]} rows of {shape[1]} sites, as in 'grid'"
        raise ConfigError(Problem(f"'{key}' does not have the grid's shape", name, expected=expected))
    return np.array(rows, np.bool_)


_OPTIONS = ("target", "planner", "degree_of_parallelism", "seed", "origin")
"""Fields of a request that only planning accepts."""


def read_plan(
    data: bytes, name: str, request: PlanRequest, *, announce: Callable[[float], None] = lambda _: None
) -> PlannedMoves:
    """Read the JSON of a plan, and check the plan as a run does.

    Args:
        data: The output of ``labseq plan --json``, in UTF-8.
        request: Names the profile with grid and motion. Without a profile the grid comes from the file, and
            the motion from the paper. Nothing is planned.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.

    Raises:
        ConfigError: It is not a plan, it does not fit the grid or breaks a rule, or the request has options
            for planning.
    """
    from labseq.kernels.kernel import announcing

    file = parse_plan(data, name)
    machine = _machine(file, name, request)
    with announcing(announce):
        try:
            dop = file.degree_of_parallelism
            report = check_plan(file.plan, file.occupancy, file.target, dop, machine.grid, machine.motion)
        except PlanError as error:
            raise ConfigError(Problem(str(error), name)) from error
    return PlannedMoves(
        source=name,
        occupancy=file.occupancy,
        target=file.target,
        grid=machine.grid,
        motion=machine.motion,
        planner=file.planner,
        settings={},
        degree_of_parallelism=file.degree_of_parallelism,
        seed=file.seed,
        plan=file.plan,
        report=report,
    )


def _machine(file: PlanFile, name: str, request: PlanRequest) -> Machine:
    for_planner, for_profile = split_overrides(request.overrides)
    default = PlanRequest(request.occupancy)
    options = [name for name in _OPTIONS if getattr(request, name) != getattr(default, name)]
    if options or for_planner:
        option = (
            f"--{options[0]}".replace("degree_of_parallelism", "dop") if options else for_planner[0].source
        )
        what = f"{name} is already a plan, so there is nothing to plan"
        raise ConfigError(Problem(what, option, hint="leave the option out, or give an occupancy"))
    if request.profile is None and not for_profile:
        return Machine(file.grid, MotionSpec())
    return read_machine(request, for_profile, Source(file.occupancy, name))[0]
