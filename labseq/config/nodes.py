"""The tree of values of a YAML file, each with its place in the text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

from labseq.config.wording import visible
from labseq.errors import Problem

Loc: TypeAlias = tuple[str | int, ...]
"""Where a value is in a document: keys and list indices from the top, ("shot", 2, "rearrange")."""

Scalar: TypeAlias = str | int | float | bool | None

MAX_VALUES: Final = 10_000
"""Most values (scalars, lists and mappings, aliases written out) in one document."""

MAX_DEPTH: Final = 32
"""Deepest nesting of lists and mappings."""


class Mark(NamedTuple):
    """A place: line and column from 1, or an option such as ``--set shots=5``.

    With both, ``origin`` is the file of a value that was put into another one.
    """

    line: int
    column: int
    origin: str = ""

    def problem(self, name: str, what: str, expected: str = "", hint: str = "") -> Problem:
        """Say that something is wrong here, in the file called ``name`` or in the origin.

        What cannot be seen becomes visible: validators, those of plugins too, quote values as they are.
        """
        what, expected, hint = visible(what), visible(expected), visible(hint)
        if self.origin:
            return Problem(what, self.origin, self.line, self.column, expected, hint)
        return Problem(what, name, self.line, self.column, expected, hint)

    @property
    def order(self) -> tuple[bool, int, int]:
        """Sorting key: file order, then what came from options."""
        return bool(self.origin), self.line, self.column


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One value.

    Attributes:
        value: A scalar, or the nodes of a list or mapping.
        mark: Where the value begins.
        keys: Where each key of a mapping begins.
        raw: An unquoted scalar as it is written; "" for everything else.
        size: Number of values in it, itself included, aliases written out.
        height: Levels of lists and mappings in it.
    """

    value: Scalar | list[Node] | dict[str, Node]
    mark: Mark
    keys: Mapping[str, Mark] = field(default_factory=dict[str, Mark])
    raw: str = ""
    size: int = 1
    height: int = 0

    def plain(self) -> Any:
        """The value as plain dicts, lists and scalars."""
        if isinstance(self.value, dict):
            return {key: child.plain() for key, child in self.value.items()}
        if isinstance(self.value, list):
            return [child.plain() for child in self.value]
        return self.value

    def child(self, step: str | int) -> Node | None:
        """The value of a key, or of a list index; None if there is none."""
        if isinstance(self.value, dict):
            return self.value.get(step) if isinstance(step, str) else None
        if isinstance(self.value, list) and isinstance(step, int) and 0 <= step < len(self.value):
            return self.value[step]
        return None

    def at(self, loc: Loc) -> Node | None:
        """The node at a location; None if there is none."""
        node: Node | None = self
        for step in loc:
            node = node.child(step) if node is not None else None
        return node

    def mark_at(self, loc: Loc, key: bool = False) -> Mark:
        """Where the value at ``loc`` (or its key) begins; where it is missing, its nearest parent."""
        node = self
        for i, step in enumerate(loc):
            child = node.child(step)
            if child is None:
                break
            if key and i == len(loc) - 1 and isinstance(step, str):
                return node.keys[step]
            node = child
        return node.mark

    def replaced(self, loc: Loc, new: Node) -> Node:
        """A copy with the value at ``loc`` replaced, or added to a mapping.

        The parents must exist; an empty parent becomes a mapping.
        """
        if not loc:
            return new
        step, rest = loc[0], loc[1:]
        child = self.child(step)
        inner = (child or Node({}, new.mark)).replaced(rest, new)
        if isinstance(step, int):
            items = list(self.value) if isinstance(self.value, list) else []
            items[step] = inner
            return Node(items, self.mark)
        values = dict(self.value) if isinstance(self.value, dict) else {}
        values[step] = inner
        # An option that replaces a whole value, or adds one, is where its key comes from too.
        keys = dict(self.keys) if rest and child is not None else {**self.keys, step: new.mark}
        return Node(values, self.mark, keys)
