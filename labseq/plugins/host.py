"""Finds plugins, loads them, and calls their hooks."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import inspect
import os
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Literal, NamedTuple, cast

import pluggy

from labseq import __version__, hookspecs
from labseq.errors import ConfigError, PluginLoadError, Problem, one_of
from labseq.files import PLUGIN_PATH, PLUGINS
from labseq.hookspecs import LABSEQ_API
from labseq.messages import format_error
from labseq.plugins.calls import call_plugin
from labseq.registry import LOAD_S, Entry, Owner, Registry

_MARK: Final = "labseq_impl"  # the attribute that ``hookimpl`` adds to a function
_HOOKS: Final = [key for key, value in vars(hookspecs).items() if hasattr(value, "labseq_spec")]

_BUILT_IN: Final = "built in"
_INSTALLED: Final = "installed"

Hooks = dict[str, Callable[..., object]]


def check_api(module: ModuleType, owner: Owner) -> None:
    """Raise for a plugin that was written for another plugin API version.

    Raises:
        PluginLoadError: The versions differ. The message says what to do.
    """
    written_for: object = getattr(module, "LABSEQ_API", None)
    if type(written_for) is int and written_for == LABSEQ_API:
        return
    this_labseq = f"but this labseq has LABSEQ_API = {LABSEQ_API}"
    if written_for is None:
        remedy = f"write 'LABSEQ_API = {LABSEQ_API}' at its top"
        raise owner.fault(f"it does not state LABSEQ_API; {remedy}")
    fault = f"it was written for LABSEQ_API {written_for!r:.100}"
    if type(written_for) is not int:
        raise owner.fault(f"{fault}, which is not a whole number, {this_labseq}")
    remedy = "update labseq, or take an older version of the plugin"
    if written_for < LABSEQ_API:
        remedy = "take a newer version of the plugin, or adapt it (the changelog says what has changed)"
    raise owner.fault(f"{fault}, {this_labseq}; {remedy}")


def hooks_of(module: ModuleType, owner: Owner) -> Hooks:
    """The hooks that a plugin implements.

    Raises:
        PluginLoadError: It implements no hook, or one with an error. The message says what to change.
    """
    hooks: Hooks = {}
    unmarked: list[str] = []
    for attribute, value in vars(module).items():
        options = getattr(value, _MARK, None)
        if isinstance(options, dict):
            hook_options = cast("dict[str, Any]", options)
            if hook_options.get("wrapper") or hook_options.get("hookwrapper"):
                raise owner.fault(f"its {attribute} is a wrapper; write '@hookimpl' without options")
            hooks[hook_options.get("specname") or attribute] = value
        elif attribute in _HOOKS and inspect.isfunction(value):
            unmarked.append(attribute)
    if not hooks:
        raise owner.fault("it implements no hook; write '@hookimpl' above 'def labseq_register'")
    if unmarked:
        raise owner.fault(f"its {unmarked[0]} would not be called; write '@hookimpl' above it")
    for key, function in hooks.items():
        _check_hook(key, function, owner)
    return hooks


def _check_hook(key: str, function: Callable[..., object], owner: Owner) -> None:
    if key not in _HOOKS:
        raise owner.fault(f"it implements the unknown hook '{key}'; expected {one_of(_HOOKS)}")
    for has_kind, kind in (
        (inspect.iscoroutinefunction, "an 'async' function"),
        (inspect.isgeneratorfunction, "a generator"),
        (inspect.isasyncgenfunction, "a generator"),
    ):
        if has_kind(function):
            raise owner.fault(f"its {key} is {kind} and would never run; expected a plain function")
    hook_arguments = signature(getattr(hookspecs, key)).parameters
    arguments = signature(function).parameters
    if unknown := [argument for argument in arguments if argument not in hook_arguments]:
        raise owner.fault(
            f"its {key} has an argument '{unknown[0]}'; expected {one_of(list(hook_arguments))}"
        )
    if key == "labseq_register" and not arguments:
        raise owner.fault(f"its {key} has no argument; expected {one_of(list(hook_arguments))}")


ENTRY_POINT_GROUP: Final = "labseq"
LOCAL_PACKAGE: Final = "labseq_local"
"""Package of the modules of plugins from folders."""


def plugin_files(folder: Path) -> list[Path]:
    """The modules and the ``__init__.py`` of packages in a folder of plugins.

    Raises:
        OSError: The folder cannot be read.
    """
    named = [path for path in sorted(folder.iterdir()) if not path.name.startswith((".", "_"))]
    files = [path / "__init__.py" if path.is_dir() else path for path in named]
    return [path for path in files if path.suffix == ".py" and path.is_file()]


def plugin_name(path: Path) -> str:
    """Name of the plugin in a file."""
    return path.parent.name if path.name == "__init__.py" else path.stem


def import_file(name: str, path: Path) -> ModuleType:
    """Import a single file, or a package by its ``__init__.py``, as ``labseq_local.<name>``."""
    if LOCAL_PACKAGE not in sys.modules:
        sys.modules[LOCAL_PACKAGE] = ModuleType(LOCAL_PACKAGE)
        sys.modules[LOCAL_PACKAGE].__path__ = []
    full_name = f"{LOCAL_PACKAGE}.{name}"
    path = path.absolute()  # because Python remembers the original location of a relative folder
    inside = [str(path.parent)] if path.name == "__init__.py" else None
    spec = importlib.util.spec_from_file_location(full_name, path, submodule_search_locations=inside)
    if spec is None or spec.loader is None:
        raise PluginLoadError(name, f"{path} is not a Python module")
    forget(name)  # a module from another folder, or of an earlier version of the file
    module = importlib.util.module_from_spec(spec)
    sys.modules[full_name] = module  # before execution, as dataclasses and relative imports need it
    spec.loader.exec_module(module)
    return module


def forget(name: str) -> None:
    """Remove the modules of a folder's plugin, so that they are imported again."""
    full_name = f"{LOCAL_PACKAGE}.{name}"
    for module in [m for m in sys.modules if m == full_name or m.startswith(f"{full_name}.")]:
        del sys.modules[module]


