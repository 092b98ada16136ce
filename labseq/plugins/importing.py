"""From a file to a module, and from an error to the line of the plugin that it came from."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Final

from labseq.errors import PluginLoadError

LOCAL_PACKAGE: Final = "labseq_local"
"""Package in which the plugins of folders are modules."""


def import_file(name: str, path: Path) -> ModuleType:
    """Import a single file, or a package by its ``__init__.py``, as ``labseq_local.<name>``."""
    if LOCAL_PACKAGE not in sys.modules:
        sys.modules[LOCAL_PACKAGE] = ModuleType(LOCAL_PACKAGE)
        sys.modules[LOCAL_PACKAGE].__path__ = []
    full_name = f"{LOCAL_PACKAGE}.{name}"
    inside = [str(path.parent)] if path.name == "__init__.py" else None
    spec = importlib.util.spec_from_file_location(full_name, path, submodule_search_locations=inside)
    if spec is None or spec.loader is None:
        raise PluginLoadError(name, f"{path} is not a Python module")
    forget(name)  # of another folder, or as it was before somebody changed it
    module = importlib.util.module_from_spec(spec)
    sys.modules[full_name] = module  # before execution, as dataclasses and relative imports need it
    spec.loader.exec_module(module)
    return module


def forget(name: str) -> None:
    """Let nobody find the modules of a folder's plugin: they are imported anew."""
    full_name = f"{LOCAL_PACKAGE}.{name}"
    for module in [m for m in sys.modules if m == full_name or m.startswith(f"{full_name}.")]:
        del sys.modules[module]


def plugin_location(path: Path) -> Path:
    """What a folder's plugin consists of: its file, or the folder of its package."""
    path = path.absolute()
    return path.parent if path.name == "__init__.py" else path


def module_location(name: str) -> Path | None:
    """The folder of an installed package, or its file; None if it cannot be told. Nothing is imported."""
    try:
        spec = importlib.util.find_spec(name.partition(".")[0])
    except (ImportError, ValueError, AttributeError):
        return None
    return None if spec is None or spec.origin is None else plugin_location(Path(spec.origin))


def error_location(error: BaseException, home: Path | None) -> str:
    """File and line that an error came from, the plugin's own if it has a part in it; "" if unknown."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno or 1}"
    frames = [frame for one in _chain(error) for frame in traceback.extract_tb(one.__traceback__)]
    own = [f for f in frames if home is not None and home in (Path(f.filename), *Path(f.filename).parents)]
    foreign = [f for f in frames if Path(f.filename).parent != Path(__file__).parent]
    frame = (own or foreign or [None])[-1]
    return "" if frame is None else f"{frame.filename}:{frame.lineno}"


def _chain(error: BaseException) -> list[BaseException]:
    """The error that came first, then those that it led to: the last ones are the one that is told."""
    chain = [error]
    while (cause := chain[0].__cause__ or chain[0].__context__) is not None and cause not in chain:
        chain.insert(0, cause)
    return chain
