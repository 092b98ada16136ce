"""Finds, loads, blocks and reports plugins; fills the registry.

Entry points of the group ``labseq`` come first, then folders. A plugin that
fails to load takes nothing down with it: it is reported, and it is an error only
where a sequence or profile names what it would have offered.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Literal, cast

import pluggy

from labseq import hookspecs
from labseq.errors import ConfigError, PluginLoadError, Problem, UnknownPluginError, one_of
from labseq.hookspecs import LABSEQ_API
from labseq.registry import Entry, Registry

ENTRY_POINT_GROUP: Final = "labseq"
LOCAL_PACKAGE: Final = "labseq_local"
PATH_VARIABLE: Final = "LABSEQ_PLUGIN_PATH"

_MARK: Final = "labseq_impl"  # what ``hookimpl`` puts on a function
_HOOKS: Final = [key for key, value in vars(hookspecs).items() if hasattr(value, "labseq_spec")]


@dataclass(frozen=True, slots=True)
class PluginInfo:
    """What is known of a plugin.

    Attributes:
        name: Import name, for a folder plugin without the ``labseq_local.`` prefix.
        origin: "built in", "installed" or the file it came from.
        version: Version of its distribution, or "".
        state: "loaded" or "failed".
        reason: Why it failed, or "".
    """

    name: str
    origin: str
    version: str = ""
    state: Literal["loaded", "failed"] = "loaded"
    reason: str = ""


class PluginHost:
    """The plugins of one session, with a plugin manager of their own.

    Attributes:
        registry: What the loaded plugins offer.
    """

    def __init__(self) -> None:
        self.registry = Registry()
        self._pluggy = pluggy.PluginManager("labseq")
        self._pluggy.add_hookspecs(hookspecs)
        self._infos: dict[str, PluginInfo] = {}

    @property
    def infos(self) -> list[PluginInfo]:
        """All plugins that were found, in the order of loading."""
        return list(self._infos.values())

    def load_builtin(self, module: ModuleType) -> None:
        """Register a module of labseq itself; its failure is a fault in labseq and raises."""
        info = PluginInfo(module.__name__, "built in", _version("labseq"))
        self._register(module, info)
        self._infos[info.name] = info

    def load_entry_points(self) -> None:
        """Load every installed plugin; each failure is kept for the report."""
        for point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
            version = point.dist.version if point.dist is not None else ""
            info = PluginInfo(point.name, "installed", version)
            try:
                module = point.load()
                self._register(module, info)
            except BaseException as error:  # noqa: BLE001 - a plugin may raise anything
                info = _failed(info, error, None)
            self._infos[info.name] = info

    def load_folders(self, folders: Sequence[Path]) -> None:
        """Load single files and packages from folders, and from LABSEQ_PLUGIN_PATH.

        Raises:
            ConfigError: A folder does not exist, or cannot be read.
        """
        from_environment = [Path(p) for p in os.environ.get(PATH_VARIABLE, "").split(os.pathsep) if p]
        for folder in [*folders, *from_environment]:
            origin = "" if folder in folders else f" (from {PATH_VARIABLE})"
            try:
                paths = sorted(folder.iterdir())
            except OSError as error:
                what = f"plugin folder {folder}{origin} cannot be read: {error.strerror}"
                if isinstance(error, FileNotFoundError):
                    what = f"plugin folder {folder}{origin} does not exist"
                raise ConfigError(Problem(what, expected="a folder with plugins")) from error
            for path in paths:
                self._load_path(path)

    def _load_path(self, path: Path) -> None:
        name = path.stem
        if name.startswith((".", "_")):
            return
        if path.is_dir():
            path = path / "__init__.py"
        if path.suffix != ".py" or not path.is_file() or self._is_loaded(path):
            return
        info = PluginInfo(name, str(path))
        if not name.isidentifier():
            reason = "its name is no Python name: letters, digits and '_' only; rename it"
            info = replace(info, state="failed", reason=reason)
        elif name in self._infos:
            taken = self._infos[name].origin
            where = "an installed plugin" if taken == "installed" else f"the plugin in {taken}"
            reason = f"{where} is called '{name}' already; rename one of them"
            info = replace(info, name=f"{name} ({path})", state="failed", reason=reason)
        else:
            try:
                self._register(_import_file(name, path), info)
            except BaseException as error:  # noqa: BLE001 - a plugin may raise anything
                sys.modules.pop(f"{LOCAL_PACKAGE}.{name}", None)
                info = _failed(info, error, path)
        self._infos[info.name] = info

    def _is_loaded(self, path: Path) -> bool:
        files = (getattr(plugin, "__file__", None) for plugin in self._pluggy.get_plugins())
        return any(file is not None and Path(file).resolve() == path.resolve() for file in files)

    def _register(self, module: ModuleType, info: PluginInfo) -> None:
        written_for = getattr(module, "LABSEQ_API", None)
        if written_for != LABSEQ_API:
            came = (
                "does not state LABSEQ_API"
                if written_for is None
                else f"was written for LABSEQ_API {written_for!r}"
            )
            raise PluginLoadError(info.name, f"it {came}; this labseq has LABSEQ_API = {LABSEQ_API}")
        _check_hooks(module, info.name)
        self._pluggy.register(module, info.name)
        self.registry.set_origin(info.name)
        try:
            self._pluggy.check_pending()
            for implementation in self._pluggy.hook.labseq_register.get_hookimpls():
                if implementation.plugin is module:
                    implementation.function(registry=self.registry)
        except BaseException:
            self._pluggy.unregister(module)
            self.registry.drop_origin(info.name)
            raise

    def get(self, kind: str, name: str) -> Entry:
        """Find what a sequence or profile names.

        Raises:
            PluginLoadError: The plugin of that name was found but did not load, or two plugins
                offer the name.
            UnknownPluginError: Nothing offers it.
        """
        if (kind, name) in self.registry.contested:
            raise self.registry.contested[kind, name]
        if self.registry.find(kind, name) is None:
            broken = [info for info in self._infos.values() if info.state == "failed"]
            for info in broken:
                if info.name.removeprefix("labseq_").split(" ")[0] == name.removeprefix("labseq_"):
                    raise PluginLoadError(info.name, info.reason)
            if broken and kind not in ("step", "pattern"):
                self._raise_with_broken(kind, name, broken)
        return self.registry.get(kind, name)

    def _raise_with_broken(self, kind: str, name: str, broken: Sequence[PluginInfo]) -> None:
        try:
            self.registry.get(kind, name)
        except UnknownPluginError as error:
            reasons = "; ".join(f"plugin '{info.name}' did not load ({info.reason})" for info in broken)
            hint = f"{error.hint}; {reasons}" if error.hint else reasons
            raise UnknownPluginError(kind, name, error.known, hint) from None

    def listeners(self, hook: str, **values: Any) -> list[tuple[str, Callable[[], object]]]:
        """Name of each plugin that implements an observer hook, and the call that tells it."""
        return [
            (found.plugin_name, partial(found.function, **{name: values[name] for name in found.argnames}))
            for found in getattr(self._pluggy.hook, hook).get_hookimpls()
        ]


def _check_hooks(module: ModuleType, name: str) -> None:
    """Refuse a plugin without hooks, and hooks that pluggy would refuse in less plain words.

    Raises:
        PluginLoadError: With what to change.
    """
    implemented: dict[str, Callable[..., object]] = {}
    for attribute, value in vars(module).items():
        options = getattr(value, _MARK, None)
        if isinstance(options, dict):
            implemented[cast("dict[str, Any]", options).get("specname") or attribute] = value
    if not implemented:
        raise PluginLoadError(name, "it implements no hook; write '@hookimpl' above 'def labseq_register'")
    for key, function in implemented.items():
        if key not in _HOOKS:
            raise PluginLoadError(name, f"it implements the unknown hook '{key}'; expected {one_of(_HOOKS)}")
        known = signature(getattr(hookspecs, key)).parameters
        given = signature(function).parameters
        if unknown := [argument for argument in given if argument not in known]:
            text = f"its {key} has an argument '{unknown[0]}'; expected {one_of(list(known))}"
            raise PluginLoadError(name, text)
        if key == "labseq_register" and not given:
            raise PluginLoadError(name, f"its {key} has no argument; expected {one_of(list(known))}")


def _import_file(name: str, path: Path) -> ModuleType:
    if LOCAL_PACKAGE not in sys.modules:
        sys.modules[LOCAL_PACKAGE] = ModuleType(LOCAL_PACKAGE)
        sys.modules[LOCAL_PACKAGE].__path__ = []
    full_name = f"{LOCAL_PACKAGE}.{name}"
    inside = [str(path.parent)] if path.name == "__init__.py" else None
    spec = importlib.util.spec_from_file_location(full_name, path, submodule_search_locations=inside)
    if spec is None or spec.loader is None:
        raise PluginLoadError(name, f"{path} is not a Python module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[full_name] = module  # before execution, as dataclasses and relative imports need it
    spec.loader.exec_module(module)
    return module


def _failed(info: PluginInfo, error: BaseException, path: Path | None) -> PluginInfo:
    if isinstance(error, KeyboardInterrupt):
        raise error
    if isinstance(error, PluginLoadError):
        return replace(info, state="failed", reason=error.reason)
    frames = traceback.extract_tb(error.__traceback__)
    inside = [f for f in frames if path is not None and f.filename == str(path)]
    frame = inside[-1] if inside else (frames[-1] if frames else None)
    where = f" ({frame.filename}:{frame.lineno})" if frame is not None else ""
    text = str(error)
    if isinstance(error, SyntaxError):
        text, where = error.msg, f" ({error.filename or path}:{error.lineno or 1})"
    reason = " ".join(f"{type(error).__name__}: {text}{where}".split())
    return replace(info, state="failed", reason="".join(c if c.isprintable() else "?" for c in reason))


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""
