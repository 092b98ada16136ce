"""What there is to document: files, and what labseq and its own plugins register."""

from __future__ import annotations

import functools
import importlib
import tomllib
from pathlib import Path
from typing import Final

from pydantic import BaseModel

from labseq import builtin as builtins
from labseq.config.profile import ProfileSpec
from labseq.config.sequence import SequenceSpec, StepPolicySettings
from labseq.config.validation import keys_of, models_at
from labseq.errors import UnknownPluginError
from labseq.plugins import ENTRY_POINT_GROUP, PluginHost
from labseq.registry import KINDS, Entry

FILES: Final = {"sequence": SequenceSpec, "profile": ProfileSpec}
"""Kind of file -> its model."""
PARTS: Final = {"step_policy": StepPolicySettings}
"""What stands in files beside what plugins read -> its model."""

_PROJECT: Final = Path(__file__).resolve().parents[3] / "pyproject.toml"


class UnknownNameError(LookupError):
    """The page names something that does not exist."""


@functools.cache
def host() -> PluginHost:
    """labseq's own plugins, loaded: not what happens to be installed beside them."""
    found = PluginHost()
    found.load_builtin(builtins)
    points = tomllib.loads(_PROJECT.read_text())["project"]["entry-points"][ENTRY_POINT_GROUP]
    for module in points.values():
        found.load_builtin(importlib.import_module(module))
    return found


def entries(kind: str) -> list[Entry]:
    """Everything that is registered for a role, by name.

    Raises:
        UnknownNameError: There is no such role.
    """
    if kind not in KINDS:
        raise UnknownNameError(f"'{kind}' is not one of {', '.join(KINDS)}")
    return [entry for entry in host().registry.entries() if entry.kind == kind]


def entry_of(kind: str, name: str) -> Entry:
    """Find what is registered.

    Raises:
        UnknownNameError: Nothing is.
    """
    if kind not in KINDS:
        raise UnknownNameError(f"'{kind}' is not one of {', '.join((*FILES, *KINDS))}")
    try:
        return host().registry.get(kind, name)
    except UnknownPluginError as error:
        raise UnknownNameError(str(error)) from None


def settings_of(kind: str, *names: str) -> type[BaseModel] | None:
    """The settings model of ``pattern kagome``, ``profile`` or ``profile grid``; None for none.

    Raises:
        UnknownNameError: There is no such thing.
    """
    if kind in PARTS:
        return PARTS[kind]
    if kind not in FILES:
        return entry_of(kind, *names).settings_model
    models: list[type[BaseModel]] = [FILES[kind]]
    for i, name in enumerate(names):
        if name not in keys_of(models):
            raise UnknownNameError(f"'{name}' is not one of {', '.join(keys_of(models))}")
        models = models_at(FILES[kind], names[: i + 1])
    if len(models) != 1:
        raise UnknownNameError(f"'{' '.join((kind, *names))}' has no keys of its own")
    return models[0]