def plugin_location(path: Path) -> Path:
    """The file of a folder's plugin, or the folder of its package."""
    path = path.absolute()
    return path.parent if path.name == "__init__.py" else path


def module_location(name: str) -> Path | None:
    """The folder of an installed package, or its file. None if unknown. Nothing is imported."""
    try:
        spec = importlib.util.find_spec(name.partition(".")[0])
    except (ImportError, ValueError, AttributeError):
        return None
    return None if spec is None or spec.origin is None else plugin_location(Path(spec.origin))


@dataclass(frozen=True, slots=True)
class PluginInfo:
    """A plugin, and whether it was loaded.

    Attributes:
        name: Import name, without the prefix ``labseq_local.`` if the plugin is from a folder.
        origin: "built in", "installed" or its file.
        version: Version of its distribution, or "".
        state: "loaded", "failed", or "not loaded" for a plugin in ``./plugins`` that nothing names.
        reason: Why it failed or was not loaded, or "".
        source: Its file or its distribution, as text. "" for labseq's own plugins.
        notes: Sentences about text that it printed when it was loaded or in a constructor.
    """

    name: str
    origin: str
    version: str = ""
    state: Literal["loaded", "failed", "not loaded"] = "loaded"
    reason: str = ""
    source: str = ""
    notes: list[str] = field(default_factory=list[str])


class UsedPlugin(NamedTuple):
    """A plugin that a run uses.

    Attributes:
        name: Its name, as in :class:`PluginInfo`.
        origin: "built in", "installed" or the absolute path of its file.
        version: Version of its distribution, or "".
        home: File or folder of its code. None if unknown.
        offers: Its parts in use, for example "planner psca" or "step load", or "observer" for its hooks.
    """

    name: str
    origin: str
    version: str
    home: Path | None
    offers: tuple[str, ...]

    @property
    def is_built_in(self) -> bool:
        """Whether the plugin is a part of labseq itself."""
        return self.origin == _BUILT_IN

    @property
    def is_from_folder(self) -> bool:
        """Whether the plugin comes from a folder, so that loading it again imports it again."""
        return self.origin not in (_BUILT_IN, _INSTALLED)


class _HookManager(pluggy.PluginManager):
    """Examines only marked functions for hooks, which is faster than examining a whole module."""

    def parse_hookimpl_opts(self, plugin: object, name: str) -> pluggy.HookimplOpts | None:
        if getattr(vars(plugin).get(name), _MARK, None) is None:
            return None
        return super().parse_hookimpl_opts(plugin, name)


