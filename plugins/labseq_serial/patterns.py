"""Texts on the line: templates of commands, and patterns of replies."""

from __future__ import annotations

import re
import string
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self, TypeAlias

Sent: TypeAlias = int | float | str
"""An argument in the unit of the line: a float, an int, or text."""

_BASES: Final = {"x": 16, "X": 16, "o": 8, "b": 2}
_PADDED: Final = re.compile(r"0(\d+)[dxXob]?")
_SHORT: Final = ".12g"
"""Format of a float without one of its own."""


@dataclass(frozen=True, slots=True)
class Template:
    """A command with placeholders for arguments: ``FREQ {frequency:.3f}``.

    Attributes:
        pieces: Literal text, then name and format of the argument after it; "" for none.
    """

    pieces: tuple[tuple[str, str, str], ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a template.

        Raises:
            ValueError: An unmatched brace, or a placeholder that is not a name.

        Example:
            >>> Template.parse("FREQ {frequency:.3f}").names
            ('frequency',)
        """
        expected = "expected {name} or {name:format}; {{ for a brace"
        try:
            found = list(string.Formatter().parse(text))
        except ValueError as error:
            raise ValueError(f"'{text}' is not a template: {error}; {expected}") from None
        for _, name, spec, conversion in found:
            if name is not None and (not name.isidentifier() or conversion or "{" in (spec or "")):
                raise ValueError(f"the placeholder '{{{name}}}' is not the name of an argument; {expected}")
        return cls(tuple((literal, name or "", spec or "") for literal, name, spec, _ in found))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its placeholders, in order."""
        return tuple(self._specs)

    def format(self, values: Mapping[str, Sent]) -> str:
        """Fill in the arguments.

        Raises:
            ValueError: A format does not suit the type of its argument.

        Example:
            >>> Template.parse("F{channel:02d} {frequency:.3f}").format({"frequency": 80.0, "channel": 1})
            'F01 80.000'
        """
        return "".join(
            literal + (_written(values[name], name, spec) if name else "")
            for literal, name, spec in self.pieces
        )

    def rounded(self, values: Mapping[str, Sent]) -> dict[str, Sent]:
        """The arguments as rounded by their formats.

        Raises:
            ValueError: A format does not suit the type of its argument, or its output cannot be read back.

        Example:
            >>> Template.parse("FREQ {frequency:.1f}").rounded({"frequency": 80.04})
            {'frequency': 80.0}
        """
        return {
            name: _read(_written(values[name], name, spec), type(values[name]), spec)
            for name, spec in self._specs.items()
        }

    def read(self, text: str, types: Mapping[str, type[Sent]]) -> dict[str, Sent] | None:
        """Read the arguments from a text that was sent, as the instrument does.

        Returns:
            None if the text does not match the template.

        Example:
            >>> Template.parse("FREQ {frequency:.3f}").read("FREQ 80.000", {"frequency": float})
            {'frequency': 80.0}
        """
        match = self._pattern(types).fullmatch(text)
        if match is None:
            return None
        try:
            return {name: _read(match[name], types[name], spec) for name, spec in self._specs.items()}
        except ValueError:
            return None

    @property
    def _specs(self) -> dict[str, str]:
        return {name: spec for _, name, spec in self.pieces if name}

    def _pattern(self, types: Mapping[str, type[Sent]]) -> re.Pattern[str]:
        parts: list[str] = []
        seen: set[str] = set()
        for literal, name, spec in self.pieces:
            parts.append(re.escape(literal))
            if name in seen:
                parts.append(f"(?P={name})")
            elif name:
                seen.add(name)
                parts.append(f"(?P<{name}>{_place(types[name], spec)})")
        return re.compile("".join(parts), re.DOTALL)


def _written(value: Sent, name: str, spec: str) -> str:
    try:
        return format(value, spec or (_SHORT if isinstance(value, float) else ""))
    except ValueError as error:
        kind = {float: "a float", int: "a whole number", str: "text"}[type(value)]
        problem = f"'{{{name}:{spec}}}' is not a format of {kind}: {error}"
        raise ValueError(f"{problem}; expected one such as .3f or 03d") from None


def _place(kind: type[Sent], spec: str) -> str:
    if kind is str:
        return ".*?"
    if kind is int and (padded := _PADDED.fullmatch(spec)):
        return f".{{{padded[1]},}}?"
    return r"\s*[-+]?[0-9a-fA-F.]+(?:[eE][-+]?\d+)?\s*"


def _read(text: str, kind: type[Sent], spec: str) -> Sent:
    if kind is str:
        return text.strip()
    try:
        return float(text) if kind is float else int(text, _BASES.get(spec[-1:], 10))
    except ValueError:
        raise ValueError(f"'{text}' cannot be read back; expected a format of plain numbers") from None


VALUE: Final = "value"
"""Name of the group that holds a value."""

_TOKEN: Final = re.compile(
    r"""\[\^?\]?(?:\\.|[^\]\\])*\]          # a set of characters
    | \\x..|\\u....|\\.                     # an escape
    | \(\?P<\w+>|\(\?:|\(|\)|\|             # groups and alternatives
    | (?:[*+?]|\{\d+(?:,\d*)?\})[?+]?       # how often
    | .""",
    re.DOTALL | re.VERBOSE,
)
_NOTHING: Final = frozenset({"^", "$", r"\A", r"\Z", r"\b", r"\B"})
_CANDIDATES: Final = "0A" + string.printable


def compiled(pattern: str) -> re.Pattern[str]:
    """Compile a pattern that a whole reply must match.

    Raises:
        ValueError: It is not a regular expression.
    """
    try:
        return re.compile(pattern, re.DOTALL)
    except re.error as error:
        text = f"'{pattern}' is not a regular expression: {error}"
        raise ValueError(f"{text}; expected one; put a \\ before a special character") from None


def example_of(pattern: str, value: str = "") -> str | None:
    """Generate a reply that matches a pattern.

    Of alternatives the first is taken; optional parts are left out if possible.

    Args:
        pattern: A regular expression that compiles.
        value: Content of the group ``value``.

    Returns:
        None for a pattern that is too complex, for example with a look-ahead.

    Example:
        >>> example_of(r"T=(?P<value>[-+.0-9eE]+) ?degC", "21.5")
        'T=21.5degC'
        >>> example_of("(OK|DONE) [A-F]{2}.*")
        'OK AA'
    """
    for least in (0, 1):  # repetitions of optional parts
        try:
            text = _Maker(pattern, value, least).alternatives()
            match = compiled(pattern).fullmatch(text)
        except (IndexError, ValueError, re.error, StopIteration):
            continue
        if match is not None and text == text.strip() and match.groupdict().get(VALUE, value) == value:
            return text
    return None


class _Maker:
    """Goes through a pattern and generates a text."""

    def __init__(self, pattern: str, value: str, least: int) -> None:
        self._tokens = deque(_TOKEN.findall(pattern))
        self._value = value
        self._least = least

    def alternatives(self) -> str:
        """The first of some alternatives; the others are gone through."""
        text = self._sequence()
        while self._tokens and self._tokens[0] == "|":
            self._tokens.popleft()
            self._sequence()
        return text

    def _sequence(self) -> str:
        pieces: list[str] = []
        tokens = self._tokens
        while tokens and tokens[0] not in ("|", ")"):
            token = tokens.popleft()
            is_value = token == f"(?P<{VALUE}>"
            if token.startswith("("):
                piece = self.alternatives()
                tokens.popleft()
            else:
                piece = _character(token)
            if tokens and tokens[0][0] in "*+?{" and tokens[0] != "{":
                piece *= self._count(tokens.popleft())
            pieces.append(self._value if is_value else piece)
        return "".join(pieces)

    def _count(self, quantifier: str) -> int:
        if quantifier[0] == "{":
            return int(quantifier.strip("{}?+").partition(",")[0])
        return 1 if quantifier[0] == "+" else self._least


def _character(atom: str) -> str:
    if atom in _NOTHING:
        return ""
    if len(atom) == 1 and atom != ".":
        return atom
    if atom[:2] in (r"\x", r"\u"):
        return atom.encode().decode("unicode_escape")
    return next(char for char in _CANDIDATES if re.fullmatch(atom, char))
