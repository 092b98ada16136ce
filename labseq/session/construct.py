"""Constructs objects from registry entries and settings: devices, target, planner, steps, analyses."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from labseq.config.document import Document
from labseq.config.sequence import SequenceSpec, StepSpec
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
    true_grid: SiteGrid | None = None,
    lines: tuple[LineSpec, ...] = (),
    *,
    refused: dict[str, LabseqError] | None = None,
) -> tuple[dict[str, Any], tuple[RandomStream, ...]]:
    """Construct the object of every role; constructors do no I/O, so nothing is open yet.

    Args:
        chosen: Role -> its plugin.
        grid: The grid of sites, with calibrated tones.
        motion: How the mobile tweezers move.
        clock: The session's clock.
        seed: The run's seed.
        simulation: The simulation, if none is among the chosen.
        calibrations: The active calibrations: kind -> entry.
        true_grid: The grid without calibrations, for the simulation, in which they are measured; None
            without calibrations.
        lines: The lines connected to the timing box.
        refused: Receives the errors, role -> error; without it they are raised.

    Returns:
        Role -> object, and the random streams that the objects received.

    Raises:
        ConfigError: A constructor refuses its settings; with their place.
        PluginLoadError: A constructor raised, or made no object of that role; names the plugin.
    """
    made: dict[str, Any] = {}
    streams: list[RandomStream] = []
    for role in sorted(chosen, key=lambda role: role != "simulation"):  # the others receive the simulation
        is_simulation = role == "simulation"
        stream = RandomStream(seed, "" if is_simulation else role)
        streams.append(stream)
        sites = true_grid if is_simulation and true_grid is not None else grid
        shared = made.get("simulation", simulation)
        context = Context(role, sites, motion, clock, stream, calibrations or {}, shared, lines)
        try:
            made[role] = construct_one(chosen[role], context)
        except LabseqError as error:
            if refused is None:
                raise
            refused[role] = error
    return made, tuple(streams)


def construct_one(chosen: ChosenPlugin, context: Context | ScanSpace) -> Any:
    """Construct the object of one role; a scanner receives the ranges that it may choose from.

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
    """Call a factory, and check that its object has the methods of its role.

    Args:
        entry: The entry with the factory.
        *arguments: The factory's arguments.

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
    """Make a target from its pattern.

    Raises:
        LabseqError: The pattern refuses, for example because it does not fit on the grid.
        PluginLoadError: The pattern's plugin failed; names it.
    """
    entry = chosen.entry
    target = call_plugin(entry.owner, f"pattern '{entry.name}'", lambda: entry.factory(chosen.settings, grid))
    if not isinstance(target, TargetPattern) or target.shape != grid.shape:
        came = "" if isinstance(target, TargetPattern) else f", but {_called(target)}"
        raise entry.owner.fault(f"pattern '{entry.name}' made no TargetPattern of shape {grid.shape}{came}")
    return target


def check_role(entry: Entry, made: object) -> None:
    """Raise if an object lacks a method or attribute of its role.

    Raises:
        PluginLoadError: A method or attribute is missing; names it.
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
"""Step that uses a device of the profile -> the setting with the device's name (optional for a wait)."""


def make_target(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any]]:
    """The target of a sequence, and its settings for the record.

    Raises:
        ConfigError: The pattern is unknown, its settings are invalid, or it does not fit on the grid.
        PluginLoadError: The pattern's plugin failed; names it.
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
        sequence: Its content.
        found: Receives the problems.
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
        # A wrong step counts as one that takes an image: the user may have intended one.
        image_seen = image_seen or step is None or step.takes_image
    return steps, dumps


def make_step(bench: ResolvedProfile, document: Document, spec: StepSpec) -> tuple[Step, dict[str, Any]]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, or its settings are invalid; with their place.
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
    """The settings of each analysis of the sequence, for the record.

    Each is constructed once, to check that it can be; during the run they have their own processes.

    Args:
        bench: The profile.
        document: The sequence's file.
        sequence: Its content.
        found: Receives the problems.
    """
    dumps: list[dict[str, Any]] = []
    for choice in sequence.analysis:
        with found:
            chosen = resolve(bench.host, document, "analysis", choice)
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
