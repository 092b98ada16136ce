"""Texts on the line, which are commands with places for arguments, and patterns of replies."""

from __future__ import annotations

import re
import string
from typing import Final, NamedTuple, TypeAlias

Sent: TypeAlias = int | float | str
"""An argument in the unit of the line: a float, an int, or text."""

VALUE: Final = "value"
"""Name of the group that holds a value."""
_SHORT: Final = ".12g"
"""Format of a float without one of its own."""
_NAMED: Final = re.compile(r"\(\?P<(\w+)>[^()]*\)")


class Piece(NamedTuple):
    """A part of a command: literal text, and the argument after it, if any."""

    literal: str
    name: str
    spec: str

    def written(self, value: Sent) -> str:
        """The argument in its format.

        Raises:
            ValueError: The format does not suit the type of the argument.

        Example:
            >>> Piece("FREQ ", "frequency", ".3f").written(80.0)
            '80.000'
        """
        try:
            return format(value, self.spec or (_SHORT if isinstance(value, float) else ""))
        except ValueError as error:
            kind = {float: "a float", int: "a whole number", str: "text"}[type(value)]
            problem = f"'{{{self.name}:{self.spec}}}' is not a format of {kind}: {error}"
            raise ValueError(f"{problem}; expected one such as .3f or 03d") from None


def pieces(text: str) -> list[Piece]:
    """Split a command such as ``FREQ {frequency:.3f}`` at its arguments.

    Raises:
        ValueError: An unmatched brace, or a placeholder that is not a name.

    Example:
        >>> pieces("FREQ {frequency:.3f};OUTP ON")
        [Piece(literal='FREQ ', name='frequency', spec='.3f'), Piece(literal=';OUTP ON', name='', spec='')]
    """
    expected = "expected {name} or {name:format}, or {{ for a brace"
    try:
        parts = list(string.Formatter().parse(text))
    except ValueError as error:
        raise ValueError(f"'{text}' is not a template: {error}; {expected}") from None
    for _, name, _, conversion in parts:
        if conversion or not (name or "x").isidentifier():
            raise ValueError(f"the placeholder '{{{name}}}' is not the name of an argument; {expected}")
    return [Piece(literal, name or "", spec or "") for literal, name, spec, _ in parts]


def compiled(pattern: str) -> re.Pattern[str]:
    """Compile a pattern that a whole reply must match.

    Raises:
        ValueError: It is not a regular expression.
    """
    try:
        return re.compile(pattern, re.DOTALL)
    except re.error as error:
        text = f"'{pattern}' is not a regular expression: {error}"
        raise ValueError(f"{text}; put a \\ before a special character") from None


def example_of(pattern: str, value: str = "") -> str | None:
    r"""The pattern itself as a reply, with a value in place of the group ``value``.

    Other named groups become their names, and escaped characters themselves.

    Returns:
        None if that does not match the pattern, so that the profile needs an example.

    Example:
        >>> example_of(r"T=(?P<value>[-+.0-9eE]+) degC", "21.5")
        'T=21.5 degC'
        >>> example_of(r"\+0,.*")
        '+0,.*'
        >>> example_of("OK|DONE")
    """
    text = _NAMED.sub(lambda group: value if group[1] == VALUE else group[1], pattern)
    text = re.sub(r"\\(\W)", r"\1", text)
    return text if compiled(pattern).fullmatch(text) else None
