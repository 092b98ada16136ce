"""Patterns of replies, and a reply that fits one."""

from __future__ import annotations

import re
import string
from collections import deque
from typing import Final

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
        ValueError: It is no regular expression.
    """
    try:
        return re.compile(pattern, re.DOTALL)
    except re.error as error:
        text = f"'{pattern}' is no regular expression: {error}"
        raise ValueError(f"{text}; expected one; put a \\ before a character that is meant itself") from None


def example_of(pattern: str, value: str = "") -> str | None:
    """Make up a reply that matches a pattern.

    Alternatives give their first, and what may be left out is left out where that does.

    Args:
        pattern: A regular expression that compiles.
        value: What the group ``value`` shall hold.

    Returns:
        None for a pattern that is too much for this: one with a look-ahead, for example.

    Example:
        >>> example_of(r"T=(?P<value>[-+.0-9eE]+) ?degC", "21.5")
        'T=21.5degC'
        >>> example_of("(OK|DONE) [A-F]{2}.*")
        'OK AA'
    """
    for least in (0, 1):  # of what may be left out
        try:
            text = _Maker(pattern, value, least).alternatives()
            match = compiled(pattern).fullmatch(text)
        except (IndexError, ValueError, re.error, StopIteration):
            continue
        if match is not None and text == text.strip() and match.groupdict().get(VALUE, value) == value:
            return text
    return None


class _Maker:
    """Goes through a pattern and makes up a text."""

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
