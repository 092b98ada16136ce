"""YAML read into nodes that know their line and column.

PyYAML's reader, scanner and parser give events; the tree is made here. There is
no constructor, so no tag can run code, and the limits hold before anything grows.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, NamedTuple, TypeAlias, cast

from yaml.error import Mark as YamlMark, MarkedYAMLError
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

from labseq.config.messages import ErrorText, comma_hint, resolve
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, did_you_mean, shown, visible

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


_QUOTE_IT: Final = "put text with special characters in quotes"

_CLOSER: Final = {"[": "]", "{": "}"}
_MISALIGNED: Final = "the indentation of this line fits no line above"


@dataclass(frozen=True, slots=True)
class _Rule:
    """Words for the errors whose problem and context match; ``{0}`` is the problem's first group."""

    problem: str
    words: ErrorText
    context: str = ""
    at_context: bool = False


_RULES: Final = (
    _Rule(
        r"found character (.+) that cannot start any token",
        ErrorText("a value cannot begin with {0}", "", _QUOTE_IT),
    ),
    _Rule(
        "sequence entries are not allowed here",
        ErrorText("a list item ('- ') cannot begin here", "it on a line of its own"),
    ),
    _Rule("mapping keys are not allowed here", ErrorText("a '?' cannot stand here", "", _QUOTE_IT)),
    _Rule(
        "found unexpected (?:end of stream|document separator)",
        ErrorText("the quotation mark that opens here is never closed"),
        context="quoted scalar",
        at_context=True,
    ),
    _Rule(
        "found unknown escape character (.+)",
        ErrorText(
            "a backslash and {0} mean nothing in double quotes",
            "",
            r"use single quotes, or write '\\' for a backslash",
        ),
    ),
    _Rule(
        "expected escape sequence of (.+) hexadecimal numbers",
        ErrorText("this escape in double quotes needs {0} hexadecimal digits", "", "use single quotes"),
    ),
    _Rule(
        "expected alphabetic or numeric character",
        ErrorText("'&' and '*' begin anchors and aliases, and a name must follow", "", _QUOTE_IT),
        context="while scanning an",
        at_context=True,
    ),
    _Rule("", ErrorText("YAML tags ('!') are not allowed", "plain values", _QUOTE_IT), context="a tag"),
    _Rule("tag handle", ErrorText("YAML tags ('!') are not allowed", "plain values", _QUOTE_IT)),
    _Rule(
        "",
        ErrorText("'|' and '>' begin a block of text on the lines below", "nothing else on their line"),
        context="a block scalar",
    ),
    _Rule(
        "expected the node content, but found (.+)",
        ErrorText("a value is missing before {0}"),
    ),
    _Rule(
        "expected '<document start>', but found",
        ErrorText("this follows after the end of the file's mapping", "one mapping and nothing after it"),
    ),
    _Rule(
        "YAML d(?:irective|ocument)", ErrorText("this is not a version of YAML that labseq reads", "YAML 1.2")
    ),
    _Rule("", ErrorText("this is no YAML directive", "", _QUOTE_IT), context="a directive"),
)
_TOKENS: Final = {
    "'<stream end>'": "the end of the file",
    "'<document end>'": "the end of the document",
    "'<document start>'": "'---'",
    "'<block end>'": "the end of the block",
    "'<block mapping start>'": "the next key",
    "'<block sequence start>'": "'- '",
}


def explain(
    error: MarkedYAMLError, text: str, last: Event | None, opened: YamlMark | None
) -> tuple[Mark, ErrorText]:
    """Say where a syntax error is and what it is.

    Args:
        error: The error.
        text: The text that it is in.
        last: What was read before it.
        opened: The innermost bracket that is open, if it is in one.
    """
    problem, context = error.problem or "", error.context or ""
    at = cast("YamlMark", error.problem_mark or error.context_mark)
    since = error.context_mark or at
    if text[at.index : at.index + 1] == "\t":
        return _mark(at), _tab(text, at)
    if "expected ':'" in problem:
        return _mark(since), _no_colon(text, since)
    if problem.startswith("mapping values"):
        return _mark(at), _stray_colon(text, at)
    if opened and problem.endswith("'<stream end>'"):
        words = ErrorText(
            f"the '{text[opened.index]}' that opens here is never closed",
            f"',' or '{_CLOSER[text[opened.index]]}'",
        )
        return _mark(opened), words
    flow = re.match(r"expected ',' or '(.)', but got", problem)
    if flow:
        return _open_bracket(flow[1], since, at)
    block = re.match(r"expected <block end>, but found '(.+)'", problem)
    if block:
        return _late_quote(last, at) or (_mark(at), _out_of_place(block[1], context, text, since, at))
    return _by_rule(problem, context, since, at)


def _by_rule(problem: str, context: str, since: YamlMark, at: YamlMark) -> tuple[Mark, ErrorText]:
    for rule in _RULES:
        match = re.search(rule.problem, problem)
        if match and rule.context in context:
            found = match[1] if match.re.groups else ""
            what = rule.words.what.format(_TOKENS.get(found, clean(found)))
            mark = since if rule.at_context else at
            return _mark(mark), ErrorText(what, rule.words.expected, rule.words.hint)
    return _mark(at), ErrorText(f"this is not valid YAML: {clean(problem)}", "", _QUOTE_IT)


def _tab(text: str, at: YamlMark) -> ErrorText:
    if not text[at.index - at.column : at.index].strip():
        return ErrorText("a tab is used for indentation", "spaces")
    return ErrorText("a tab stands here", "a space")


def _no_colon(text: str, at: YamlMark) -> ErrorText:
    line = re.split(r"[\r\n]", text[at.index :], maxsplit=1)[0]
    if ":" in line.partition(" #")[0]:
        return ErrorText("there is no space after the ':' of this line", "'key: value'")
    return ErrorText("this line has no ':'", "'key: value'")


