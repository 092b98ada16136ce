"""From an entry and its settings to the object: devices, target, planner, steps and analyses."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from labseq.config import Document, SequenceSpec, StepSpec
from labseq.config.sequence import ANALYSIS_KEYS
from labseq.errors import ConfigError, LabseqError, LimitError, PluginLoadError, ProblemCollector, one_of
from labseq.model import (
    CalibrationEntry,
    LineSpec,
    MotionSpec,
    RandomStream,
    ScanSpace,
    SiteGrid,
    TargetPattern,
)
from labseq.plugins import call_plugin
from labseq.registry import Entry
from labseq.roles import (
    Analysis,
    Camera,
    Clock,
    Context,
    Detector,
    Device,
    Lines,
    MobileTweezers,
    Planner,
    Scanner,
    Simulation,
    StaticTweezers,
    Step,
)
from labseq.session.profile import ChosenPlugin, ResolvedProfile, dump, named, resolve, validate
from labseq.settings import Settings

_ROLES: Final[Mapping[str, type]] = {
    "camera": Camera,
    "static_tweezers": StaticTweezers,
    "mobile_tweezers": MobileTweezers,
    "device": Device,
    "lines": Lines,
    "detector": Detector,
    "planner": Planner,
    "simulation": Simulation,
    "step": Step,
    "scanner": Scanner,
    "analysis": Analysis,
}


def construct(
    chosen: Mapping[str, ChosenPlugin],
    grid: SiteGrid,
    motion: MotionSpec,
    clock: Clock,
    seed: int,
    simulation: Simulation | None = None,
    calibrations: Mapping[str, CalibrationEntry] | None = None,
    world_grid: SiteGrid | None = None,
    lines: tuple[LineSpec, ...] = (),
) -> tuple[dict[str, Any], tuple[RandomStream, ...]]:
    """Construct the object of every role; constructors do no I/O, so nothing is open yet.

    Args:
        chosen: Role -> what plays it.
        grid: The grid of sites, with calibrated tones.
        motion: How the mobile tweezers move.
        clock: The session's clock.
        seed: The run's seed.
        simulation: The world, where none is among the chosen.
        calibrations: Those in use: kind -> entry.
        world_grid: The grid without calibrations, for the simulation: it is the truth that they are
            measured on; None where there are none.
        lines: What is wired to the timing box.

    Returns:
        Role -> object, and the random streams that were handed out.

    Raises:
        ConfigError: A constructor refuses its settings; with their place.
        PluginLoadError: A constructor raised, or made no object of that role; names the plugin.
    """
    made, streams, refused = construct_each(
        chosen, grid, motion, clock, seed, simulation, calibrations, world_grid, lines
    )
    for error in refused.values():
        raise error
    return made, streams


def construct_each(
    chosen: Mapping[str, ChosenPlugin],
    grid: SiteGrid,
    motion: MotionSpec,
    clock: Clock,
    seed: int,
    simulation: Simulation | None = None,
    calibrations: Mapping[str, CalibrationEntry] | None = None,
    world_grid: SiteGrid | None = None,
    lines: tuple[LineSpec, ...] = (),
) -> tuple[dict[str, Any], tuple[RandomStream, ...], dict[str, LabseqError]]:
    """The same, but one that cannot be constructed never keeps the others from it.

    Returns:
        Role -> object, the random streams, and role -> why it could not be constructed.
    """
    made: dict[str, Any] = {}
    streams: list[RandomStream] = []
    refused: dict[str, LabseqError] = {}
    for role in sorted(chosen, key=lambda role: role != "simulation"):  # the world comes first
        is_world = role == "simulation"
        stream = RandomStream(seed, "" if is_world else role)
        streams.append(stream)
        sites = world_grid if is_world and world_grid is not None else grid
        world = made.get("simulation", simulation)
        context = Context(role, sites, motion, clock, stream, calibrations or {}, world, lines)
        try:
            made[role] = construct_one(chosen[role], context)
        except LabseqError as error:
            refused[role] = error
    return made, tuple(streams), refused


def construct_one(chosen: ChosenPlugin, context: Context | ScanSpace) -> Any:
    """Construct the object of one role; that of a scanner is given what it may choose from.

    Raises:
        ConfigError: Its constructor refuses its settings; with their place.
        PluginLoadError: Its constructor raised, or made no object of that role; names the plugin.
    """
    entry = chosen.entry
    try:
        return construct_role(entry, chosen.settings, context)
    except (ConfigError, LimitError) as error:
        raise chosen.placed(error) from error


def construct_role(entry: Entry, *arguments: Any) -> Any:
    """Call a factory, and see whether what it made plays its role.

    Args:
        entry: Whose factory.
        *arguments: What it is called with.

    Raises:
        LabseqError: The factory raised this one.
        PluginLoadError: It raised something else, did not return in time, or made no object of that role.
    """

    def make() -> Any:
        made = entry.factory(*arguments)
        check_role(entry, made)
        return made

    return call_plugin(entry.owner, f"the constructor of {entry.kind} '{entry.name}'", make)


def construct_target(chosen: ChosenPlugin, grid: SiteGrid) -> TargetPattern:
    """Make a target of its pattern.

    Raises:
        LabseqError: The pattern refuses, for example because it does not fit on the grid.
        PluginLoadError: The pattern's plugin is at fault; names it.
    """
    entry = chosen.entry
    target = call_plugin(entry.owner, f"pattern '{entry.name}'", lambda: entry.factory(chosen.settings, grid))
    if not isinstance(target, TargetPattern) or target.shape != grid.shape:
        came = "" if isinstance(target, TargetPattern) else f", but {_called(target)}"
        raise entry.owner.fault(f"pattern '{entry.name}' made no TargetPattern of shape {grid.shape}{came}")
    return target


def check_role(entry: Entry, made: object) -> None:
    """Refuse an object that lacks a method or attribute of its role.

    Raises:
        PluginLoadError: With what is missing.
    """
    role = _ROLES[entry.kind]
    called, see = f"{entry.kind} '{entry.name}'", f"see labseq.plugin.{role.__name__}"
    if made is None or isinstance(made, type):
        raise entry.owner.fault(f"the factory of {called} made {_called(made)}; expected an object; {see}")
    names = (
        [*role.__annotations__, *getattr(role, "__abstractmethods__", ())]
        if issubclass(role, ABC)
        else dir(role)
    )
    names = sorted(name for name in names if not name.startswith("_"))
    missing = [name for name in names if not hasattr(made, name)]
    if missing:
        raise entry.owner.fault(f"{called} has no {', '.join(missing)}; {see}")
    methods = [name for name in names if callable(getattr(role, name, None))]
    if wrong := [name for name in methods if not callable(getattr(made, name))]:
        raise entry.owner.fault(f"{', '.join(wrong)} of {called} cannot be called; {see}")


def _called(made: object) -> str:
    if made is None:
        return "None"
    return f"the class {made.__name__} itself" if isinstance(made, type) else f"a {type(made).__name__}"


DEVICE_KEYS: Final = {"device": "name", "equalise": "device", "wait": "device"}
"""Steps that need a device of the profile -> the setting that names it; a wait need not name one."""


def make_target(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any]]:
    """The target of a sequence, and its settings for the record.

    Raises:
        ConfigError: The pattern is unknown, its settings are wrong, or it does not fit on the grid.
        PluginLoadError: The pattern's plugin is at fault; names it.
    """
    choice, grid = sequence.target, bench.grid
    chosen = resolve(bench.host, document, "pattern", choice)
    try:
        target = construct_target(chosen, grid)
    except PluginLoadError:
        raise
    except LabseqError as error:
        problem = document.problem(choice.loc, str(error))
        raise ConfigError(replace(problem, notes=(_grid_note(bench),))) from error
    return target, {"pattern": chosen.entry.name, **dump(chosen.entry, chosen.settings)}


def make_steps(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec, found: ProblemCollector
) -> tuple[list[tuple[str, Step]], list[dict[str, Any]]]:
    """Name and step, in order, and the settings of each for the record.

    Args:
        bench: The profile.
        document: The sequence's file.
        sequence: What it says.
        found: Where the problems go.
    """
    steps: list[tuple[str, Step]] = []
    dumps: list[dict[str, Any]] = []
    image_seen = False
    for spec in sequence.shot:
        step: Step | None = None
        with found:
            step, dumped = make_step(bench, document, spec)
            steps.append((spec.name or spec.kind, step))
            dumps.append({spec.kind: dumped, **({"name": spec.name} if spec.name else {})})
            if step.needs_image and not image_seen:
                what = f"'{spec.kind}' needs an image before it in the shot"
                raise document.error(spec.loc, what, "an 'image' step before it", key=True)
        # Whether a step that is wrong would take an image, nobody knows.
        image_seen = image_seen or step is None or step.takes_image
    return steps, dumps


def make_step(bench: ResolvedProfile, document: Document, spec: StepSpec) -> tuple[Step, dict[str, Any]]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, or its settings are wrong; with their place.
    """
    entry = named(bench.host, document, "step", spec.kind, spec.loc, key=True)
    settings = validate(document, entry, spec.loc)
    if spec.kind in DEVICE_KEYS:
        _check_device_name(bench, document, settings, spec)
    try:
        return construct_role(entry, settings), dump(entry, settings)
    except (ConfigError, PluginLoadError) as error:
        raise document.error(spec.loc, str(error)) from error


