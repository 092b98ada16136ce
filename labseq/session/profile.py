"""The profile with its plugins: found by name, settings validated; nothing is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

from labseq import builtin as builtins
from labseq.config.addresses import ROLES, Override
from labseq.config.document import Document, StoredText, plugin_paths
from labseq.config.profile import ProfileSpec, load_profile
from labseq.config.scan import Scan
from labseq.errors import (
    ConfigError,
    LabseqError,
    Loc,
    PluginLoadError,
    Problem,
    ProblemCollector,
    UnknownPluginError,
    one_of,
)
from labseq.messages import clean, did_you_mean
from labseq.model import CalibrationEntry, SiteGrid
from labseq.model.lines import IDLE
from labseq.plugins import PluginHost, call_plugin
from labseq.registry import LOAD_S, VIRTUAL_TWIN, Entry
from labseq.roles import offers
from labseq.sequencer.lab import Lab
from labseq.sequencer.lines import blinding_lines, trigger_line
from labseq.session.calibrations import ActiveCalibrations, calibrated
from labseq.settings import Choice, Settings

DryRun = Literal["off", "full", "fast"]

HARDWARE_KINDS: Final = frozenset({"camera", "static_tweezers", "mobile_tweezers", "device", "lines"})


@dataclass(frozen=True, slots=True)
class ChosenPlugin:
    """A registry entry and the settings it will be constructed with.

    Attributes:
        entry: Entry of the plugin in the registry.
        settings: Its settings; None if it takes none.
        document: The file that chose it; None if no file did.
        loc: Location of its settings in that file.
    """

    entry: Entry
    settings: Settings | None
    document: Document | None = None
    loc: Loc = ()

    @property
    def virtual_time(self) -> bool:
        """Whether the plugin needs no real time: always, or with its present settings."""
        simulated = self.entry.simulated
        if self.entry.virtual_time or simulated is None or self.settings is None:
            return self.entry.virtual_time
        return self.settings.model_copy(update=dict(simulated)) == self.settings

    def dump(self) -> dict[str, Any]:
        """Settings for the record, SI, JSON-ready."""
        return {"use": self.entry.name, **dump(self.entry, self.settings)}

    def placed(self, error: LabseqError) -> LabseqError:
        """An error of its constructor, completed with the file, line and column of its settings."""
        is_placed = isinstance(error, ConfigError) and any(problem.source for problem in error.problems)
        if self.document is None or is_placed:
            return error
        return self.document.error(self.loc, str(error))


@dataclass(frozen=True, slots=True)
class ResolvedProfile:
    """A profile with its plugins chosen, before anything is opened.

    Attributes:
        document: The profile's file.
        profile: Its content.
        host: The plugins.
        grid: The grid of sites, with calibrated tones.
        chosen: Role or device name -> its plugin; without the planner.
        warnings: For the user.
        refused: Role or device name -> why no plugin could be chosen.
        calibrations: The active calibrations: kind -> entry.
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
        """The name of its hardware in the markers of active runs."""
        return str(self.document.path.resolve())

    @property
    def virtual_time(self) -> bool:
        """Whether no device needs real time."""
        return all(c.virtual_time for c in self.chosen.values() if c.entry.kind in HARDWARE_KINDS)


def resolve(host: PluginHost, document: Document, kind: str, choice: Choice) -> ChosenPlugin:
    """Find the plugin named in a file, and validate its settings.

    Args:
        host: The plugins.
        document: The file.
        kind: Kind of plugin.
        choice: Name, and place in the file.

    Raises:
        ConfigError: Unknown name, a plugin that failed to load, or wrong settings, with file, line
            and column.
    """
    entry = named(host, document, kind, choice.use, (*choice.loc, choice.key))
    settings = validate(document, entry, choice.loc, choice.core_keys)
    return ChosenPlugin(entry, settings, document, choice.loc)


