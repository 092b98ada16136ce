"""Finds the plugins that a file names, validates their settings and constructs their objects."""

from __future__ import annotations

from abc import ABC
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from labseq import builtin as builtins
from labseq.config import addresses
from labseq.config.document import Document
from labseq.errors import (
    ConfigError,
    LabseqError,
    LimitError,
    Loc,
    PluginLoadError,
    UnknownPluginError,
    one_of,
)
from labseq.messages import clean
from labseq.model import ScanSpace, SiteGrid, TargetPattern
from labseq.plugins.calls import call_plugin
from labseq.plugins.host import PluginHost
from labseq.registry import LOAD_S, Entry
from labseq.roles import Context, Step
from labseq.settings import Choice, NoSettings, Settings, settings_of

if TYPE_CHECKING:
    from labseq.assembly.profile import ResolvedProfile
    from labseq.config.sequence import StepSpec

T = TypeVar("T")


@dataclass(frozen=True)
class ChosenPlugin:
    """A registry entry with the settings for its constructor.

    Attributes:
        entry: Entry of the plugin in the registry.
        settings: Its settings. None if it takes none.
        document: The file that chose it. None if no file did.
        loc: Location of its settings in that file.
        by_line: Whether a line of the profile triggers it, whatever its setting ``trigger`` says.
    """

    entry: Entry
    settings: Settings | None
    document: Document | None = None
    loc: Loc = ()
    by_line: bool = False

    @cached_property
    def virtual_time(self) -> bool:
        """Whether the plugin needs no real time, at least with its present settings."""
        simulated = self.entry.simulated
        if self.entry.virtual_time or simulated is None or self.settings is None:
            return self.entry.virtual_time
        # the profile itself may contain a setting that simulates the device
        update = {key: value for key, value in simulated.items() if key != "trigger" or not self.by_line}
        return self.settings.model_copy(update=update) == self.settings

    def identities(self, role: str) -> tuple[str, ...]:
        """Names of hardware of a role that only one process can use, or () if all is simulated."""
        if self.virtual_time:
            return ()
        identities = None
        with suppress(Exception):  # of the plugin
            identities = None if self.settings is None else self.settings.identities()
        if identities is not None:
            return tuple(map(str, identities))
        # if a driver does not say which device it uses, the profile allows one run at a time
        return (f"{role} of {'' if self.document is None else self.document.path.resolve()}",)

    def dump(self) -> dict[str, Any]:
        """Settings for the record, SI, JSON-ready."""
        return {"use": self.entry.name, **dump(self.entry, self.settings)}

    def placed(self, error: LabseqError) -> LabseqError:
        """An error of its constructor, completed with the file, line and column of its settings."""
        is_placed = isinstance(error, ConfigError) and any(problem.source for problem in error.problems)
        if self.document is None or is_placed:
            return error
        within = error.setting if isinstance(error, LimitError) else ()
        return self.document.error((*self.loc, *within), str(error))


class Configured(NamedTuple, Generic[T]):
    """A planner or step, and its settings after defaults, SI, JSON-ready."""

    plugin: T
    dump: Mapping[str, Any]


def resolve(host: PluginHost, document: Document, kind: str, choice: Choice) -> ChosenPlugin:
    """Find the plugin named in a file, and validate its settings.

    Raises:
        ConfigError: The name is unknown, the plugin failed to load, or its settings are wrong. The error has
            file, line and column.
    """
    loc = choice.loc
    entry = find_entry(host, document, kind, choice.use, (*loc, choice.key))
    try:
        settings = read_settings(document, entry, loc, choice.core_keys)
    except ConfigError as error:
        raise _with_advice(error, document, choice) from None
    return ChosenPlugin(entry, settings, document, loc)


def _with_advice(error: ConfigError, document: Document, choice: Choice) -> ConfigError:
    """Explain how to drop settings of another plugin in the file, if an option chose this plugin."""
    if document.root.mark_at((*choice.loc, choice.key)).line:
        return error
    prefix = addresses.PROFILE if choice.loc[0] in (*addresses.PROFILE_ROLES, *addresses.NAMED) else ""
    address = prefix + ".".join(map(str, choice.loc))
    hint = f'to drop the settings of another plugin, use --set "{address}={{{choice.key}: {choice.use}}}"'
    return ConfigError(
        [
            replace(problem, hint="; ".join(filter(None, [problem.hint, hint]))) if problem.line else problem
            for problem in error.problems
        ]
    )


