"""Reads YAML text into nodes that carry their line and column.

PyYAML composes its node graph, which is checked while it grows and converted to :class:`Node`. PyYAML's
constructor is not used, so no tag can run code. Scalars follow the core rules of YAML 1.2. Under YAML 1.1,
PyYAML's default, ``off`` would be False, ``10:30`` 630 and ``2026-01-01`` a date. Here all three are text.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, NamedTuple, NoReturn, TypeAlias, cast

import yaml
from yaml.error import Mark as YamlMark, MarkedYAMLError
from yaml.events import AliasEvent, Event

from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, did_you_mean, shown, visible
from labseq.text_files import line_and_column

Scalar: TypeAlias = str | int | float | bool | None

MAX_VALUES: Final = 10_000
"""Maximum number of values (scalars, lists and mappings, aliases expanded) in one document."""

MAX_DEPTH: Final = 32
"""Maximum depth of nested lists and mappings."""

MAX_DIGITS: Final = 100
"""Maximum length of a number, in characters. Python refuses much longer numbers, or takes long."""


class Mark(NamedTuple):
    """The place of a value or key, which stays with it when it is put into another document.

    Attributes:
        source: Name of the file in messages, or an option such as ``--set shots=5``.
        line: Line, from 1. 0 in an option.
        column: Column, from 1. In an option, the column within ``source``, or 0 for the whole option.
    """

    source: str
    line: int = 0
    column: int = 0

    def problem(self, what: str, expected: str = "", hint: str = "") -> Problem:
        """Create a problem at this place.

        Unprintable characters are escaped, because validators (also of plugins) quote values unchanged.
        """
        return Problem(visible(what), self.source, self.line, self.column, visible(expected), visible(hint))

    def error(self, what: str, expected: str = "", hint: str = "") -> ConfigError:
        """Create an error for a problem at this place."""
        return ConfigError(self.problem(what, expected, hint))

    @property
    def order(self) -> tuple[bool, int, int]:
        """Sorting key that puts places in the file first, in order, then the options."""
        return self.line == 0, self.line, self.column


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One value of a YAML file. Nodes are immutable, so copies share their common parts.

    Attributes:
        value: A scalar, or the nodes of a list or mapping.
        mark: Start of the value.
        keys: Start of each key of a mapping.
        raw: An unquoted scalar as it is written. "" for everything else.
    """

    value: Scalar | list[Node] | dict[str, Node]
    mark: Mark
    keys: Mapping[str, Mark] = field(default_factory=dict[str, Mark])
    raw: str = ""

    def plain(self) -> Any:
        """The value as plain dicts, lists and scalars."""
        if isinstance(self.value, dict):
            return {key: child.plain() for key, child in self.value.items()}
        if isinstance(self.value, list):
            return [child.plain() for child in self.value]
        return self.value

    def leaves(self, loc: Loc = ()) -> list[tuple[Loc, Node]]:
        """All scalars in it, each with its location."""
        if not isinstance(self.value, dict | list):
            return [(loc, self)]
        steps = self.value.items() if isinstance(self.value, dict) else enumerate(self.value)
        return [leaf for step, child in steps for leaf in child.leaves((*loc, step))]

    def child(self, step: str | int) -> Node | None:
        """The value of a key or of a list index, or None if it is missing."""
        if isinstance(self.value, dict):
            return self.value.get(step) if isinstance(step, str) else None
        if isinstance(self.value, list) and isinstance(step, int) and 0 <= step < len(self.value):
            return self.value[step]
        return None

    def at(self, loc: Loc) -> Node | None:
        """The node at a location, or None if it is missing."""
        node: Node | None = self
        for step in loc:
            node = node.child(step) if node is not None else None
        return node

    def mark_at(self, loc: Loc, key: bool = False) -> Mark:
        """Start of the value at ``loc`` or of its key, or of the nearest parent if that is missing."""
        node = self
        for i, step in enumerate(loc):
            child = node.child(step)
            if child is None:
                break
            if key and i == len(loc) - 1 and isinstance(step, str):
                return node.keys[step]
            node = child
        return node.mark

    def replaced(self, loc: Loc, new: Node, *, key: Mark | None = None, same_key: bool = False) -> Node:
        """A copy with the value at ``loc`` replaced, or added to a mapping.

        The parents must exist. An empty parent becomes a mapping.

        Args:
            loc: The location.
            new: The new value.
            key: The place of its key. None for the place of the new value, because an option that replaces
                a value also gives its key.
            same_key: Whether problems of the key still refer to its place in the file.
        """
        if not loc:
            return new
        step, rest = loc[0], loc[1:]
        child = self.child(step)
        inner = (child or Node({}, new.mark)).replaced(rest, new, key=key, same_key=same_key)
        if isinstance(step, int):
            items = list(self.value) if isinstance(self.value, list) else []
            items[step] = inner
            return Node(items, self.mark)
        values = dict(self.value) if isinstance(self.value, dict) else {}
        values[step] = inner
        keeps_key = child is not None and (rest or same_key)
        return Node(values, self.mark, self.keys if keeps_key else {**self.keys, step: key or new.mark})


