"""From a chosen entry and its settings to the object, without opening anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from labseq.errors import ConfigError, LabseqError, LimitError
from labseq.model import (
    CalibrationEntry,
    LineSpec,
    MotionSpec,
    RandomStream,
    ScanSpace,
    SiteGrid,
    TargetPattern,
)
from labseq.plugins import contained
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
from labseq.session.choosing import ChosenPlugin

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

    return contained(entry.owner, f"the constructor of {entry.kind} '{entry.name}'", make)


def construct_target(chosen: ChosenPlugin, grid: SiteGrid) -> TargetPattern:
    """Make a target of its pattern.

    Raises:
        LabseqError: The pattern refuses, for example because it does not fit on the grid.
        PluginLoadError: The pattern's plugin is at fault; names it.
    """
    entry = chosen.entry
    target = contained(entry.owner, f"pattern '{entry.name}'", lambda: entry.factory(chosen.settings, grid))
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
    called, see = f"{entry.kind} '{entry.name}'", f"see labseq.{role.__name__}"
    if made is None or isinstance(made, type):
        raise entry.owner.fault(f"the factory of {called} made {_called(made)}; expected an object; {see}")
    names = [name for name in [*role.__annotations__, *dir(role)] if not name.startswith("_")]
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
