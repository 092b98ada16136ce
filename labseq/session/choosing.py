"""From a name in a file to a plugin's entry, its settings, and the object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

from labseq.config import MOTION_KEYS, Choice, Document, Loc, ProfileSpec
from labseq.config.settings import Settings
from labseq.config.wording import clean
from labseq.errors import (
    ConfigError,
    LabseqError,
    LimitError,
    PluginLoadError,
    Problem,
    UnknownPluginError,
    one_of,
)
from labseq.model import MotionSpec, RandomStream, SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.registry import VIRTUAL_TWIN, Entry
from labseq.roles import (
    Camera,
    Clock,
    Context,
    Detector,
    Device,
    MobileTweezers,
    Planner,
    Simulation,
    StaticTweezers,
)

DryRun = Literal["off", "full", "fast"]

HARDWARE_KINDS: Final = frozenset({"camera", "static_tweezers", "mobile_tweezers", "device"})

_ROLES: Final[Mapping[str, type]] = {
    "camera": Camera,
    "static_tweezers": StaticTweezers,
    "mobile_tweezers": MobileTweezers,
    "device": Device,
    "detector": Detector,
    "planner": Planner,
    "simulation": Simulation,
}


@dataclass(frozen=True, slots=True)
class Chosen:
    """A registry entry and the settings it will be constructed with.

    Attributes:
        entry: What was chosen.
        settings: Its settings; None if it takes none.
        document: The file that chose it; None if nobody did.
        loc: Where its settings are in that file.
    """

    entry: Entry
    settings: Settings | None
    document: Document | None = None
    loc: Loc = ()

    def dump(self) -> dict[str, Any]:
        """Settings for the record, SI, JSON-ready."""
        return {"use": self.entry.name, **dump(self.settings)}

    def placed(self, error: ConfigError | LimitError) -> LabseqError:
        """What its constructor says of its settings, with the place that they stand in."""
        is_placed = isinstance(error, ConfigError) and any(problem.source for problem in error.problems)
        if self.document is None or is_placed:
            return error
        return self.document.error(self.loc, str(error))


@dataclass(frozen=True, slots=True)
class Bench:
    """A profile with its plugins chosen, before anything is opened.

    Attributes:
        document: The profile's file.
        profile: What it says.
        host: The plugins.
        grid: The grid of sites.
        chosen: Role or device name -> what plays it; no planner.
        warnings: What the user should know although it is no error.
    """

    document: Document
    profile: ProfileSpec
    host: PluginHost
    grid: SiteGrid
    chosen: Mapping[str, Chosen]
    warnings: tuple[str, ...]

    @property
    def virtual_time(self) -> bool:
        """Whether no device needs real time."""
        return all(c.entry.virtual_time for c in self.chosen.values() if c.entry.kind in HARDWARE_KINDS)


def resolve(
    host: PluginHost, document: Document, kind: str, choice: Choice, drop: frozenset[str] = frozenset()
) -> Chosen:
    """Find what a file names and validate the settings given there.

    Args:
        host: The plugins.
        document: The file.
        kind: Kind of plugin that is wanted.
        choice: Name, and place in the file.
        drop: Keys at that place that belong to the core.

    Raises:
        ConfigError: Unknown name, a plugin that failed to load, or wrong settings, with file, line
            and column.
    """
    entry = named(host, document, kind, choice.use, (*choice.loc, choice.key))
    settings = validate(document, entry, choice.loc, drop | {choice.key})
    return Chosen(entry, settings, document, choice.loc)


def named(
    host: PluginHost, document: Document, kind: str, name: str, loc: Loc, *, key: bool = False
) -> Entry:
    """Find the entry that a file names.

    Args:
        host: The plugins.
        document: The file.
        kind: Kind of plugin that is wanted.
        name: Its name.
        loc: Where the name stands in the file.
        key: Whether the name is the key there.

    Raises:
        ConfigError: Nothing offers it, or what would have did not load.
    """
    try:
        return host.get(kind, name)
    except UnknownPluginError as error:
        what = f"unknown {kind.replace('_', ' ')} '{clean(name)}'"
        raise document.error(loc, what, one_of(error.known), error.hint, key) from None
    except PluginLoadError as error:
        raise document.error(loc, str(error), key=key) from None


def validate(
    document: Document, entry: Entry, loc: tuple[str | int, ...], drop: frozenset[str] = frozenset()
) -> Settings | None:
    """Validate the settings of an entry; None if it takes none."""
    also_known = sorted(drop - {"use", "pattern"})
    called = f"{entry.kind.replace('_', ' ')} '{entry.name}'"
    return document.validate(entry.settings_model, loc, drop=drop, also_known=also_known, called=called)


def choose(
    host: PluginHost,
    document: Document,
    kind: str,
    choice: Choice,
    dry_run: DryRun = "off",
) -> tuple[Chosen, str]:
    """Choose the entry that plays a role, in a dry run its simulated counterpart.

    Returns:
        The choice, and a warning for the user or "".
    """
    drop = frozenset(MOTION_KEYS) if kind == "mobile_tweezers" else frozenset[str]()
    if dry_run == "off" or kind not in HARDWARE_KINDS or choice.use == VIRTUAL_TWIN:
        return resolve(host, document, kind, choice, drop), ""
    twin = host.registry.get(kind, VIRTUAL_TWIN)
    if dry_run == "fast":
        return Chosen(twin, _defaults(twin)), ""
    if host.registry.find(kind, choice.use) is None:
        text = f"plugin '{choice.use}' is not installed; its virtual twin takes its place"
        return Chosen(twin, _defaults(twin)), f"{text} and its settings were not checked"
    chosen = resolve(host, document, kind, choice, drop)
    if chosen.entry.virtual_time:
        return chosen, ""
    if chosen.entry.simulated is not None and chosen.settings is not None:
        settings = chosen.settings.model_copy(update=dict(chosen.entry.simulated))
        return replace(chosen, settings=settings), ""
    return Chosen(twin, _defaults(twin)), ""


def construct(
    chosen: Mapping[str, Chosen], grid: SiteGrid, motion: MotionSpec, clock: Clock, seed: int
) -> tuple[dict[str, Any], tuple[RandomStream, ...]]:
    """Construct the object of every role; constructors do no I/O, so nothing is open yet.

    Returns:
        Role -> object, and the random streams that were handed out.

    Raises:
        ConfigError: A constructor refuses its settings; with their place.
        PluginLoadError: A constructor raised, or made no object of that role; names the plugin.
    """
    made: dict[str, Any] = {}
    streams: list[RandomStream] = []
    simulation: Simulation | None = None
    for role in sorted(chosen, key=lambda role: role != "simulation"):  # the world comes first
        stream = RandomStream(seed, "" if role == "simulation" else role)
        streams.append(stream)
        context = Context(role, grid, motion, clock, stream, {}, simulation)
        made[role] = construct_one(chosen[role], context)
        if role == "simulation":
            simulation = made[role]
    return made, tuple(streams)


def construct_one(chosen: Chosen, context: Context) -> Any:
    """Construct the object of one role.

    Raises:
        ConfigError: Its constructor refuses its settings; with their place.
        PluginLoadError: Its constructor raised, or made no object of that role; names the plugin.
    """
    entry = chosen.entry
    try:
        made = entry.factory(chosen.settings, context)
    except (ConfigError, LimitError) as error:
        raise chosen.placed(error) from error
    except LabseqError:
        raise
    except Exception as error:
        text = f"the constructor of {entry.kind} '{entry.name}' raised {type(error).__name__}: {error}"
        raise PluginLoadError(entry.origin, text) from error
    _check_role(entry, made)
    return made


def _check_role(entry: Entry, made: object) -> None:
    """Refuse an object that lacks a method or attribute of its role.

    Raises:
        PluginLoadError: With what is missing.
    """
    role = _ROLES[entry.kind]
    missing = [name for name in dir(role) if not name.startswith("_") and not hasattr(made, name)]
    if missing:
        text = f"{entry.kind} '{entry.name}' has no {', '.join(missing)}; see labseq.{role.__name__}"
        raise PluginLoadError(entry.origin, text)


def check_dry_run(dry_run: object) -> None:
    """Refuse what is no kind of dry run: a wrong word must not open hardware, or fail to.

    Raises:
        ConfigError: It is none.
    """
    if dry_run not in get_args(DryRun):
        raise ConfigError(
            Problem(f"dry_run is {dry_run!r}", expected=f"one of {', '.join(map(repr, get_args(DryRun)))}")
        )


def construct_target(chosen: Chosen, grid: SiteGrid) -> TargetPattern:
    """Make a target of its pattern.

    Raises:
        LabseqError: The pattern refuses, for example because it does not fit on the grid.
        PluginLoadError: The pattern's plugin is at fault; names it.
    """
    entry = chosen.entry
    try:
        target = entry.factory(chosen.settings, grid)
    except LabseqError:
        raise
    except Exception as error:
        text = f"pattern '{entry.name}' raised {type(error).__name__}: {error}"
        raise PluginLoadError(entry.origin, text) from error
    if not isinstance(target, TargetPattern) or target.shape != grid.shape:
        text = f"pattern '{entry.name}' made no TargetPattern of shape {grid.shape}"
        raise PluginLoadError(entry.origin, text)
    return target


def dump(settings: Settings | None) -> dict[str, Any]:
    """Settings for the record, SI, JSON-ready."""
    return {} if settings is None else settings.model_dump(mode="json")


def _defaults(entry: Entry) -> Settings | None:
    return entry.settings_model() if entry.settings_model is not None else None
