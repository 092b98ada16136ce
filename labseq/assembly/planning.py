"""Plans the moves for one occupancy without a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from labseq.assembly.calibrations import calibrated_machine
from labseq.assembly.lab import choice_of, construct, parallelism_of
from labseq.assembly.occupancies import Source, read_source
from labseq.assembly.plugin_choice import (
    ChosenPlugin,
    changed_settings,
    construct_target,
    load_plugins,
    resolve,
)
from labseq.assembly.recorded import Machine, recorded_machine
from labseq.config.addresses import Override, split_overrides
from labseq.config.document import Document, plugin_paths
from labseq.config.find import find_sequence
from labseq.config.profile import load_profile
from labseq.config.sequence import DEFAULT_PLANNER, load_sequence
from labseq.errors import ConfigError, InvalidPlanError, LabseqError, LimitError, PlanError, Problem
from labseq.guard import Guard
from labseq.kernels.kernel import announcing, interpret
from labseq.messages import clean, format_plugin_error, visible
from labseq.model import MotionSpec, Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import Survival, check_plan, predict_survival
from labseq.plugins.host import PluginHost
from labseq.roles import ChoosesPlanner, Context, Planner
from labseq.settings import Choice, PatternChoice

_NAME: Final = re.compile(r"[^\W\d][\w.-]*")
_ORIGIN: Final = re.compile(r"\s*(-?\d{1,6})\s*,\s*(-?\d{1,6})\s*")
_TARGET_FORMS: Final = (
    "a pattern as in a sequence file, '{pattern: kagome, rows: 15, cols: 15}', or a sequence whose target "
    "is used"
)


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """The arguments of ``labseq plan``, as text.

    Attributes:
        occupancy: See :func:`labseq.assembly.occupancies.read_source`.
        target: See :func:`read_target`. None for the target of the shot.
        planner: Its name.
        degree_of_parallelism: The planner's setting of that name. None for its default.
        overrides: ``"key=value"`` for each further setting of the planner, with or without "planner." before
            the key, and for values of the profile with "profile.".
        seed: Seed of a drawn occupancy. None for a new seed.
        origin: "R,C", the top left site of the target. None for the pattern's own.
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


class PlanInputs(NamedTuple):
    """Everything that a plan depends on, except the occupancy."""

    machine: Machine
    target: TargetPattern
    planner: ChosenPlugin


def read_inputs(request: PlanRequest, source: Source) -> PlanInputs:
    """Read and validate all files and settings that a request names.

    Raises:
        ConfigError: An argument is invalid. The message says what was expected.
        PluginLoadError: A named plugin failed to load.
    """
    for_planner, for_profile = split_overrides(request.overrides)
    machine, folders = read_machine(request, for_profile, source)
    if request.target is None:
        target, host = _recorded_target(request, source), load_plugins(folders)
    else:
        choice = read_target(request.target, _origin(request.origin))
        host = load_plugins([*folders, *choice.plugin_folders])
        target = choice.make(host, machine.grid)
    return PlanInputs(machine, target, _planner(host, request, for_planner))


def read_machine(
    request: PlanRequest, overrides: Sequence[Override], source: Source
) -> tuple[Machine, list[Path]]:
    """Read grid and motion, and the profile's plugin folders.

    Args:
        request: Names the profile, if there is one.
        overrides: Values that replace values of the profile.
        source: The occupancy. Without a profile, the profile of its shot is used.

    Raises:
        ConfigError: The profile has an error, or its grid has another shape.
    """
    shape = source.occupancy.shape
    if request.profile is None:
        if overrides:
            raise ConfigError(Problem("--profile is missing", overrides[0].source))
        return _default_machine(source), []
    document, spec = load_profile(request.profile, overrides=overrides)
    grid, motion = calibrated_machine(document, spec)
    if grid.shape != shape:
        what = f"the occupancy has {shape[0]} x {shape[1]} sites"
        expected = f"{grid.n_rows} x {grid.n_cols}, as in {visible(str(document.path))}"
        raise ConfigError(Problem(what, visible(source.label), expected=expected))
    return Machine(grid, motion), plugin_paths(document, spec.plugin_folders)


def _default_machine(source: Source) -> Machine:
    """Grid and motion of the occupancy's shot, or else the paper's spacing and motion."""
    if source.machine is None:
        n_rows, n_cols = source.occupancy.shape
        return Machine(SiteGrid(n_rows, n_cols), MotionSpec())
    return recorded_machine(source.machine, "the profile in the shot's file")