def make_analyses(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec, found: ProblemCollector
) -> list[dict[str, Any]]:
    """What is worked out from each shot: the settings of each analysis for the record.

    Each is constructed once, to see whether it can be: those of the run live in processes of their own.

    Args:
        bench: The profile.
        document: The sequence's file.
        sequence: What it says.
        found: Where the problems go.
    """
    dumps: list[dict[str, Any]] = []
    for choice in sequence.analysis:
        with found:
            chosen = resolve(bench.host, document, "analysis", choice, ANALYSIS_KEYS)
            context = Context(choice.use, bench.grid, bench.profile.motion, calibrations=bench.calibrations)
            construct_one(chosen, context)
            dumps.append({**chosen.dump(), "finish_within": choice.finish_within})
    return dumps


def _check_device_name(
    bench: ResolvedProfile, document: Document, settings: Settings | None, spec: StepSpec
) -> None:
    key = DEVICE_KEYS[spec.kind]
    name = getattr(settings, key, None)
    if name is not None and name not in bench.profile.devices:
        what = f"the profile '{bench.profile.name}' has no device '{name}'"
        problem = document.problem((*spec.loc, key), what, one_of(sorted(bench.profile.devices)))
        raise ConfigError(replace(problem, notes=(_place(bench.document, "devices"),)))


def _grid_note(bench: ResolvedProfile) -> str:
    grid = bench.grid
    return f"the grid has {grid.n_rows} x {grid.n_cols} sites: {_place(bench.document, 'grid')}"


def _place(document: Document, key: str) -> str:
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"