def _stray_colon(text: str, at: YamlMark) -> ErrorText:
    """A second colon on a line, or on a line that is indented so that it continues the text above."""
    before = text[at.index - at.column : at.index]
    spaces = len(before) - len(before.lstrip())
    above, line = _line_above(text, at)
    if ": " not in before and line and spaces > above:
        what = f"this line is indented further than line {line}, which has a value already"
        return ErrorText(what, f"{above} spaces as there")
    return ErrorText(
        "a ':' cannot stand here", "one 'key: value' on a line", "put text that holds ': ' in quotes"
    )


def _line_above(text: str, at: YamlMark) -> tuple[int, int]:
    """Column of the first key on the nearest line above that says anything, and its number, from 1."""
    lines = re.split(r"\r\n|\r|\n", text[: at.index])[:-1]
    for number in range(len(lines), 0, -1):
        match = re.match(r" *(?:- +)*(?=[^ #])", lines[number - 1])
        if match:
            return match.end(), number
    return 0, 0


def _open_bracket(closer: str, since: YamlMark, at: YamlMark) -> tuple[Mark, ErrorText]:
    """A list or mapping in brackets that goes wrong: on its first line, or only later."""
    pair = "[...]" if closer == "]" else "{...}"
    if at.line == since.line:
        words = ErrorText(
            f"the {pair} that opens in column {since.column + 1} goes wrong here", f"',' or '{closer}'"
        )
        return _mark(at), words
    what = f"the '{pair[0]}' that opens here is not closed by line {at.line + 1}"
    return _mark(since), ErrorText(what, f"',' or '{closer}'")


def _late_quote(last: Event | None, at: YamlMark) -> tuple[Mark, ErrorText] | None:
    """A quoted text that ends lines later than it should, at the next quotation mark."""
    if not isinstance(last, ScalarEvent) or last.style not in ("'", '"'):
        return None
    start, end = cast("YamlMark", last.start_mark), cast("YamlMark", last.end_mark)
    if start.line == end.line or end.line != at.line:
        return None
    what = f"the quotation mark that opens here is closed only in line {end.line + 1}"
    return _mark(start), ErrorText(what, "a quotation mark at the end of the text")


def _out_of_place(found: str, context: str, text: str, since: YamlMark, at: YamlMark) -> ErrorText:
    """Something that fits neither the block that is open nor one around it."""
    is_item = found in ("-", "<block sequence start>")
    is_aligned = at.column == since.column
    if is_item and is_aligned:
        return ErrorText("a list item ('- ') stands among the keys of a mapping", "'key: value'")
    if is_item:
        return ErrorText(_MISALIGNED, "that of the other items of the list")
    if is_aligned and "collection" in context:
        return ErrorText("this line does not continue the list above", "'- '", "check the indentation")
    if is_aligned and found == ":":
        return ErrorText("a key is missing before this ':'", "'key: value'")
    if not is_aligned and found in ("<block mapping start>", "?"):
        above, line = _line_above(text, at)
        other = f" or {since.column} as in line {since.line + 1}" if since.column != above else ""
        return ErrorText(_MISALIGNED, f"{above} spaces as in line {line}{other}")
    return ErrorText("this does not belong here", "the end of the line", _QUOTE_IT)


def _mark(mark: YamlMark) -> Mark:
    return Mark(mark.line + 1, mark.column + 1)


_LINE_BREAK: Final = re.compile(r"\r\n|\r|\n")
# U+0085, U+2028 and U+2029 are line breaks for PyYAML but for few editors, so
# that all line numbers after them would be wrong; U+FEFF cannot be seen.
_FORBIDDEN: Final = re.compile(
    "[^\t\n\r\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]"
)
# At the beginning of a line, all other spaces are text to YAML and indentation to the eye.
_ODD_INDENT: Final = re.compile("^[ \t-]*([\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000])", re.MULTILINE)


def check_characters(text: str, name: str, origin: str = "") -> None:
    """Refuse control characters, odd line breaks and what is no character at all.

    Raises:
        ConfigError: With the place of the first one.
    """
    match = _FORBIDDEN.search(text)
    if match is None:
        _check_indentation(text, name, origin)
        return
    char = match[0]
    code = f"U+{ord(char):04X}"
    hint = "delete it"
    if char == "\0":
        what, hint = f"a NUL character ({code})", "is this a YAML file, saved as UTF-8?"
    elif "\ud800" <= char <= "\udfff":
        what = "a byte that is not UTF-8" if origin else f"half of a character ({code})"
    else:
        kind = unicodedata.name(char, "control character").lower()
        what = f"an invisible character ({code}, {kind})"
    mark = Mark(0, 0, origin) if origin else _mark_at(text, match.start())
    raise ConfigError(mark.problem(name, what, "plain text", hint))


def _check_indentation(text: str, name: str, origin: str) -> None:
    match = _ODD_INDENT.search(text)
    if match is not None:
        kind = unicodedata.name(match[1]).lower()
        mark = Mark(0, 0, origin) if origin else _mark_at(text, match.start(1))
        what = f"{'an' if kind[0] in 'aeio' else 'a'} {kind} (U+{ord(match[1]):04X}) is used for indentation"
        raise ConfigError(mark.problem(name, what, "plain spaces"))


def _mark_at(text: str, index: int) -> Mark:
    """Line and column of a character of the text."""
    breaks = [match.end() for match in _LINE_BREAK.finditer(text, 0, index)]
    start = breaks[-1] if breaks else 0
    return Mark(len(breaks) + 1, min(index, len(text)) - start + 1)


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