def _recorded_target(request: PlanRequest, source: Source) -> TargetPattern:
    """The target of the occupancy's shot."""
    if source.target is None:
        raise ConfigError(Problem("--target is missing", expected=_TARGET_FORMS))
    if request.origin is not None:
        raise ConfigError(Problem("--origin needs --target", clean(f"--origin {request.origin}")))
    return source.target


class TargetChoice(NamedTuple):
    """A target named in a command, before it is made.

    Attributes:
        document: The sequence or the option that names its pattern.
        choice: The pattern, and the location of its settings.
        plugin_folders: The plugin folders of the sequence.
    """

    document: Document
    choice: PatternChoice
    plugin_folders: list[Path]

    def make(self, host: PluginHost, grid: SiteGrid) -> TargetPattern:
        """The target on a grid.

        Raises:
            ConfigError: The pattern or a setting is wrong, or the target does not fit on the grid.
            PluginLoadError: The pattern's plugin failed. The message names it.
        """
        pattern = resolve(host, self.document, "pattern", self.choice)
        try:
            return construct_target(pattern, grid)
        except LimitError as error:
            raise self.document.error(self.choice.loc, str(error)) from error


def read_target(text: str, overrides: Sequence[Override] = ()) -> TargetChoice:
    """Read ``--target``: a pattern as in a sequence file, or a sequence whose target is used.

    Args:
        text: A mapping such as "{pattern: kagome, rows: 15, cols: 15}", or the name or file of a sequence.
        overrides: Further settings of the target.

    Raises:
        ConfigError: There is no such sequence, it has an error or no target, or the mapping is invalid.
    """
    option = f"--target {text}"
    if not text:
        raise ConfigError(Problem("--target is empty", expected=_TARGET_FORMS))
    if text.lstrip().startswith("{"):
        document = Document.of_options([Override("target", text, option), *overrides], "the command line")
        choice = document.validate(PatternChoice, ("target",)).placed("target")
        return TargetChoice(document, choice, [])
    try:
        path = find_sequence(Path(text))
    except ConfigError as error:
        what, hint = f"there is no sequence '{clean(text)}'", error.problems[0].hint
        raise ConfigError(Problem(what, clean(option), expected=_TARGET_FORMS, hint=hint)) from None
    document, sequence, _ = load_sequence(path, overrides)
    if sequence.target is None:
        raise ConfigError(Problem("this sequence has no target", visible(text), expected=_TARGET_FORMS))
    return TargetChoice(document, sequence.target, plugin_paths(document, sequence.plugin_folders))


def _origin(text: str | None) -> list[Override]:
    if text is None:
        return []
    match = _ORIGIN.fullmatch(text)
    if match is None:
        what, expected = "this is not a site", "row and column of the target's top left site, for example 2,3"
        raise ConfigError(Problem(what, clean(f"--origin {text}"), expected=expected))
    return [Override("target.origin", f"[{match[1]}, {match[2]}]", f"--origin {text}")]


def _planner(host: PluginHost, request: PlanRequest, settings: Sequence[Override]) -> ChosenPlugin:
    option = f"--planner {request.planner}"
    if not _NAME.fullmatch(request.planner):
        raise ConfigError(Problem("this is not the name of a planner", clean(option), expected="a name"))
    overrides = [Override("planner.use", request.planner, option)]
    if request.degree_of_parallelism is not None:
        dop = str(request.degree_of_parallelism)
        overrides.append(Override("planner.degree_of_parallelism", dop, f"--dop {dop}"))
    for setting in settings:
        address = f"planner.{setting.address.removeprefix('planner.')}"
        overrides.append(Override(address, setting.value, setting.source))
    # a document of options, so that messages name the wrong option
    document = Document.of_options(overrides, "the command line")
    return resolve(host, document, "planner", Choice(use=request.planner).placed("planner"))