@lru_cache(maxsize=8)  # nodes are immutable, and most sessions of a process read the same profile
def compose(text: str, source: str, *, is_option: bool = False) -> Node | None:
    """Read YAML text.

    Args:
        text: The text, without a byte order mark.
        source: Name of the file in messages, or the option that holds the text.
        is_option: Whether it is an option, whose text has no lines and columns.

    Returns:
        The top node, or None for an empty text.

    Raises:
        ConfigError: All errors until reading had to stop.
    """
    _check_characters(text, source, is_option)
    composer = _Composer(text, source, is_option)
    try:
        root = composer.get_single_node()
    except MarkedYAMLError as error:
        # A stray closing bracket makes the level negative; a stray opening one leaves no mark.
        opened = composer.marks[-1] if composer.flow_level > 0 and composer.marks else None
        from labseq.config.syntax_errors import explain_syntax_error  # a right file needs no explanation

        found = explain_syntax_error(error, text, composer.last, opened)
        composer.stop(composer.place(found.line, found.column), found.what, found.expected, found.hint)
    except ConfigError:
        raise
    except ValueError:  # PyYAML passes the escape of a character that does not exist to chr()
        composer.stop(composer.get_mark(), "this number or escape is out of range")
    node = None if root is None or composer.problems else composer.converted(root)
    if composer.problems:
        raise ConfigError(composer.problems)
    return node


class _Alias(yaml.Node):
    """An alias ``*name``, with the node of its anchor and its own place."""

    def __init__(self, node: yaml.Node, mark: YamlMark) -> None:
        super().__init__("alias", node, mark, mark)