def find_entry(
    host: PluginHost, document: Document, kind: str, name: str, loc: Loc, *, key: bool = False
) -> Entry:
    """Find the registry entry of a plugin named in a file.

    Args:
        key: Whether the name is the key at ``loc``.

    Raises:
        ConfigError: No plugin offers the name, or its plugin failed to load.
    """
    try:
        return host.get(kind, name, document.path)
    except UnknownPluginError as error:
        what = f"unknown {kind.replace('_', ' ')} '{clean(name)}'"
        raise document.error(loc, what, one_of(error.known), error.hint, key) from None
    except PluginLoadError as error:
        raise document.error(loc, str(error), key=key) from None


def read_settings(
    document: Document, entry: Entry, loc: Loc, core_keys: Collection[str] = ()
) -> Settings | None:
    """The validated settings of an entry, or None if it takes none.

    Args:
        core_keys: Keys of the mapping that labseq reads itself.

    Raises:
        ConfigError: They are invalid, or the plugin's own validators fail. The error has their place.
    """
    called = f"{entry.kind.replace('_', ' ')} '{entry.name}'"
    try:
        settings = call_plugin(
            entry.owner,
            f"the settings model of {called}",
            lambda: document.validate(
                entry.settings_model or NoSettings, loc, core_keys=core_keys, called=called
            ),
        )
    except PluginLoadError as error:
        raise document.error(loc, str(error)) from error
    return None if entry.settings_model is None else settings


def dump(entry: Entry, settings: Settings | None) -> dict[str, Any]:
    """Settings for the record, SI, JSON-ready.

    Raises:
        PluginLoadError: The plugin's own serializers fail.
    """
    if settings is None:
        return {}
    what = f"the settings of {entry.kind} '{entry.name}'"
    return call_plugin(entry.owner, what, lambda: settings.model_dump(mode="json"))


def changed_settings(settings: Settings | None) -> dict[str, Any]:
    """The settings that differ from the defaults, SI, JSON-ready."""
    return {} if settings is None else settings.model_dump(mode="json", exclude_defaults=True)


def load_plugins(folders: Sequence[Path] = (), max_wait_s: float = LOAD_S) -> PluginHost:
    """Load labseq's own plugins, installed plugins and plugins from folders, for every command.

    Args:
        folders: The folders from profile and sequence. --plugins and LABSEQ_PLUGIN_PATH are added.
        max_wait_s: Maximum time for a plugin to load, and for a constructor, in seconds.

    Raises:
        ConfigError: A folder does not exist, or cannot be read.
    """
    host = PluginHost(max_wait_s)
    host.load_builtin(builtins)
    host.load_entry_points()
    host.load_folders(folders)
    return host


def construct_one(chosen: ChosenPlugin, context: Context | ScanSpace) -> Any:
    """Construct the object of one role. A scanner receives its ranges.

    Raises:
        ConfigError: The constructor refuses its settings, raised, or made no object of that role. The error
            has the place of the settings and the name of the plugin.
    """
    try:
        return construct_role(chosen.entry, chosen.settings, context)
    except (ConfigError, LimitError, PluginLoadError) as error:
        raise chosen.placed(error) from error


def construct_role(entry: Entry, *arguments: Any) -> Any:
    """Call a factory, and check that its object has the methods of its role.

    Args:
        entry: The entry with the factory.
        *arguments: The factory's arguments.

    Raises:
        LabseqError: The factory raised this error.
        PluginLoadError: It raised another error, did not return in time, or made no object of that role.
    """

    def make() -> Any:
        instance = entry.factory(*arguments)
        check_role(entry, instance)  # in the guarded call, because attributes of a plugin may raise
        return instance

    return call_plugin(entry.owner, f"the constructor of {entry.kind} '{entry.name}'", make)


