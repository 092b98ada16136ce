"""Validates values with a settings model, and gives every mistake its line and column."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path, PurePath
from typing import Any, TypeVar, cast, overload

import numpy as np
from pydantic import TypeAdapter, ValidationError

from labseq.config.yaml_nodes import Mark, Node
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, format_plugin_error, shown
from labseq.settings import (
    FOLDER,
    NEEDS_UNITS,
    NoSettings,
    SettingsType,
    models_at,
    settings_of,
)

M = TypeVar("M")


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem whose place in the file is not known yet.

    Attributes:
        loc: The location, relative to the validated mapping.
        problem: The problem.
        key: Whether the problem is about the key at that location, not about its value.
    """

    loc: Loc
    problem: Problem
    key: bool = False


@dataclass(frozen=True, slots=True)
class ValidationContext:
    """Names and keys of a mapping, for messages.

    Attributes:
        name: Name of the mapping in messages. "" at the top of a file.
        called: Description of the mapping in messages. "" for its name.
        core_keys: Keys that belong to another model and are left out. Messages list them as known.
        folder: Paths in the mapping are relative to this folder.
        needs_units: Whether a quantity needs its unit, as in a file. Otherwise numbers are in SI.
    """

    name: str
    called: str = ""
    core_keys: Collection[str] = ()
    folder: Path = Path()
    needs_units: bool = False

    def known_keys(self, model: SettingsType, loc: Loc) -> list[str]:
        """The keys of the mapping at a location."""
        keys = [setting.key for one in models_at(model, loc) for setting in settings_of(one)]
        if not loc:
            # the key that names the plugin must be right, or its settings would not be validated
            others = sorted({*self.core_keys} - {"use", "pattern"})
            keys = [*(key for key in keys if key not in self.core_keys), *others]
        return list(dict.fromkeys(keys))

    def mapping(self, loc: Loc) -> str:
        """The description of the mapping at a location, for messages."""
        if loc:
            return f"'{self.value(loc)}'"
        return self.called or (f"'{self.name}'" if self.name else "this file")

    def value(self, loc: Loc) -> str:
        """The name of the value at a location, for messages: key and following list indices."""
        last = next((i for i in reversed(range(len(loc))) if isinstance(loc[i], str)), 0)
        return ".".join(map(str, loc[last:])) if loc else self.name


def validate(model: type[M], node: Node, context: ValidationContext) -> M:
    """Validate a mapping with a settings model. An empty value counts as {}.

    Raises:
        ConfigError: All errors in the mapping, in file order.
    """
    result = check(model, node, context)
    if not isinstance(result, list):
        return result
    placed: list[tuple[Mark, Problem]]
    placed = [(node.mark_at(finding.loc, finding.key), finding.problem) for finding in result]
    placed.sort(key=lambda pair: pair[0].order)
    raise ConfigError([mark.problem(p.what, p.expected, p.hint) for mark, p in placed])


def check(model: type[M], node: Node, context: ValidationContext) -> M | list[Finding]:
    """Validate a mapping with a settings model, and return the settings or all errors."""
    data = {} if node.value is None else node.plain()
    if not isinstance(data, dict):
        what = f"{context.name} is {shown(data, node.raw)}"
        return [Finding((), Problem(what, expected="a mapping of settings such as {key: value}"))]
    kept = {key: value for key, value in cast("dict[str, Any]", data).items() if key not in context.core_keys}
    try:
        return _validated(model, json.dumps(kept), {FOLDER: context.folder, NEEDS_UNITS: context.needs_units})
    except ValidationError as error:
        from labseq.config.validation_errors import find_problems  # a right file needs no explanation

        return find_problems(error, model, node, context)
    except Exception as error:  # noqa: BLE001 - a plugin's own validator may raise anything
        reason = format_plugin_error(error)
        return [Finding((), Problem(f"the plugin's check of these settings failed: {reason}"))]


@cache
def _adapter(model: type[M]) -> TypeAdapter[M]:
    return TypeAdapter(model)


def _validated(model: type[M], text: str, context: Mapping[str, Any]) -> M:
    """Validate as JSON. Strict mode then reads no number from a text, but still makes tuples from lists."""
    adapter = _adapter(model)
    try:
        return adapter.validate_json(text, strict=True, context=context, by_alias=True, by_name=False)
    except ValidationError as error:
        # After a validator of the model itself, strict mode requires a tuple from the start.
        if all(is_list_for_tuple(details) for details in error.errors(include_url=False)):
            return adapter.validate_json(text, context=context, by_alias=True, by_name=False)
        raise


def is_list_for_tuple(error: Mapping[str, Any]) -> bool:
    """Whether an error of pydantic only says that JSON has lists where Python has tuples and sets."""
    return error["type"] in ("tuple_type", "set_type", "frozen_set_type") and isinstance(error["input"], list)


@overload
def validate_values(model: type[M], values: Mapping[str, Any], called: str) -> M: ...
@overload
def validate_values(model: None, values: Mapping[str, Any], called: str) -> None: ...
def validate_values(model: type[M] | None, values: Mapping[str, Any], called: str) -> M | None:
    """Validate Python values with a settings model, by the same rules as for a file.

    Args:
        model: The settings model. None for a plugin that takes no settings.
        values: Setting -> value. Numpy's numbers and arrays count as plain ones.
        called: Owner of the settings, for messages, such as "planner 'psca'".

    Raises:
        ConfigError: All errors in the values.
    """
    root = node_of(dict(values), Mark(called))
    settings = validate(model or NoSettings, root, ValidationContext("", "it"))
    return None if model is None else cast("M", settings)


def node_of(value: Any, mark: Mark) -> Node:
    """Convert plain values to nodes with one common place.

    Raises:
        ConfigError: A value cannot occur in a file.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        nodes = {str(key): node_of(inner, mark) for key, inner in cast("Mapping[Any, Any]", value).items()}
        return Node(nodes, mark, dict.fromkeys(nodes, mark))
    if isinstance(value, list | tuple | set | frozenset):
        return Node([node_of(inner, mark) for inner in cast("list[Any]", value)], mark)
    if isinstance(value, Enum):
        return node_of(value.value, mark)
    if isinstance(value, PurePath):
        return Node(str(value), mark)
    if isinstance(value, str) and any("\ud800" <= char <= "\udfff" for char in value):
        raise mark.error(f"'{clean(value)}' contains half a character", "text")
    if value is None or isinstance(value, str | int | float):
        return Node(value, mark)
    kind = type(cast("object", value)).__name__
    expected = "a number, text, list or dict"
    raise mark.error(f"a value of type {kind} is not a setting", expected)
