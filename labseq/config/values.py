"""Settings given in Python, for example ``make_planner("psca", degree_of_parallelism=7)``."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any, TypeVar, cast, overload

import numpy as np
from pydantic import BaseModel

from labseq.config.nodes import Mark, Node
from labseq.config.settings import NoSettings
from labseq.config.validation import ValidationContext, validate
from labseq.config.wording import clean
from labseq.errors import ConfigError

M = TypeVar("M", bound=BaseModel)


@overload
def validate_values(model: type[M], values: Mapping[str, Any], called: str) -> M: ...
@overload
def validate_values(model: None, values: Mapping[str, Any], called: str) -> None: ...
def validate_values(model: type[M] | None, values: Mapping[str, Any], called: str) -> M | None:
    """Make settings of Python values, by the same rules as those of a file.

    Args:
        model: The settings model; None for what takes no settings.
        values: Setting -> value; numpy's numbers and arrays count as plain ones.
        called: What the settings belong to, for messages: "planner 'psca'".

    Raises:
        ConfigError: Everything that is wrong with them.
    """
    root = node_of(dict(values), Mark(0, 0, called))
    result = validate(model or NoSettings, root, ValidationContext("", "it"))
    if isinstance(result, list):
        raise ConfigError(
            [root.mark.problem("", w.what, w.expected, w.hint) for w in (found.words for found in result)]
        )
    return None if model is None else cast("M", result)


def node_of(value: Any, mark: Mark) -> Node:
    """Plain values as nodes that all stand at one place.

    Raises:
        ConfigError: A value that no file could hold.
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
        raise ConfigError(mark.problem("", f"half of a character stands in '{clean(value)}'", "text"))
    if value is None or isinstance(value, str | int | float):
        return Node(value, mark)
    kind = type(cast("object", value)).__name__
    raise ConfigError(
        mark.problem("", f"a value of type {kind} is no setting", "a number, text, list or dict")
    )