def construct_planner(chosen: ChosenPlugin, context: Context, seed: int = 0) -> tuple[Planner, int]:
    """Construct a planner without a run, and the maximum number of mobile tweezers in its batches.

    Raises:
        ConfigError: Its constructor refuses its settings.
        PluginLoadError: Its constructor raised, or made no planner. The message names the plugin.
    """
    objects, _ = construct({"planner": chosen}, context, seed)
    return objects["planner"], parallelism_of(chosen, objects["planner"], context.motion)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedMoves:
    """A checked plan with its inputs.

    Attributes:
        source: Origin of the occupancy, for messages.
        occupancy: bool (n_rows, n_cols), before.
        target: The target pattern.
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        planner: Name of the planner.
        settings: Its settings that differ from the defaults, SI, JSON-ready.
        degree_of_parallelism: Maximum number of tweezers on at once in the check of the plan.
        seed: Seed of all random numbers, drawn or given. None if there is none.
        plan: The plan.
        report: Result of the check. For a refused plan, the result for the batches before the refused one.
        choice: The planner's choice for the target, then the alternatives. Empty if it has no choice.
        refused: The rule that the plan breaks in a batch. None for a valid plan.
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
    choice: Sequence[str] = ()
    refused: InvalidPlanError | None = None

    @property
    def n_missing_atoms(self) -> int:
        """Number of atoms missing to fill the target."""
        return max(0, self.target.n_atoms - int(self.occupancy.sum()))

    @property
    def n_filled(self) -> int:
        """Number of target sites with an atom after the plan."""
        return self.target.n_atoms - self.report.n_defects

    @property
    def n_ejected(self) -> int:
        """Number of atoms that leave the grid."""
        return int(self.occupancy.sum()) - int(self.report.predicted.sum())

    @property
    def max_tweezers(self) -> int:
        """Maximum number of mobile tweezers on at once."""
        return int(self.report.n_tweezers.max(initial=0))

    @property
    def survival(self) -> Survival:
        """Predicted survival for the plan, from the losses of the profile."""
        plan = self.plan if self.refused is None else self.plan.first(self.refused.batch)
        return predict_survival(plan, self.report, self.occupancy, self.target, self.grid, self.motion)


def plan_moves(
    request: PlanRequest,
    source: Source | None = None,
    *,
    announce: Callable[[float], None] = lambda _: None,
    keep_refused: bool = False,
    once: bool = False,
) -> PlannedMoves:
    """Plan once, and check the plan as a run does.

    Args:
        announce: Called before kernels are compiled, with the approximate compilation time in seconds.
        keep_refused: Whether to return also a plan that breaks a rule in one of its batches.
        once: Whether this process plans only once.

    Raises:
        ConfigError: The request has an error. The message says what was expected.
        PluginLoadError: A named plugin failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
    """
    source = source or read_source(request.occupancy, request.seed)
    occupancy, seed = source.occupancy, request.seed if source.seed is None else source.seed
    inputs = read_inputs(request, source)
    grid, motion, target = inputs.machine.grid, inputs.machine.motion, inputs.target
    planner, dop = construct_planner(inputs.planner, Context(grid=grid, motion=motion), seed or 0)
    # a single plan in plain Python is faster than loading numba, but a choice makes a hundred plans
    if once and occupancy.size <= 64 * 64 and not isinstance(planner, ChoosesPlanner):
        interpret()
    with announcing(announce):
        choice = choice_of(planner, target)
        plan, refused = call_planner(planner, request.planner, occupancy, target), None
        try:
            report = check_plan(plan, occupancy, target, dop, grid, motion, request.planner)
        except InvalidPlanError as error:
            # if a plan is wrong as a whole, it has no first batches to show
            if not keep_refused or error.batch < 0:
                raise
            refused, before = error, plan.first(error.batch)
            report = check_plan(before, occupancy, target, dop, grid, motion, request.planner)
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
        choice=choice,
        refused=refused,
    )


MAX_PLAN_S: Final = 60.0
"""Maximum time for a plan outside of a run, in seconds. Its kernels may be interpreted."""


def call_planner(
    planner: Planner, name: str, occupancy: Occupancy, target: TargetPattern, guard: Guard | None = None
) -> Plan:
    """Call a planner with a copy of the occupancy, in case the planner changes its input.

    Args:
        guard: Guard of the call. None for a new guard.

    Raises:
        PlanError: The planner raised, or did not return in time. The message names the planner.
    """
    own = guard or Guard()
    try:
        call = own.run("planner", MAX_PLAN_S, partial(planner.plan, occupancy.copy(), target))
    finally:
        if guard is None:
            own.end()
    if call is None:
        text = f"plan() did not return within {MAX_PLAN_S:.3g} s and was abandoned"
        in_a_run = "a run waits for 'timeouts: {plan: ...}' of its profile, 5 s by default"
        raise PlanError(f"{text}; {in_a_run}", name)
    error = call.error
    if error is None:
        return call.result
    if isinstance(error, LabseqError):
        is_named = not isinstance(error, PlanError) or error.planner
        raise error if is_named else PlanError(str(error), name) from error
    raise PlanError(f"plan() raised {format_plugin_error(error)}", name) from error