class _Composer(yaml.SafeLoader):
    """Converts text to PyYAML's nodes, in pure Python, and checks rules and limits while it reads."""

    def __init__(self, text: str, source: str, is_option: bool) -> None:
        super().__init__(text)
        self.problems: list[Problem] = []
        self.last: Event | None = None
        self._text, self._source, self._is_option = text, source, is_option
        self._depth = self._n_values = 0
        self._sizes: dict[str, int] = {}  # number of values behind an anchor that is complete
        self._keys: dict[int, dict[str, YamlMark]] = {}  # of each mapping

    def report(self, mark: Mark | YamlMark, what: str, expected: str = "", hint: str = "") -> None:
        """Record a problem, and continue."""
        self.problems.append(self._mark(mark).problem(what, expected, hint))

    def stop(self, mark: Mark | YamlMark, what: str, expected: str = "", hint: str = "") -> NoReturn:
        """Record a problem after which nothing else can be read, and raise all problems."""
        self.report(mark, what, expected, hint)
        raise ConfigError(self.problems)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        """Compose the next node. For a value of a mapping, ``index`` is the node of its key."""
        event = self.last = cast("Any", self.peek_event())
        if isinstance(event, AliasEvent):
            node: yaml.Node = self._alias(cast("Any", self.get_event()))
        else:
            self._count(event, 1)
            self._check(event)
            before = self._n_values
            self._depth += 1
            node = cast("yaml.Node", super().compose_node(parent, index))
            self._depth -= 1
            if event.anchor is not None:
                self._sizes[event.anchor] = 1 + self._n_values - before
        if isinstance(index, yaml.Node):
            self._check_key(self._keys.setdefault(id(parent), {}), index, node)
        return node

    def converted(self, node: yaml.Node, depth: int = 0, via: YamlMark | None = None) -> Node:
        """Convert a node of PyYAML to a :class:`Node`. ``via`` is the alias that refers to it."""
        mark = node.start_mark
        if isinstance(node, _Alias):
            via, node = via or mark, node.value
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node, mark)
        if depth >= MAX_DEPTH:
            self.stop(via or mark, f"lists and mappings are nested more than {MAX_DEPTH} deep")
        if isinstance(node, yaml.SequenceNode):
            items = [self.converted(item, depth + 1, via) for item in node.value]
            return Node(items, self._mark(mark))
        pairs = [(_key_text(key), key, value) for key, value in node.value]
        values = {text: self.converted(value, depth + 1, via) for text, _, value in pairs}
        return Node(values, self._mark(mark), {text: self._mark(key.start_mark) for text, key, _ in pairs})

    def place(self, line: int, column: int) -> Mark:
        """The place of a line and a column of the text, from 1."""
        if not self._is_option:
            return Mark(self._source, line, column)
        # The name of an option ends with its text, unless that is too long for it.
        is_within = line == 1 < column and self._source.endswith(self._text)
        return Mark(self._source, 0, len(self._source) - len(self._text) + column if is_within else 0)

    def _mark(self, mark: Mark | YamlMark) -> Mark:
        return mark if isinstance(mark, Mark) else self.place(mark.line + 1, mark.column + 1)

    def _count(self, event: Any, n: int) -> None:
        self._n_values += n
        if self._n_values > MAX_VALUES:
            what = f"there are more than {MAX_VALUES} values up to here, aliases written out"
            self.stop(event.start_mark, what, "a smaller file")

    def _check(self, event: Any) -> None:
        """Report tags, deep nesting, duplicate anchors, and blocks in an option."""
        if event.tag is not None:
            tag = clean(event.tag.replace("tag:yaml.org,2002:", "!!"))
            what = f"'{tag}' is a YAML tag, which is not allowed"
            self.report(event.start_mark, what, "a plain value", "put text that begins with '!' in quotes")
        if event.anchor in self.anchors:
            self.report(event.start_mark, f"the anchor '&{clean(event.anchor)}' is given twice")
            del self.anchors[event.anchor]
        is_scalar = isinstance(event, yaml.ScalarEvent)
        if not is_scalar and self._depth >= MAX_DEPTH:
            self.stop(event.start_mark, f"lists and mappings are nested more than {MAX_DEPTH} deep")
        if not is_scalar and self._is_option and not event.flow_style:
            expected = "one value: 5, '45 ms', [a, b] or {key: value}"
            self.stop(event.start_mark, "this is YAML of several lines", expected)

    def _alias(self, event: Any) -> _Alias:
        name, shown_name = event.anchor, clean(event.anchor)
        if name not in self.anchors:
            hint = did_you_mean(name, self.anchors) or "put text that begins with '*' in quotes"
            what = f"'*{shown_name}' has no anchor '&{shown_name}' before it"
            self.stop(event.start_mark, what, "", hint)
        if name not in self._sizes:
            self.stop(event.start_mark, f"'*{shown_name}' is inside '&{shown_name}' itself")
        self._count(event, self._sizes[name])
        return _Alias(self.anchors[name], event.start_mark)

    def _check_key(self, keys: dict[str, YamlMark], node: yaml.Node, value: yaml.Node) -> None:
        """Report keys that are not text, merge keys, and duplicate keys."""
        key, mark, n_before = self.converted(node), node.start_mark, len(self.problems)
        if not isinstance(key.value, str):
            hint = f"write '{clean(key.raw)}' in quotes" if key.raw else ""
            is_empty = isinstance(value, yaml.ScalarNode) and not value.value
            hint = comma_hint(key.raw, None if is_empty else "") or hint
            if len(self.problems) == n_before:
                self.report(mark, f"a key is {shown(key.plain(), key.raw)}", "text", hint)
        elif key.raw == "<<":
            self.report(mark, "merge keys ('<<') are not allowed", "every setting written out")
        elif key.value in keys:
            first = keys[key.value]
            where = "" if self._is_option else f" (first in line {first.line + 1}, column {first.column + 1})"
            self.report(mark, f"'{clean(key.value)}' is given twice{where}", "", "remove one of them")
        else:
            keys[key.value] = mark

    def _scalar(self, node: yaml.ScalarNode, mark: YamlMark) -> Node:
        text = cast("str", node.value)
        if node.style is None:
            try:
                return Node(resolve(text), self._mark(mark), raw=text)
            except ValueError as error:
                self.report(mark, str(error), "a number of a few digits")
        elif any("\ud800" <= char <= "\udfff" for char in text):
            self.report(mark, "an escape in this text is half of a character", "the character itself")
        elif node.style == '"' and (escape := _IN_WINDOWS_PATH.match(text)):
            written = repr(escape[1])[1:-1]
            what = f"in double quotes '{written}' is a control character, not a part of a path"
            self.report(mark, what, "", PATH_HINT)
        return Node(text, self._mark(mark))


