"""From a name in a file to a plugin's entry, its settings, and the object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from labseq.config import MOTION_KEYS, Choice, Document
from labseq.config.settings import Settings
from labseq.errors import LabseqError, PluginLoadError, UnknownPluginError, one_of
from labseq.model import MotionSpec, RandomStream, SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.registry import VIRTUAL_TWIN, Entry
from labseq.roles import Clock, Context, Simulation

DryRun = Literal["off", "full", "fast"]

HARDWARE_KINDS: Final = frozenset({"camera", "static_tweezers", "mobile_tweezers", "device"})


@dataclass(frozen=True, slots=True)
class Chosen:
    """A registry entry and the settings it will be constructed with."""

    entry: Entry
    settings: Settings | None

    def dump(self) -> dict[str, Any]:
        """Settings for the record, SI, JSON-ready."""
        return {"use": self.entry.name, **dump(self.settings)}


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
        ConfigError: Unknown name, or wrong settings, with file, line and column.
        PluginLoadError: The plugin failed to load.
    """
    try:
        entry = host.get(kind, choice.use)
    except UnknownPluginError as error:
        loc = (*choice.loc, choice.key)
        what = f"unknown {kind} '{choice.use}'"
        raise document.error(loc, what, one_of(error.known), error.hint) from None
    return Chosen(entry, validate(document, entry, choice.loc, drop | {choice.key}))


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
        return Chosen(chosen.entry, settings), ""
    return Chosen(twin, _defaults(twin)), ""


def construct(
    chosen: Mapping[str, Chosen], grid: SiteGrid, motion: MotionSpec, clock: Clock, seed: int
) -> tuple[dict[str, Any], tuple[RandomStream, ...]]:
    """Construct the object of every role; constructors do no I/O, so nothing is open yet.

    Returns:
        Role -> object, and the random streams that were handed out.

    Raises:
        PluginLoadError: A constructor raised; names the plugin.
    """
    made: dict[str, Any] = {}
    streams: list[RandomStream] = []
    simulation: Simulation | None = None
    for role in sorted(chosen, key=lambda role: role != "simulation"):  # the world comes first
        entry = chosen[role].entry
        stream = RandomStream(seed, "" if role == "simulation" else role)
        streams.append(stream)
        context = Context(role, grid, motion, clock, stream, {}, simulation)
        try:
            made[role] = entry.factory(chosen[role].settings, context)
        except LabseqError:
            raise
        except Exception as error:
            text = f"the constructor of {entry.kind} '{entry.name}' raised {type(error).__name__}: {error}"
            raise PluginLoadError(entry.origin, text) from error
        if role == "simulation":
            simulation = made[role]
    return made, tuple(streams)


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
