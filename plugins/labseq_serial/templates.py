"""What is sent: text with places for arguments, ``FREQ {frequency:.3f}``."""

from __future__ import annotations

import re
import string
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
class Piece:
    """Literal text, and the placeholder behind it.

    Attributes:
        literal: The text.
        name: Name of the argument; "" for none.
        spec: How it is written, as Python's ``format`` takes it.
    """

    literal: str
    name: str = ""
    spec: str = ""


@dataclass(frozen=True, slots=True)
class Template:
    """A command with places for arguments.

    Attributes:
        text: As the profile has it.
        pieces: What it is made of.
    """

    text: str
    pieces: tuple[Piece, ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Take a template apart.

        Raises:
            ValueError: A brace without its other, or a placeholder that is no name.

        Example:
            >>> Template.parse("FREQ {frequency:.3f}").names
            ('frequency',)
        """
        pieces: list[Piece] = []
        try:
            found = list(string.Formatter().parse(text))
        except ValueError as error:
            problem = f"'{text}' is no template: {error}"
            raise ValueError(f"{problem}; expected {{name}} or {{name:format}}; {{{{ for a brace") from None
        for literal, name, spec, conversion in found:
            if name is None:
                pieces.append(Piece(literal))
            elif not name.isidentifier() or conversion or "{" in (spec or ""):
                text = f"the placeholder '{{{name}}}' is not the name of an argument"
                raise ValueError(f"{text}; expected {{name}} or {{name:format}}; {{{{ for a brace")
            else:
                pieces.append(Piece(literal, name, spec or ""))
        return cls(text, tuple(pieces))

    @property
    def names(self) -> tuple[str, ...]:
        """The arguments that it has places for, in order."""
        return tuple(dict.fromkeys(piece.name for piece in self.pieces if piece.name))

    def format(self, values: Mapping[str, Sent]) -> str:
        """Write the arguments into their places.

        Raises:
            ValueError: A format is not for the type of its argument.

        Example:
            >>> Template.parse("F{channel:02d} {frequency:.3f}").format({"frequency": 80.0, "channel": 1})
            'F01 80.000'
        """
        return "".join(
            piece.literal + (_written(values[piece.name], piece) if piece.name else "")
            for piece in self.pieces
        )

    def rounded(self, values: Mapping[str, Sent]) -> dict[str, Sent]:
        """The arguments as they are once they are written.

        Raises:
            ValueError: A format is not for the type of its argument, or what it makes cannot be read.

        Example:
            >>> Template.parse("FREQ {frequency:.1f}").rounded({"frequency": 80.04})
            {'frequency': 80.0}
        """
        return {
            piece.name: _read(_written(values[piece.name], piece), type(values[piece.name]), piece.spec)
            for piece in self.pieces
            if piece.name
        }

    def read(self, text: str, types: Mapping[str, type[Sent]]) -> dict[str, Sent] | None:
        """Find the arguments in what was sent, as the instrument does.

        Args:
            text: What was sent.
            types: Type of each argument.

        Returns:
            None if this is not what the template makes.

        Example:
            >>> Template.parse("FREQ {frequency:.3f}").read("FREQ 80.000", {"frequency": float})
            {'frequency': 80.0}
        """
        match = self._pattern(types).fullmatch(text)
        if match is None:
            return None
        specs = {piece.name: piece.spec for piece in self.pieces}
        try:
            return {name: _read(match[name], types[name], specs[name]) for name in self.names}
        except ValueError:
            return None

    def _pattern(self, types: Mapping[str, type[Sent]]) -> re.Pattern[str]:
        parts: list[str] = []
        seen: set[str] = set()
        for piece in self.pieces:
            parts.append(re.escape(piece.literal))
            if piece.name in seen:
                parts.append(f"(?P={piece.name})")
            elif piece.name:
                seen.add(piece.name)
                parts.append(f"(?P<{piece.name}>{_place(types[piece.name], piece.spec)})")
        return re.compile("".join(parts), re.DOTALL)


def _written(value: Sent, piece: Piece) -> str:
    spec = piece.spec or (_SHORT if isinstance(value, float) else "")
    try:
        return format(value, spec)
    except ValueError as error:
        kind = {float: "a float", int: "a whole number", str: "text"}[type(value)]
        problem = f"'{{{piece.name}:{piece.spec}}}' is no format of {kind}: {error}"
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
