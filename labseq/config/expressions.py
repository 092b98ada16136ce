"""Expressions between values, with units.

Grammar, the weakest first::

    sum     = product (("+" | "-") product)*
    product = signed (("*" | "/") signed)*
    signed  = ("+" | "-")* power
    power   = atom ("**" signed)?
    atom    = number unit? | name | function "(" sum ("," sum)* ")" | "(" sum ")"

There are no attributes, no indices and no calls but of the functions that are listed.

A scalar that begins with "=" is an expression; "==" stands for text that begins with "=". Every
expression is worked out once, whatever refers to it, and the tree is the file's own otherwise.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple

from labseq.config.addresses import find
from labseq.config.yaml_nodes import Mark, Node
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, did_you_mean, listing, shown
from labseq.units import UNITS, ZERO_CELSIUS_K, dimension_of, parse_any, scaled, unit_names

Number = int | float
Powers = tuple[int, ...]
"""Powers of s, m, V, W, K and rad."""

NONE: Final[Powers] = (0, 0, 0, 0, 0, 0)
POWERS: Final[dict[str, Powers]] = {
    "time": (1, 0, 0, 0, 0, 0),
    "length": (0, 1, 0, 0, 0, 0),
    "frequency": (-1, 0, 0, 0, 0, 0),
    "speed": (-1, 1, 0, 0, 0, 0),
    "voltage": (0, 0, 1, 0, 0, 0),
    "power": (0, 0, 0, 1, 0, 0),
    "temperature": (0, 0, 0, 0, 1, 0),
    "angle": (0, 0, 0, 0, 0, 1),
    "fraction": NONE,
}
"""Dimension -> its powers; those of the keys of :data:`labseq.units.UNITS`."""
_BASES: Final = ("s", "m", "V", "W", "K", "rad")
_ANGLE: Final = POWERS["angle"]
_MAX_POWER: Final = 12
_MAX_EXPONENT: Final = 1000
EXACT: Final = 2**53
"""From here on whole numbers are kept as any other."""


class Quantity(NamedTuple):
    """A number in SI, and the powers of its units."""

    amount: Number
    powers: Powers = NONE

    @property
    def dimension(self) -> str:
        """Its dimension in words: "time", "number", "a product in m s"."""
        if self.powers == NONE:
            return "number"
        known = next((name for name, powers in POWERS.items() if powers == self.powers), None)
        return known or f"quantity in {self.unit}"

    @property
    def unit(self) -> str:
        """Its SI unit, "" for a number; in powers of the base units if it has no name."""
        if self.powers == NONE:
            return ""
        known = next((name for name, powers in POWERS.items() if powers == self.powers), None)
        if known is not None:
            return next(unit for unit in unit_names(known) if UNITS[known][unit] == 1.0)
        pairs = zip(_BASES, self.powers, strict=True)
        return " ".join(base if power == 1 else f"{base}^{power}" for base, power in pairs if power)

    def with_article(self) -> str:
        """With its article: "a time", "an angle", "a number"."""
        return f"{'an' if self.dimension[0] in 'aeio' else 'a'} {self.dimension}"


class EvaluationError(ValueError):
    """Something that cannot be worked out, in words."""


def negative(x: Quantity) -> Quantity:
    """-x."""
    return Quantity(-x.amount, x.powers)


def combined(sign: str, x: Quantity, y: Quantity) -> Quantity:
    """Work out ``x sign y``.

    Raises:
        EvaluationError: The dimensions do not go together, or there is no such number.
    """
    match sign:
        case "+" | "-":
            _require_alike(x, y, "added" if sign == "+" else "subtracted")
            act = operator.add if sign == "+" else operator.sub
            return _quantity(act(x.amount, y.amount), x.powers)
        case "*":
            powers = tuple(a + b for a, b in zip(x.powers, y.powers, strict=True))
            return _quantity(x.amount * y.amount, powers)
        case "/":
            if y.amount == 0:
                raise EvaluationError("this divides by zero")
            powers = tuple(a - b for a, b in zip(x.powers, y.powers, strict=True))
            is_whole = isinstance(x.amount, int) and isinstance(y.amount, int) and x.amount % y.amount == 0
            return _quantity(x.amount // y.amount if is_whole else x.amount / y.amount, powers)
        case _:
            return _power(x, y)


def applied(name: str, values: list[Quantity]) -> Quantity:
    """The value of a function of :data:`FUNCTIONS`.

    Raises:
        EvaluationError: It takes no such values.
    """
    (least, most), act = FUNCTIONS[name]
    if not least <= len(values) <= most:
        wanted = "1 value" if most == 1 else f"{least} values or more"
        raise EvaluationError(f"{name}() takes {wanted}, not {len(values)}")
    return act(name, values)


def _quantity(amount: Number, powers: Powers) -> Quantity:
    if isinstance(amount, int) and abs(amount) >= EXACT:
        amount = float(amount)
    if not math.isfinite(amount):
        raise EvaluationError("this is too large a number")
    if any(abs(power) > _MAX_POWER for power in powers):
        raise EvaluationError(f"powers of units go up to {_MAX_POWER}")
    return Quantity(amount, powers)


def _power(x: Quantity, y: Quantity) -> Quantity:
    if y.powers != NONE or abs(y.amount) > _MAX_EXPONENT:
        came = y.with_article() if y.powers != NONE else f"{y.amount:g}"
        raise EvaluationError(
            f"the exponent is {came}; expected a number from -{_MAX_EXPONENT} to {_MAX_EXPONENT}"
        )
    if x.powers != NONE and not isinstance(y.amount, int):
        raise EvaluationError(
            f"{x.with_article()} has whole powers only; expected a whole number as exponent"
        )
    if x.amount == 0 and y.amount < 0:
        raise EvaluationError("this divides by zero")
    if x.amount < 0 and y.amount != int(y.amount):
        raise EvaluationError("a negative number has no such power")
    amount: Number = float(x.amount) ** y.amount  # by floats first: they cannot grow without end
    if isinstance(x.amount, int) and isinstance(y.amount, int) and y.amount >= 0 and abs(amount) < EXACT:
        amount = x.amount**y.amount
    return _quantity(amount, tuple(power * int(y.amount) for power in x.powers))


def _require_alike(x: Quantity, y: Quantity, done: str) -> None:
    if x.powers != y.powers:
        what = f"{x.with_article()} and {y.with_article()} cannot be {done}"
        is_bare = NONE in (x.powers, y.powers)
        raise EvaluationError(what + ("; give the number its unit" if is_bare else ""))


_Act = Callable[[str, list[Quantity]], Quantity]


def _plain(act: Callable[[float], Number], *, angles: bool = False) -> _Act:
    """A function of a number without a unit."""

    def apply(name: str, values: list[Quantity]) -> Quantity:
        (x,) = values
        if x.powers != NONE and not (angles and x.powers == _ANGLE):
            raise EvaluationError(
                f"{name}() of {x.with_article()}; expected a number{' or an angle' if angles else ''}"
            )
        return _quantity(act(x.amount), NONE)

    return apply


def _root(name: str, values: list[Quantity]) -> Quantity:
    (x,) = values
    if any(power % 2 for power in x.powers):
        raise EvaluationError(f"{name}() of {x.with_article()} has no unit")
    return _quantity(math.sqrt(x.amount), tuple(power // 2 for power in x.powers))


def _extreme(name: str, values: list[Quantity]) -> Quantity:
    for value in values[1:]:
        _require_alike(values[0], value, "compared")
    return (min if name == "min" else max)(values, key=lambda value: value.amount)


def _absolute(name: str, values: list[Quantity]) -> Quantity:
    del name
    return Quantity(abs(values[0].amount), values[0].powers)


_ONE: Final = (1, 1)
FUNCTIONS: Final[dict[str, tuple[tuple[int, int], _Act]]] = {
    "sqrt": (_ONE, _root),
    "exp": (_ONE, _plain(math.exp)),
    "log": (_ONE, _plain(math.log)),
    "sin": (_ONE, _plain(math.sin, angles=True)),
    "cos": (_ONE, _plain(math.cos, angles=True)),
    "tan": (_ONE, _plain(math.tan, angles=True)),
    "floor": (_ONE, _plain(math.floor)),
    "ceil": (_ONE, _plain(math.ceil)),
    "round": (_ONE, _plain(round)),
    "abs": (_ONE, _absolute),
    "min": ((2, 20), _extreme),
    "max": ((2, 20), _extreme),
}
"""Name -> least and most number of values, and the function."""
CONSTANTS: Final = {"pi": Quantity(math.pi)}


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


MAX_CHAIN: Final = 50
"""Most expressions that refer to each other in a row."""

_SCAN: Final = "scan"
_KNOWN: Final = "an expression knows what stands in its own file, not defaults"
_LINE_BREAK: Final = re.compile(r"\r\n|\r|\n")


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """The expressions of a file.

    Attributes:
        written: The file with its expressions.
        root: The same with their values.
        texts: Where each expression is, and its text.
        reads: Where each expression is, and everything that its value follows from, at whatever distance.
    """

    written: Node
    root: Node
    texts: Mapping[Loc, str]
    reads: Mapping[Loc, frozenset[Loc]]

    def following(self, loc: Loc) -> list[Loc]:
        """The expressions whose values follow from a value, or from a part of it."""
        return [own for own, read in self.reads.items() if any(overlap(loc, other) for other in read)]


def overlap(one: Loc, other: Loc) -> bool:
    """Whether one location is within the other."""
    n = min(len(one), len(other))
    return one[:n] == other[:n]


def evaluate(root: Node, name: str, text: str) -> Expressions:
    """Work out all expressions of a file.

    Args:
        root: The file.
        name: Its name in messages.
        text: Its text, for places within expressions.

    Raises:
        ConfigError: Everything that is wrong with them.
    """
    evaluator = _Evaluator(root, name, text)
    result = evaluator.replaced(root, ())
    if evaluator.problems:
        raise ConfigError(evaluator.problems)
    return Expressions(root, result, evaluator.texts, evaluator.reads)


def is_expression(node: Node) -> bool:
    """Whether a value is to be worked out."""
    return isinstance(node.value, str) and node.value.startswith("=") and not node.value.startswith("==")


class _BadReferenceError(Exception):
    """What an expression refers to is wrong, and has been told."""


class _Evaluator:
    def __init__(self, root: Node, name: str, text: str) -> None:
        self._root, self._name = root, name
        self._lines = _LINE_BREAK.split(text)
        self._values: dict[Loc, Quantity | None] = {}  # None: wrong
        self._stack: list[Loc] = []
        self.problems: list[Problem] = []
        self.texts: dict[Loc, str] = {}
        self.reads: dict[Loc, frozenset[Loc]] = {}

    def replaced(self, node: Node, loc: Loc) -> Node:
        """A value with its expressions worked out; the same object if there are none."""
        if isinstance(node.value, dict):
            children = {key: self.replaced(child, (*loc, key)) for key, child in node.value.items()}
            is_same = all(children[key] is child for key, child in node.value.items())
            return node if is_same else replace(node, value=children)
        if isinstance(node.value, list):
            items = [self.replaced(child, (*loc, i)) for i, child in enumerate(node.value)]
            is_same = all(new is old for new, old in zip(items, node.value, strict=True))
            return node if is_same else replace(node, value=items)
        if is_expression(node):
            return self._worked_out(node, loc)
        if isinstance(node.value, str) and node.value.startswith("==") and loc[:1] != (_SCAN,):
            return replace(node, value=node.value[1:], raw=node.raw[1:])
        return node

    def _worked_out(self, node: Node, loc: Loc) -> Node:
        if loc[:1] == (_SCAN,):
            hint = "scan a variable, and let others follow from it"
            self._note(node, 0, "an expression cannot stand in a scan", "a value", hint)
            return node
        self.texts[loc] = str(node.value)
        try:
            value = self._of(loc, node)
            return replace(node, **_scalar(value))
        except _BadReferenceError:
            return node
        except EvaluationError as error:
            self._note(node, 0, str(error))
            return node

    def _of(self, loc: Loc, node: Node) -> Quantity:
        """The value of an expression.

        Raises:
            _BadReferenceError: It is wrong; that has been told.
        """
        if loc not in self._values:
            self._values[loc] = None
            self._stack.append(loc)
            self.reads[loc] = frozenset()
            try:
                self._values[loc] = self._value(parse(str(node.value)))
            except ExpressionError as error:
                self._note(node, error.at, error.what, error.expected, error.hint)
            except _BadReferenceError:
                pass
            finally:
                self._stack.pop()
        value = self._values[loc]
        if value is None:
            raise _BadReferenceError
        return value

    def _value(self, tree: Tree) -> Quantity:
        try:
            match tree:
                case Literal():
                    return tree.value
                case Name():
                    return self._named(tree)
                case Negated():
                    return negative(self._value(tree.of))
                case Combined():
                    return combined(tree.sign, self._value(tree.left), self._value(tree.right))
                case Applied():
                    return applied(tree.name, [self._value(one) for one in tree.values])
        except EvaluationError as error:
            raise ExpressionError(tree.at, str(error)) from None
        except OverflowError:
            raise ExpressionError(tree.at, "this is too large a number") from None
        except ValueError as error:
            if isinstance(error, ExpressionError):
                raise
            raise ExpressionError(tree.at, "this function has no value there") from None

    def _named(self, tree: Name) -> Quantity:
        """What stands at an address."""
        own, called = self._stack[-1], clean(tree.address)
        try:
            loc = find(self._root, tree.address, self._name, "")
        except ConfigError as error:
            (problem,) = error.problems
            raise ExpressionError(tree.at, problem.what, problem.expected, problem.hint or _KNOWN) from None
        node = self._root.at(loc)
        if node is None:
            around = self._root.at(loc[:-1])
            near = around.value if around is not None and isinstance(around.value, dict) else {}
            hint = did_you_mean(str(loc[-1]), near) or _KNOWN
            raise ExpressionError(tree.at, f"there is no '{called}' in this file", hint=hint)
        self.reads[own] |= {loc}
        if not is_expression(node):
            return self._given(tree, node)
        if loc in self._stack:
            ring = [*self._stack[self._stack.index(loc) :], loc]
            way = " -> ".join(".".join(map(str, one)) for one in ring)
            raise ExpressionError(tree.at, f"this goes round in a circle: {clean(way)}")
        if len(self._stack) >= MAX_CHAIN:
            what = f"more than {MAX_CHAIN} expressions refer to each other in a row"
            raise ExpressionError(tree.at, what)
        value = self._of(loc, node)
        self.reads[own] |= self.reads[loc]
        return value

    def _given(self, tree: Name, node: Node) -> Quantity:
        """A value that is written."""
        value = node.value
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return Quantity(value)
        try:
            amount, dimension = parse_any(value if isinstance(value, str) else "")
        except ValueError:
            what = f"'{clean(tree.address)}' is {shown(node.plain(), node.raw)}"
            raise ExpressionError(tree.at, what, "a number or a quantity") from None
        return Quantity(amount, POWERS[dimension])

    def _note(self, node: Node, at: int, what: str, expected: str = "", hint: str = "") -> None:
        mark, text = node.mark, str(node.value)
        offset = self._offset(mark, text)
        if offset is not None:
            mark = mark._replace(column=mark.column + offset + at)
        elif at:
            what += f" (character {at + 1} of '{clean(text)}')"
        self.problems.append(mark.problem(self._name, what, expected, hint))

    def _offset(self, mark: Mark, text: str) -> int | None:
        """How far after its mark a text begins; None if it does not stand in the file as it is."""
        if mark.origin or not 0 < mark.line <= len(self._lines):
            return None
        line = self._lines[mark.line - 1][mark.column - 1 :]
        if line.startswith(text):
            return 0
        return 1 if line[:1] in ("'", '"') and line[1:].startswith(text) else None


def _scalar(value: Quantity) -> dict[str, str | int | float]:
    """A result as somebody would have written it, without the dust of rounding.

    Raises:
        EvaluationError: No setting has such a unit.
    """
    tidy = value.amount
    short = float(f"{tidy:.15g}")
    if isinstance(tidy, float) and len(repr(short)) < len(repr(tidy)) - 1:
        tidy = short
    if not value.unit:
        return {"value": tidy, "raw": repr(tidy)}
    if value.powers not in POWERS.values():
        raise EvaluationError(f"the result is in {value.unit}, which is no unit of any setting")
    text = f"{tidy!r} {value.unit}"
    return {"value": text, "raw": text}
