"""A wrong file with stand-ins for what is wrong, so that the rest of it can be checked as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from pydantic import BaseModel

from labseq.config.collect import ProblemCollector
from labseq.config.document import Document
from labseq.config.nodes import Node
from labseq.config.validation import ValidationContext, validate
from labseq.config.values import node_of
from labseq.errors import ConfigError

M = TypeVar("M", bound=BaseModel)

# Without these, plugins would count as unknown that are not, and a target would meet another grid.
_NEEDED: Final = ("plugin_folders", "profile")


@dataclass(frozen=True, slots=True)
class FallbackValues:
    """What takes the place of wrong values; it must never give rise to errors of its own.

    Attributes:
        values: Every key that a file must have -> a right value.
        items: Key of a list or mapping -> a right item of it.
    """

    values: Mapping[str, Any]
    items: Mapping[str, Any]


def load_checked(
    document: Document, model: type[M], called: str, fallbacks: FallbackValues, found: ProblemCollector | None
) -> tuple[Document, M]:
    """Validate a whole file; gather its problems, if asked to, and go on with stand-ins.

    Args:
        document: The file.
        model: The settings model of the whole file.
        called: What to call it in messages.
        stand_ins: What takes the place of wrong values.
        found: Where the problems go; without it they are raised.

    Raises:
        ConfigError: The file is wrong, and nothing else can be said of it.
    """
    try:
        return document, document.validate(model, called=called)
    except ConfigError as error:
        if found is None:
            raise
        mended = replace_invalid(document, model, fallbacks)
        if any(mended.get((key,)) != document.get((key,)) for key in _NEEDED):
            raise
        spec = mended.validate(model, called=called)
        found.add(error)
        return mended, spec


def replace_invalid(document: Document, model: type[BaseModel], fallbacks: FallbackValues) -> Document:
    """Replace or leave out every top-level value that the model refuses.

    Args:
        document: A wrong file.
        model: The settings model of the whole file.
        stand_ins: What takes the place of wrong values.

    Returns:
        A copy that the model accepts, unless its values do not go together.
    """
    root = document.root
    assert isinstance(root.value, dict)
    right = {key: node_of(value, root.mark) for key, value in fallbacks.values.items()}

    def accepts(key: str, node: Node) -> bool:
        return not isinstance(validate(model, Node({**right, key: node}, root.mark), ValidationContext("")), list)

    def mended_items(key: str, node: Node) -> Node:
        other = node_of(fallbacks.items[key], node.mark)
        if isinstance(node.value, list):
            kept = [item if accepts(key, Node([item], node.mark)) else other for item in node.value]
            return Node(kept, node.mark)
        if isinstance(node.value, dict):
            named = {
                name: item if accepts(key, Node({name: item}, node.mark)) else other
                for name, item in node.value.items()
            }
            return Node(named, node.mark, node.keys)
        return node

    kept: dict[str, Node] = {}
    for key in model.model_fields.keys() & root.value.keys():
        node = root.value[key]
        if not accepts(key, node) and key in fallbacks.items:
            node = mended_items(key, node)
        if accepts(key, node):
            kept[key] = node
    keys = {key: root.keys.get(key, root.mark) for key in {**right, **kept}}
    return Document(document.path, document.name, document.text, Node({**right, **kept}, root.mark, keys))