class PluginHost:
    """The plugins of one session, in a separate plugin manager.

    Args:
        max_wait_s: Maximum time for a plugin to load, and for a constructor, in seconds.

    Attributes:
        registry: The planners, drivers, steps, ... of the loaded plugins.
    """

    def __init__(self, max_wait_s: float = LOAD_S) -> None:
        self.registry = Registry(call_plugin)
        self._max_wait_s = max_wait_s
        self._homes: dict[str, Path | None] = {}
        self._pluggy = _HookManager("labseq")
        self._pluggy.add_hookspecs(hookspecs)
        self._infos: dict[str, PluginInfo] = {}

    @property
    def infos(self) -> list[PluginInfo]:
        """All plugins that were found, in the order of loading."""
        return list(self._infos.values())

    @property
    def notes(self) -> list[str]:
        """Sentences about text that the plugins in use printed when they were loaded and constructed."""
        used = {*self.registry.used.values()}
        infos = [info for info in self._infos.values() if info.name in used]
        return [f"plugin '{info.name}' ({info.source}): {note}" for info in infos for note in info.notes]

    def used(self, also: Collection[str] = ()) -> list[UsedPlugin]:
        """The plugins that files name, their base plugins and observers of runs, in the order of loading.

        Args:
            also: Names of further plugins. A base plugin is only known to be used after the plugin that
                builds on it is constructed.
        """
        offers = defaultdict[str, set[str]](set, {name: set[str]() for name in also})
        for (kind, name), origin in self.registry.used.items():
            offers[origin].add(f"{kind} {name}")
        for hook in _HOOKS:
            for implementation in getattr(self._pluggy.hook, hook).get_hookimpls():
                if hook != "labseq_register":
                    offers[implementation.plugin_name].add("observer")
        return [
            UsedPlugin(
                info.name,
                info.origin if info.origin in (_BUILT_IN, _INSTALLED) else str(Path(info.origin).absolute()),
                info.version,
                self._homes.get(info.name),
                tuple(sorted(offers[info.name])),
            )
            for info in self._infos.values()
            if info.name in offers
        ]

    def unused(self) -> list[PluginInfo]:
        """The plugins in ``./plugins`` that were not loaded, because nothing names the folder."""
        with suppress(OSError):
            files = [path for path in plugin_files(Path(PLUGINS)) if self._is_new(path)]
            reason = f"use --plugins {PLUGINS}, or write 'plugin_folders: [{PLUGINS}]' in a file"
            return [
                PluginInfo(plugin_name(path), str(path), "", "not loaded", reason, str(path))
                for path in files
            ]
        return []

    def load_builtin(self, module: ModuleType) -> None:
        """Register a module of labseq itself. Its failure is a bug in labseq and raises."""
        info = PluginInfo(module.__name__, _BUILT_IN, __version__)
        self._run_code(info, None, lambda: module)
        self._infos[info.name] = info

    def load_entry_points(self) -> None:
        """Load every installed plugin. Failures are kept for the report."""
        for point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
            name, version = ("", "") if point.dist is None else name_and_version(point.dist)
            source = f"the distribution {name or 'unknown'} {version}".rstrip()
            info = PluginInfo(point.name, _INSTALLED, version, source=source)
            self._load(info, module_location(point.value.partition(":")[0]), point.load)

    def load_folders(self, folders: Sequence[Path]) -> None:
        """Load files and packages from folders, including --plugins and LABSEQ_PLUGIN_PATH.

        Raises:
            ConfigError: A folder does not exist, or cannot be read.
        """
        from_environment = [Path(p) for p in os.environ.get(PLUGIN_PATH, "").split(os.pathsep) if p]
        for folder in [*folders, *from_environment]:
            origin = "" if folder in folders else f" (from {PLUGIN_PATH})"
            try:
                paths = plugin_files(folder)
            except OSError as error:
                message = f"plugin folder {folder}{origin} cannot be read: {error.strerror}"
                if isinstance(error, FileNotFoundError):
                    message = f"plugin folder {folder}{origin} does not exist"
                raise ConfigError(Problem(message, expected="a folder with plugins")) from error
            for path in paths:
                self._load_path(path)

    def import_all(self) -> None:
        """Import everything that the plugins offer. Failures are kept for the report."""
        for info in self.infos:
            try:
                self.registry.entries(info.name)
            except PluginLoadError as error:
                self.registry.forget(info.name)
                self._infos[info.name] = replace(info, state="failed", reason=error.reason)

    def _load_path(self, path: Path) -> None:
        name = plugin_name(path)
        if not self._is_new(path):
            return
        info = PluginInfo(name, str(path), source=str(path))
        if not name.isidentifier():
            reason = "its name is not a Python name; rename it with only letters, digits and '_'"
            self._infos[name] = replace(info, state="failed", reason=reason)
            return
        self._load(info, plugin_location(path), partial(import_file, name, path))
        if self._infos[name].state == "failed":  # otherwise the modules belong to a working plugin
            forget(name)

    def _load(self, info: PluginInfo, home: Path | None, importing: Callable[[], ModuleType]) -> None:
        """Load a plugin. A failure and its reason are kept for the report."""
        if info.name in self._infos:
            taken = self._infos[info.name]
            other_plugin = f"the plugin in {taken.origin}"
            if taken.origin == _INSTALLED:
                other_plugin = f"an installed plugin (of {taken.source})"
            reason = f"{other_plugin} is already called '{info.name}'; rename one of them"
            info = replace(info, name=f"{info.name} ({info.source})", state="failed", reason=reason)
        else:
            try:
                self._run_code(info, home, importing)
            except PluginLoadError as error:
                info = replace(info, state="failed", reason=error.reason)
            except Exception as error:  # noqa: BLE001 - pluggy refuses a module that has another name already
                info = replace(info, state="failed", reason=format_error(error))
        self._infos[info.name] = info

    def _run_code(self, info: PluginInfo, home: Path | None, importing: Callable[[], ModuleType]) -> None:
        """Import a plugin, check it and let it register its offers. A failing plugin leaves nothing behind.

        Args:
            home: File or folder of its code. None if unknown.
            importing: Imports it.
        """
        self._homes[info.name] = home
        owner = Owner(info.name, info.source, home, self._max_wait_s, info.notes)
        with self.registry.opened_for(owner) as registry:

            def run() -> ModuleType:
                module = importing()
                check_api(module, owner)
                hooks = hooks_of(module, owner)
                if "labseq_register" in hooks:
                    hooks["labseq_register"](registry=registry)
                return module

            # in one guarded call, so that the time limit applies to all of it
            self._pluggy.register(call_plugin(owner, "", run), info.name)

    def _is_new(self, path: Path) -> bool:
        """Whether a file is neither a known plugin nor an installed library."""
        files = {getattr(plugin, "__file__", None) for plugin in self._pluggy.get_plugins()}
        files |= {info.source for info in self._infos.values()}
        resolved = path.resolve()
        if any(file and Path(file).resolve() == resolved for file in files):
            return False
        # modules that Python imports from this folder anyway are libraries, unless they state LABSEQ_API
        is_library = module_location(plugin_name(path)) == plugin_location(path)
        return not is_library or b"LABSEQ_API" in path.read_bytes()

    def get(self, kind: str, name: str, file: Path | None = None) -> Entry:
        """Find the registry entry of a name in a sequence or profile.

        Args:
            file: The file that names it, for messages.

        Raises:
            PluginLoadError: The plugin of that name was found but did not load, or two plugins offer the
                name.
            UnknownPluginError: No plugin offers the name.
        """
        if (kind, name) in self.registry.contested:
            raise self.registry.contested[kind, name]
        entry = self.registry.find(kind, name)
        if entry is None:
            from labseq.plugins.unknown import unknown_plugin  # a right file needs no explanation

            raise unknown_plugin(self, kind, name, file)
        self.registry.used[kind, name] = entry.origin
        return entry

    def listeners(self, hook: str, **values: Any) -> list[tuple[str, Callable[[], object]]]:
        """Name of each plugin that implements an observer hook, and the call of the hook."""
        return [
            (
                implementation.plugin_name,
                partial(implementation.function, **{name: values[name] for name in implementation.argnames}),
            )
            for implementation in getattr(self._pluggy.hook, hook).get_hookimpls()
        ]


def name_and_version(distribution: importlib.metadata.Distribution) -> tuple[str, str]:
    """Name and version of an installed package, or "". Parsing all metadata would take too long."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    head = text.partition("\n\n")[0]
    fields = dict(re.findall(r"^(Name|Version): *(.*?) *$", head, re.MULTILINE))
    return fields.get("Name", ""), fields.get("Version", "")