def construct_target(chosen: ChosenPlugin, grid: SiteGrid) -> TargetPattern:
    """Make a target from its pattern.

    Raises:
        LabseqError: The pattern refuses, for example because it does not fit on the grid.
        PluginLoadError: The pattern's plugin failed. The message names it.
    """
    entry = chosen.entry
    target = call_plugin(entry.owner, f"pattern '{entry.name}'", lambda: entry.factory(chosen.settings, grid))
    if not isinstance(target, TargetPattern) or target.shape != grid.shape:
        came = "" if isinstance(target, TargetPattern) else f", but {_called(target)}"
        raise entry.owner.fault(f"pattern '{entry.name}' made no TargetPattern of shape {grid.shape}{came}")
    return target


def make_step(hardware: ResolvedProfile, document: Document, spec: StepSpec) -> Configured[Step]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, its settings are invalid, or the profile lacks its device. The error
            has their place.
    """
    entry = find_entry(hardware.host, document, "step", spec.kind, spec.loc, key=True)
    _check_indentation(document, spec, entry)
    settings = read_settings(document, entry, spec.loc)
    try:
        step, dumped = construct_role(entry, settings), dump(entry, settings)
    except (ConfigError, PluginLoadError) as error:
        raise document.error(spec.loc, str(error)) from error
    if step.device_setting and (name := getattr(settings, step.device_setting, None)) is not None:
        _check_device(hardware, document, spec, step, name)
    return Configured(step, dumped)


def _check_indentation(document: Document, spec: StepSpec, entry: Entry) -> None:
    """Raise for keys of the list item that are indented like settings of the step."""
    settings = {setting.key for setting in settings_of(entry.settings_model)}
    for key in ("name", "policy"):
        if key not in settings and document.root.at((*spec.loc, key)) is not None:
            what = f"'{key}' is in the settings of '{spec.kind}'"
            hint = f"write '{key}' on a separate line below"
            raise document.error((*spec.loc, key), what, f"'{key}' next to '{spec.kind}'", hint, key=True)


def _check_device(
    hardware: ResolvedProfile, document: Document, spec: StepSpec, step: Step, name: str
) -> None:
    """Raise if the profile lacks the device that a step names, or if the step cannot use it."""
    devices = hardware.profile.devices
    if step.device_may_be_camera:
        known = ["camera", *devices]
    else:
        known = [device for device, choice in devices.items() if choice.role == "device"]
    if name in known:
        return
    what = f"the profile '{hardware.profile.name}' has no device '{name}'"
    if name in devices:
        what = f"'{name}' is a camera, which '{spec.kind}' cannot use"
    problem = document.problem((*spec.loc, step.device_setting), what, one_of(sorted(known)))
    raise ConfigError(replace(problem, notes=(place_note(hardware.document, "devices"),)))


def place_note(document: Document, key: str) -> str:
    """A note for a problem, with the place of a key in another file."""
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"


def check_role(entry: Entry, instance: object) -> None:
    """Raise if an object lacks the base class or methods of its role. Later calls do not check again.

    Raises:
        PluginLoadError: It is not of the role's base class, or lacks a method.
    """
    base = entry.role.base
    called, see = f"{entry.kind} '{entry.name}'", f"see labseq.plugin.{base.__name__}"
    if instance is None or isinstance(instance, type):
        raise entry.owner.fault(
            f"the factory of {called} made {_called(instance)} instead of an object; {see}"
        )
    if issubclass(base, ABC):
        if not isinstance(instance, base):
            text = (
                f"the factory of {called} made {_called(instance)}, which is not derived from {base.__name__}"
            )
            raise entry.owner.fault(f"{text}; {see}")
        return
    # a Protocol, because planners and others without state need no base class, only the method
    methods = [name for name in vars(base) if not name.startswith("_")]
    if missing := [name for name in methods if not callable(getattr(instance, name, None))]:
        raise entry.owner.fault(f"{called} has no method {', '.join(missing)}; {see}")


def _called(instance: object) -> str:
    if instance is None:
        return "None"
    return (
        f"the class {instance.__name__} itself"
        if isinstance(instance, type)
        else f"a {type(instance).__name__}"
    )