def _key_text(node: yaml.Node) -> str:
    value = node.value.value if isinstance(node, _Alias) else node.value
    return value if isinstance(value, str) else ""  # a list or mapping as a key is a problem by now


def comma_hint(key: str, value: Any) -> str:
    """A hint for a key such as "5 ms" without a value, from ``{exposure: 4,5 ms}``, or else ""."""
    if value is None and key[:1].isdigit():
        return "a ',' begins another key, so write 4.5 for 4,5 and [4, 5] for a list"
    return ""


_WORDS: Final[dict[str, Scalar]] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **{sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
}
_INT: Final = re.compile(r"[-+]?[0-9]+")
_OCTAL_OR_HEX: Final = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT: Final = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")


def resolve(text: str) -> Scalar:
    """The value of an unquoted scalar by the core rules of YAML 1.2, except that 1e3 is a whole number.

    Raises:
        ValueError: A number has more than :data:`MAX_DIGITS` characters.

    Example:
        >>> resolve("0x10"), resolve("1e3"), resolve("on"), resolve("10:30"), resolve("~")
        (16, 1000, 'on', '10:30', None)
    """
    if text in _WORDS:
        return _WORDS[text]
    is_int, is_coded = _INT.fullmatch(text), _OCTAL_OR_HEX.fullmatch(text)
    if not (is_int or is_coded or _FLOAT.fullmatch(text)):
        return text
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} characters is too long")
    if is_coded:
        return int(text, 0)
    if is_int:
        return int(text, 10)
    number = float(text)
    is_whole = "e" in text.lower() and number.is_integer() and abs(number) < 2**53  # floats are exact below
    return int(number) if is_whole else number


# U+0085, U+2028 and U+2029 are line breaks for PyYAML but not for most editors, so all
# line numbers after them would be wrong. U+FEFF is invisible.
_FORBIDDEN: Final = re.compile(
    "[^\t\n\r\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]"
)
# At the beginning of a line, other kinds of space look like indentation but are text to YAML.
_ODD_INDENT: Final = re.compile("^[ \t-]*([\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000])", re.MULTILINE)


def _check_characters(text: str, source: str, is_option: bool) -> None:
    """Raise for control characters, unusual line breaks and spaces, and incomplete characters.

    Raises:
        ConfigError: The text has such a character. The message gives the place of the first one.
    """
    match, group, expected, hint = _FORBIDDEN.search(text), 0, "plain text", "delete it"
    if match is None:
        match, group, expected, hint = _ODD_INDENT.search(text), 1, "plain spaces", ""
    if match is None:
        return
    char = match[group]
    kind, code = unicodedata.name(char, "control character").lower(), f"U+{ord(char):04X}"
    if group:
        what = f"{'an' if kind[0] in 'aeio' else 'a'} {kind} ({code}) is used for indentation"
    elif char == "\0":
        what, hint = f"a NUL character ({code})", "is this a YAML file, saved as UTF-8?"
    elif "\ud800" <= char <= "\udfff":
        what = "a byte that is not UTF-8" if is_option else f"half of a character ({code})"
    else:
        what = f"an invisible character ({code}, {kind})"
    place = () if is_option else line_and_column(text, match.start(group))
    raise Mark(source, *place).error(what, expected, hint)


PATH_HINT: Final = "put a path into single quotes, or write '/' or two backslashes for each backslash"
_IN_WINDOWS_PATH: Final = re.compile(r"(?:[A-Za-z]:|\\\w[^/]*)([\0\a\b\t\n\v\f\r\x1b])\w")
"""A path such as "C:\\new" in double quotes, where YAML reads "\\n" as an escape."""
