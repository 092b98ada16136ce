"""The text of an expression as a tree.

Grammar, the weakest first::

    sum     = product (("+" | "-") product)*
    product = signed (("*" | "/") signed)*
    signed  = ("+" | "-")* power
    power   = atom ("**" signed)?
    atom    = number unit? | name | function "(" sum ("," sum)* ")" | "(" sum ")"

There are no attributes, no indices and no calls but of the functions that are listed.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from labseq.config.expressions_values import CONSTANTS, EXACT, FUNCTIONS, POWERS, Quantity
from labseq.config.wording import clean, did_you_mean, listing
from labseq.units import UNITS, ZERO_CELSIUS_K, dimension_of, scaled

MAX_LENGTH: Final = 500
MAX_DEPTH: Final = 30
"""Most brackets, signs and powers within each other."""

_UNITS: Final = sorted({unit for units in UNITS.values() for unit in units if unit} | {"degC"}, key=len)[::-1]
"""The longest first."""
_NUMBER: Final = re.compile(r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_NAME: Final = re.compile(r"[^\W\d]\w*(?:\.\w+)*")
_SPACE: Final = re.compile(r"\s*")
_SIGN: Final = re.compile(r"\*\*|[-+*/(),]")


class ExpressionError(ValueError):
    """An expression that is wrong.

    Attributes:
        at: Index of the character where.
        what: What is wrong.
        expected: What would have been right.
        hint: What to do.
    """

    def __init__(self, at: int, what: str, expected: str = "", hint: str = "") -> None:
        self.at, self.what, self.expected, self.hint = at, what, expected, hint
        super().__init__(what)


@dataclass(frozen=True, slots=True)
class Literal:
    """A number, with or without a unit."""

    at: int
    value: Quantity


@dataclass(frozen=True, slots=True)
class Name:
    """An address."""

    at: int
    address: str


@dataclass(frozen=True, slots=True)
class Negated:
    """What follows a minus sign."""

    at: int
    of: Tree


@dataclass(frozen=True, slots=True)
class Combined:
    """Two values and the sign between them."""

    at: int
    sign: str
    left: Tree
    right: Tree


@dataclass(frozen=True, slots=True)
class Applied:
    """A function of values."""

    at: int
    name: str
    values: tuple[Tree, ...]


Tree = Literal | Name | Negated | Combined | Applied


@lru_cache(maxsize=256)
def parse(text: str) -> Tree:
    """Read an expression.

    Args:
        text: The text, with the "=" that it begins with.

    Raises:
        ExpressionError: It is none, or is too long or too deep.
    """
    if len(text) > MAX_LENGTH:
        raise ExpressionError(0, f"the expression has {len(text)} characters", f"at most {MAX_LENGTH}")
    parser = _Parser(text)
    tree = parser.sum()
    if parser.sign != "":
        raise parser.wrong("an operator such as '+' or '*'")
    return tree


class _Parser:
    """Reads from left to right; ``sign`` is the operator at hand, "" at the end, None for anything else."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 1
        self._depth = 0
        self._skip()

    def sum(self) -> Tree:
        tree = self._product()
        while self.sign in ("+", "-"):
            at, sign = self._take()
            tree = Combined(at, sign, tree, self._product())
        return tree

    def wrong(self, expected: str) -> ExpressionError:
        rest = self._text[self._at :]
        what = f"'{clean(rest[0])}' cannot stand here" if rest else "the expression ends too early"
        return ExpressionError(self._at if rest else max(0, len(self._text) - 1), what, expected)

    def _product(self) -> Tree:
        tree = self._signed()
        while self.sign in ("*", "/"):
            at, sign = self._take()
            tree = Combined(at, sign, tree, self._signed())
        return tree

    def _signed(self) -> Tree:
        self._deeper()
        if self.sign in ("+", "-"):
            at, sign = self._take()
            tree = self._signed()
            tree = Negated(at, tree) if sign == "-" else tree
        else:
            tree = self._power()
        self._depth -= 1
        return tree

    def _power(self) -> Tree:
        tree = self._atom()
        if self.sign == "**":
            at, sign = self._take()
            tree = Combined(at, sign, tree, self._signed())
        return tree

    def _atom(self) -> Tree:
        if self.sign == "(":
            self._take()
            tree = self.sum()
            self._close()
            return tree
        if match := _NUMBER.match(self._text, self._at):
            return self._literal(match)
        if match := _NAME.match(self._text, self._at):
            return self._named(match)
        raise self.wrong("a number, a name or '('")

    def _literal(self, match: re.Match[str]) -> Tree:
        at, number = match.start(), match[0]
        amount: int | float = float(number)
        if not math.isfinite(amount):
            raise ExpressionError(at, "this is too large a number")
        amount = int(number) if number.isdecimal() and amount < EXACT else amount
        self._move(match.end())
        unit = next((unit for unit in _UNITS if _is_unit(self._text, self._at, unit)), "")
        self._move(self._at + len(unit))
        if unit == "degC":
            return Literal(at, Quantity(amount + ZERO_CELSIUS_K, POWERS["temperature"]))
        if not unit:
            return Literal(at, Quantity(amount))
        dimension = dimension_of(unit)
        return Literal(at, Quantity(scaled(float(amount), UNITS[dimension][unit]), POWERS[dimension]))

    def _named(self, match: re.Match[str]) -> Tree:
        at, name = match.start(), match[0]
        self._move(match.end())
        if self.sign != "(":
            return Literal(at, CONSTANTS[name]) if name in CONSTANTS else Name(at, name)
        if name not in FUNCTIONS:
            hint = did_you_mean(name, FUNCTIONS)
            raise ExpressionError(at, f"there is no function '{clean(name)}'", listing(FUNCTIONS), hint)
        values: list[Tree] = []
        while self.sign == ("," if values else "("):
            self._take()
            values.append(self.sum())
        self._close()
        return Applied(at, name, tuple(values))

    def _close(self) -> None:
        if self.sign != ")":
            raise self.wrong("an operator or ')'")
        self._take()

    def _deeper(self) -> None:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ExpressionError(
                self._at, f"this is nested more than {MAX_DEPTH} deep", "a variable for a part"
            )

    def _take(self) -> tuple[int, str]:
        at, sign = self._at, self.sign or ""
        self._move(at + len(sign))
        return at, sign

    def _move(self, at: int) -> None:
        self._at = at
        self._skip()

    def _skip(self) -> None:
        space = _SPACE.match(self._text, self._at)
        self._at = space.end() if space else self._at
        found = _SIGN.match(self._text, self._at)
        self.sign = found[0] if found else "" if self._at >= len(self._text) else None


def _is_unit(text: str, at: int, unit: str) -> bool:
    """Whether a unit stands there, and not the beginning of a name."""
    if not text.startswith(unit, at):
        return False
    after = text[at + len(unit) : at + len(unit) + 1]
    return unit == "%" or not after or not (after.isalnum() or after in "_.(")