def named(
    host: PluginHost, document: Document, kind: str, name: str, loc: Loc, *, key: bool = False
) -> Entry:
    """Find the registry entry of a plugin named in a file.

    Args:
        host: The plugins.
        document: The file.
        kind: Kind of plugin.
        name: Its name.
        loc: Location of the name in the file.
        key: Whether the name is the key there.

    Raises:
        ConfigError: No plugin offers it, or the one that does failed to load.
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
        ConfigError: They are invalid, or the plugin's own validators fail; with their place.
    """
    other_keys = sorted(drop - {"use", "pattern"})
    called = f"{entry.kind.replace('_', ' ')} '{entry.name}'"
    try:
        return call_plugin(
            entry.owner,
            f"the settings model of {called}",
            lambda: document.validate(
                entry.settings_model, loc, drop=drop, other_keys=other_keys, called=called
            ),
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
    """Choose the plugin of a role; in a dry run its simulator, or its virtual twin.

    Returns:
        The choice, and a warning for the user or "".
    """
    if dry_run == "off" or kind not in HARDWARE_KINDS or choice.use == VIRTUAL_TWIN:
        return resolve(host, document, kind, choice), ""
    entry = host.registry.get(kind, VIRTUAL_TWIN)
    twin = ChosenPlugin(entry, _defaults(entry), document, choice.loc)
    if dry_run == "fast":
        return twin, ""
    if absence := _absence(host, kind, choice.use):
        return twin, f"{absence}; its virtual twin takes its place and its settings were not checked"
    chosen = resolve(host, document, kind, choice)
    if chosen.entry.virtual_time:
        return chosen, ""
    if chosen.entry.simulated is not None and chosen.settings is not None:
        settings = chosen.settings.model_copy(update=dict(chosen.entry.simulated))
        return replace(chosen, settings=settings), ""
    return twin, ""


def _absence(host: PluginHost, kind: str, name: str) -> str:
    """The reason why no plugin offers a name (it failed to load, or does not exist); "" if one does."""
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
    """Raise for an unknown kind of dry run, so that a typing error cannot open hardware.

    Raises:
        ConfigError: It is unknown.
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
    return call_plugin(entry.owner, what, lambda: settings.model_dump(mode="json", by_alias=True))


def _defaults(entry: Entry) -> Settings | None:
    return entry.settings_model() if entry.settings_model is not None else None


_LINELESS: Final = frozenset({"device", "check_sites", "check_overlay", "equalise"})
"""Steps during which no line can be on, because they take no time themselves."""


def check_kinds(document: Document, spec: ProfileSpec, host: PluginHost, found: ProblemCollector) -> None:
    """Find lines that are on during unknown steps.

    Args:
        document: The profile's file.
        spec: Its content.
        host: The plugins.
        found: Receives the problems.
    """
    if spec.lines is None:
        return
    known = [IDLE, *(step for step in host.registry.names("step") if step not in _LINELESS)]
    for name, channel in spec.lines.channels.items():
        for place, kind in enumerate(channel.on):
            if kind not in known:
                loc = ("lines", "channels", name, "on", place)
                hint = did_you_mean(kind, known)
                found.add(
                    document.error(loc, f"there is no kind of step '{clean(kind)}'", one_of(known), hint)
                )


def wiring_problems(document: Document, lab: Lab) -> list[Problem]:
    """Lines that the timing box does not have, that would harm the camera, or that cannot trigger it.

    Args:
        document: The profile's file.
        lab: Its devices; none is open.
    """
    problems: list[Problem] = []
    camera = lab.step_context.camera
    if lab.lines is not None and offers(lab.lines, "lines_facts"):
        channels = lab.lines.lines_facts.channels
        for spec in lab.line_specs:
            if spec.channel not in channels:
                loc = ("lines", "channels", spec.name, "channel")
                expected = f"one of {', '.join(map(str, channels))}"
                problems.append(document.problem(loc, f"the box has no channel {spec.channel}", expected))
    if camera.em_gain > 1.0:
        for name in blinding_lines(lab.line_specs, "image"):
            what = f"'{name}' is blinding and on during `image`, with an EM gain of {camera.em_gain:g}"
            loc = ("lines", "channels", name, "on")
            problems.append(document.problem(loc, what, "a line that is off in an exposure"))
    wired = trigger_line(lab.line_specs, "camera")
    if wired is not None and "external" not in camera.triggers:
        what = "the camera takes no external trigger"
        loc = ("lines", "channels", wired.name, "triggers")
        expected = f"a camera that does; this one takes {one_of(camera.triggers)}"
        problems.append(document.problem(loc, what, expected))
    return problems


def refuse_wrong_wiring(document: Document, lab: Lab) -> None:
    """Raise the problems found by :func:`wiring_problems`.

    Raises:
        ConfigError: There is at least one problem.
    """
    problems = wiring_problems(document, lab)
    if problems:
        raise ConfigError(problems)


class RecordedSetup(NamedTuple):
    """The profile and calibrations that a run began with, for resuming it.

    Attributes:
        profile: The text of the profile.
        calibrations: Kind -> id of the calibrations; no others are active.
    """

    profile: StoredText
    calibrations: Mapping[str, str]


def resolve_profile(
    profile: str | Path,
    beside: Path = Path(),
    overrides: Sequence[Override] = (),
    dry_run: DryRun = "off",
    *,
    named_in: Document | None = None,
    plugin_folders: Sequence[Path] = (),
    scan: Scan | None = None,
    found: ProblemCollector | None = None,
    again: RecordedSetup | None = None,
) -> ResolvedProfile:
    """Read a profile, load the plugins and choose the plugin of each role.

    Args:
        profile: Name or path of the profile.
        beside: Folder of the file that names it.
        overrides: Values that replace those in the file.
        dry_run: "off", "full" or "fast".
        named_in: The sequence that names the profile, for messages.
        plugin_folders: Further folders with plugins.
        scan: The sequence's scan; the profile receives the values of its first point.
        found: Receives the problems of a readable profile; without it they are raised.
        again: The profile's text and calibrations, if a run is resumed.

    Raises:
        ConfigError: The profile has an error.
        PluginLoadError: A plugin that it names failed to load.
    """
    document, spec = load_profile(
        profile,
        beside=beside,
        overrides=overrides,
        named_in=named_in,
        scan=scan,
        found=found,
        kept=None if again is None else again.profile,
    )
    folders = [*plugin_paths(document, spec.plugin_folders), *plugin_folders]
    host = load_plugins(folders, max_wait_s=spec.timeouts.load)
    problems = ProblemCollector() if found is None else found
    pins = None if again is None else again.calibrations
    bench = choose_plugins(document, spec, host, dry_run, problems, pins)
    if found is None:
        problems.raise_any()
    return bench


def choose_plugins(
    document: Document,
    spec: ProfileSpec,
    host: PluginHost,
    dry_run: DryRun,
    found: ProblemCollector,
    calibrations: Mapping[str, str] | None = None,
) -> ResolvedProfile:
    """Choose the plugin of each role of a profile.

    Args:
        document: The profile's file.
        spec: Its content, with fallbacks for wrong values.
        host: The plugins.
        dry_run: "off", "full" or "fast".
        found: Receives the problems.
        calibrations: Kind -> id of the active ones; None for those chosen by profile and store.
    """
    repaired = bool(found.problems)
    chosen: dict[str, ChosenPlugin] = {}
    warnings: list[str] = []
    refused: dict[str, ConfigError] = {}
    for role, choice in {**spec.choices, **spec.devices}.items():
        kind = role if role in ROLES else "device"
        if repaired and _is_fallback(document, choice):
            refused[role] = ConfigError("what the profile says of it is wrong")
            continue
        try:
            chosen[role], warning = choose(host, document, kind, choice, dry_run)
            warnings += [f"{role}: {warning}"] if warning else []
        except ConfigError as error:
            refused[role] = error
            found.add(error)
    check_kinds(document, spec, host, found)
    detector = chosen["detector"].dump() if "detector" in chosen else {}
    made = (
        ActiveCalibrations({}, spec.grid_model())
        if repaired
        else calibrated(document, spec, found, dry_run, detector, calibrations)
    )
    warnings += made.warnings
    return ResolvedProfile(document, spec, host, made.grid, chosen, tuple(warnings), refused, made.entries)


def _is_fallback(document: Document, choice: Choice) -> bool:
    """Whether a choice replaces an invalid value; it then has the place of its parent in the file."""
    here, around = document.locate(choice.loc), document.locate(choice.loc[:-1])
    return choice.use == VIRTUAL_TWIN and here == around


def load_plugins(
    folders: Sequence[Path] = (), found: ProblemCollector | None = None, max_wait_s: float = LOAD_S
) -> PluginHost:
    """Load labseq's own, the installed and the folders' plugins.

    Args:
        folders: Folders with plugins, in addition to those of LABSEQ_PLUGIN_PATH.
        found: Receives the problem of an unreadable folder; without it, it is raised.
        max_wait_s: Maximum time for a plugin to load, and for a constructor, in seconds.

    Raises:
        ConfigError: A folder does not exist, or cannot be read.
    """
    host = PluginHost(max_wait_s)
    host.load_builtin(builtins)
    host.load_entry_points()
    try:
        host.load_folders(folders)
    except ConfigError as error:
        if found is None:
            raise
        found.add(error)
    return host
