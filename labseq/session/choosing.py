"""From a name in a file to a plugin's entry, its settings, and the object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, get_args

from labseq.config import DEVICE_KEYS, LINES_KEYS, MOTION_KEYS, Choice, Document, Loc, ProfileSpec
from labseq.config.settings import Settings
from labseq.config.wording import clean
from labseq.errors import (
    ConfigError,
    LabseqError,
    PluginLoadError,
    Problem,
    UnknownPluginError,
    one_of,
)
from labseq.model import CalibrationEntry, SiteGrid
from labseq.plugins import PluginHost, contained
from labseq.registry import VIRTUAL_TWIN, Entry

DryRun = Literal["off", "full", "fast"]

_CORE_KEYS: Final = {
    "mobile_tweezers": frozenset(MOTION_KEYS),
    "device": frozenset(DEVICE_KEYS),
    "lines": frozenset(LINES_KEYS),
}
"""Keys that stand beside a plugin's own, and belong to the core."""

HARDWARE_KINDS: Final = frozenset({"camera", "static_tweezers", "mobile_tweezers", "device", "lines"})


@dataclass(frozen=True, slots=True)
class ChosenPlugin:
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

    @property
    def virtual_time(self) -> bool:
        """Whether it keeps to the session's clock only: always, or with the settings of a dry run."""
        simulated = self.entry.simulated
        if self.entry.virtual_time or simulated is None or self.settings is None:
            return self.entry.virtual_time
        return self.settings.model_copy(update=dict(simulated)) == self.settings

    def dump(self) -> dict[str, Any]:
        """Settings for the record, SI, JSON-ready."""
        return {"use": self.entry.name, **dump(self.entry, self.settings)}

    def placed(self, error: LabseqError) -> LabseqError:
        """Why it cannot be constructed, with the place that its settings stand in."""
        is_placed = isinstance(error, ConfigError) and any(problem.source for problem in error.problems)
        if self.document is None or is_placed:
            return error
        return self.document.error(self.loc, str(error))


@dataclass(frozen=True, slots=True)
class ResolvedProfile:
    """A profile with its plugins chosen, before anything is opened.

    Attributes:
        document: The profile's file.
        profile: What it says.
        host: The plugins.
        grid: The grid of sites, with calibrated tones.
        chosen: Role or device name -> what plays it; no planner.
        warnings: What the user should know although it is no error.
        refused: Role or device name -> why nothing could be chosen.
        calibrations: Those in use: kind -> entry.
    """

    document: Document
    profile: ProfileSpec
    host: PluginHost
    grid: SiteGrid
    chosen: Mapping[str, ChosenPlugin]
    warnings: tuple[str, ...]
    refused: Mapping[str, ConfigError] = field(default_factory=dict[str, ConfigError])
    calibrations: Mapping[str, CalibrationEntry] = field(default_factory=dict[str, CalibrationEntry])

    @property
    def hardware_key(self) -> str:
        """What its hardware is known by in the markers of runs."""
        return str(self.document.path.resolve())

    @property
    def virtual_time(self) -> bool:
        """Whether no device needs real time."""
        return all(c.virtual_time for c in self.chosen.values() if c.entry.kind in HARDWARE_KINDS)


def resolve(
    host: PluginHost, document: Document, kind: str, choice: Choice, drop: frozenset[str] = frozenset()
) -> ChosenPlugin:
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
    return ChosenPlugin(entry, settings, document, choice.loc)


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
    """Validate the settings of an entry; None if it takes none.

    Raises:
        ConfigError: They are wrong, or the plugin's own validators fail; with their place.
    """
    other_keys = sorted(drop - {"use", "pattern"})
    called = f"{entry.kind.replace('_', ' ')} '{entry.name}'"
    try:
        return contained(
            entry.owner,
            f"the settings model of {called}",
            lambda: document.validate(
                entry.settings_model, loc, drop=drop, other_keys=other_keys, called=called
            ),
            watch=False,
        )
    except PluginLoadError as error:
        raise document.error(loc, str(error)) from error


def choose(
    host: PluginHost,
    document: Document,
    kind: str,
    choice: Choice,
    dry_run: DryRun = "off",
) -> tuple[ChosenPlugin, str]:
    """Choose the entry that plays a role, in a dry run its simulated counterpart.

    Returns:
        The choice, and a warning for the user or "".
    """
    drop = _CORE_KEYS.get(kind, frozenset[str]())
    if dry_run == "off" or kind not in HARDWARE_KINDS or choice.use == VIRTUAL_TWIN:
        return resolve(host, document, kind, choice, drop), ""
    entry = host.registry.get(kind, VIRTUAL_TWIN)
    twin = ChosenPlugin(entry, _defaults(entry), document, choice.loc)
    if dry_run == "fast":
        return twin, ""
    if absence := _absence(host, kind, choice.use):
        return twin, f"{absence}; its virtual twin takes its place and its settings were not checked"
    chosen = resolve(host, document, kind, choice, drop)
    if chosen.entry.virtual_time:
        return chosen, ""
    if chosen.entry.simulated is not None and chosen.settings is not None:
        settings = chosen.settings.model_copy(update=dict(chosen.entry.simulated))
        return replace(chosen, settings=settings), ""
    return twin, ""


def _absence(host: PluginHost, kind: str, name: str) -> str:
    """Why nothing offers a name: its plugin did not load, or there is none; "" if something does."""
    if host.registry.find(kind, name) is not None:
        return ""
    try:
        host.get(kind, name)
    except PluginLoadError as error:
        return str(error)
    except UnknownPluginError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return f"plugin '{clean(name)}' is not installed{hint}"
    return ""


def check_dry_run(dry_run: object) -> None:
    """Refuse what is no kind of dry run: a wrong word must not open hardware, or fail to.

    Raises:
        ConfigError: It is none.
    """
    if dry_run not in get_args(DryRun):
        raise ConfigError(
            Problem(f"dry_run is {dry_run!r}", expected=f"one of {', '.join(map(repr, get_args(DryRun)))}")
        )


def dump(entry: Entry, settings: Settings | None) -> dict[str, Any]:
    """Settings for the record, SI, JSON-ready.

    Raises:
        PluginLoadError: The plugin's own serializers fail.
    """
    if settings is None:
        return {}
    what = f"the settings of {entry.kind} '{entry.name}'"
    return contained(entry.owner, what, lambda: settings.model_dump(mode="json", by_alias=True), watch=False)


def _defaults(entry: Entry) -> Settings | None:
    return entry.settings_model() if entry.settings_model is not None else None
