"""YAML text to a tree of nodes, strictly.

PyYAML's reader, scanner and parser give events; the tree is made here. There is
no constructor, so no tag can run code, and the limits hold before anything grows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final, cast

from yaml.error import MarkedYAMLError
from yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    StreamEndEvent,
)
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.scanner import Scanner

from labseq.config.nodes import MAX_DEPTH, MAX_VALUES, Mark, Node, Scalar
from labseq.config.reading import check_characters
from labseq.config.scalars import resolve
from labseq.config.syntax import explain
from labseq.config.wording import clean, comma_hint, did_you_mean, shown
from labseq.errors import ConfigError, Problem

_FLOW: Final = "one value: 5, '45 ms', [a, b] or {key: value}"


@lru_cache(maxsize=8)  # nobody changes a tree, and most sessions of a process read the same profile
def compose(text: str, name: str, origin: str = "") -> Node | None:
    """Read YAML text.

    Args:
        text: The text, without a byte order mark.
        name: File name for the messages.
        origin: The option that the text came from, or "" for a file.

    Returns:
        The top node, or None for an empty text.

    Raises:
        ConfigError: Everything that was found up to where reading had to stop.
    """
    check_characters(text, name, origin)
    return _Composer(text, name, origin).document()


class _Loader(Reader, Scanner, Parser):
    """Text to events, in pure Python, so that positions and messages are the same everywhere."""

    def __init__(self, text: str) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)


class _Composer:
    def __init__(self, text: str, name: str, origin: str) -> None:
        self._text = text
        self._name = name
        self._origin = origin
        self._loader = _Loader(text)
        self._anchors: dict[str, Node | None] = {}  # None while the node is being read
        self._n_values = 0
        self._last: Event | None = None
        self._problems: list[Problem] = []

    def document(self) -> Node | None:
        self._next()  # the start of the stream
        event = self._next()
        root = None
        if isinstance(event, DocumentStartEvent):
            root = self._node(self._next(), 0)
            self._next()  # the end of the document
            event = self._next()
        if not isinstance(event, StreamEndEvent):
            raise self._stop(event, "a second document begins here", "one document in a file", "remove '---'")
        if self._problems:
            raise ConfigError(self._problems)
        return root

    def _next(self) -> Event:
        try:
            self._last = cast("Event", self._loader.get_event())
            return self._last
        except MarkedYAMLError as error:
            # A stray closing bracket makes the level negative.
            opened = self._loader.marks[-1] if self._loader.flow_level > 0 else None
            mark, words = explain(error, self._text, self._last, opened)
            self._note(mark, words.what, words.expected, words.hint)
            raise ConfigError(self._problems) from None
        except ValueError:  # PyYAML passes the escape of a character that does not exist to chr()
            mark = Mark(self._loader.line + 1, self._loader.column + 1)
            self._note(mark, "this number or escape is out of range")
            raise ConfigError(self._problems) from None

    def _node(self, event: Event, depth: int) -> Node:
        if isinstance(event, AliasEvent):
            return self._alias(event, depth)
        assert isinstance(event, NodeEvent)
        self._count(event, 1)
        tag = cast("str | None", cast("Any", event).tag)
        if tag is not None:
            what = f"'{clean(tag.replace('tag:yaml.org,2002:', '!!'))}' is a YAML tag, which is not allowed"
            self._note(self._mark(event), what, "a plain value", "put text that begins with '!' in quotes")
        anchor = cast("str | None", event.anchor)
        if anchor is not None:
            if anchor in self._anchors:
                self._note(self._mark(event), f"the anchor '&{clean(anchor)}' is given twice")
            self._anchors[anchor] = None
        if isinstance(event, ScalarEvent):
            node = self._scalar(event)
        else:
            if depth >= MAX_DEPTH:
                what = f"lists and mappings are nested more than {MAX_DEPTH} deep"
                raise self._stop(event, what)
            if self._origin and not cast("Any", event).flow_style:
                raise self._stop(event, "this is YAML of several lines", _FLOW)
            is_mapping = isinstance(event, MappingStartEvent)
            node = self._mapping(event, depth) if is_mapping else self._list(event, depth)
        if anchor is not None:
            self._anchors[anchor] = node
        return node

    def _scalar(self, event: ScalarEvent) -> Node:
        mark = self._mark(event)
        text = cast("str", event.value)
        value: Scalar = text
        is_plain = not event.style
        if is_plain:
            try:
                value = resolve(text)
            except ValueError as error:
                self._note(mark, str(error), "a number of a few digits")
        elif any("\ud800" <= char <= "\udfff" for char in text):
            self._note(mark, "an escape in this text is half of a character", "the character itself")
        return Node(value, mark, raw=text if is_plain else "")

    def _list(self, event: Event, depth: int) -> Node:
        items: list[Node] = []
        while not isinstance(inner := self._next(), SequenceEndEvent):
            items.append(self._node(inner, depth + 1))
        size = 1 + sum(item.size for item in items)
        height = 1 + max((item.height for item in items), default=0)
        return Node(items, self._mark(event), size=size, height=height)

    def _mapping(self, event: Event, depth: int) -> Node:
        values: dict[str, Node] = {}
        keys: dict[str, Mark] = {}
        size, height = 1, 0
        while not isinstance(inner := self._next(), MappingEndEvent):
            key = self._node(inner, depth + 1)
            value = self._node(self._next(), depth + 1)
            size, height = size + key.size + value.size, max(height, value.height)
            if not isinstance(key.value, str):
                hint = f"write '{clean(key.raw)}' in quotes" if key.raw else ""
                hint = comma_hint(key.raw, value.value) or hint
                self._note(key.mark, f"a key is {shown(key.plain(), key.raw)}", "text", hint)
            elif self._is_good_key(key, key.value, keys):
                keys[key.value], values[key.value] = key.mark, value
        return Node(values, self._mark(event), keys, size=size, height=height + 1)

    def _is_good_key(self, node: Node, key: str, keys: dict[str, Mark]) -> bool:
        if node.raw == "<<":
            self._note(node.mark, "merge keys ('<<') are not allowed", "every setting written out")
        elif key in keys:
            line, column, _ = keys[key]
            where = "" if self._origin else f" (first in line {line}, column {column})"
            self._note(node.mark, f"'{clean(key)}' is given twice{where}", "", "remove one of them")
        else:
            return True
        return False

    def _alias(self, event: AliasEvent, depth: int) -> Node:
        name = cast("str", event.anchor)
        if name not in self._anchors:
            hint = did_you_mean(name, self._anchors) or "put text that begins with '*' in quotes"
            raise self._stop(event, f"'*{clean(name)}' has no anchor '&{clean(name)}' before it", "", hint)
        node = self._anchors[name]
        if node is None:
            raise self._stop(event, f"'*{clean(name)}' stands inside of '&{clean(name)}' itself")
        self._count(event, node.size)
        if depth + node.height > MAX_DEPTH:
            raise self._stop(event, f"lists and mappings are nested more than {MAX_DEPTH} deep")
        return Node(node.value, self._mark(event), node.keys, node.raw, node.size, node.height)

    def _count(self, event: Event, n: int) -> None:
        self._n_values += n
        if self._n_values > MAX_VALUES:
            what = f"there are more than {MAX_VALUES} values up to here, aliases written out"
            raise self._stop(event, what, "a smaller file")

    def _mark(self, event: Event) -> Mark:
        if self._origin:
            return Mark(0, 0, self._origin)
        start = cast("Any", event).start_mark
        return Mark(start.line + 1, start.column + 1)

    def _note(self, mark: Mark, what: str, expected: str = "", hint: str = "") -> None:
        place = Mark(0, 0, self._origin) if self._origin else mark
        self._problems.append(place.problem(self._name, what, expected, hint))

    def _stop(self, event: Event, what: str, expected: str = "", hint: str = "") -> ConfigError:
        self._note(self._mark(event), what, expected, hint)
        return ConfigError(self._problems)
