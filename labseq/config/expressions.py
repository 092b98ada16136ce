"""Expressions in files: ``window: = variables.hold + 5 ms``.

A scalar that begins with "=" is an expression. To write text that begins with "=", begin it with "==".
Numbers, quantities and addresses are cut out and replaced by a name of one letter. Python's ``ast`` parses
the rest, which may only contain operators, brackets and calls of the functions listed here.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from typing import Final, NamedTuple

from labseq.config.addresses import find
from labseq.config.yaml_nodes import Node
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, did_you_mean, listing, shown
from labseq.units import UNITS, ZERO_CELSIUS_K, dimension_of, parse_any, scaled, unit_names

Number = int | float
Powers = tuple[int, ...]
"""Exponents of the units s, m, V, W, K and rad."""

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
"""Dimension, a key of :data:`labseq.units.UNITS` -> its exponents."""
_BASES: Final = ("s", "m", "V", "W", "K", "rad")
_DIMENSIONS: Final = {powers: name for name, powers in POWERS.items()} | {NONE: "number"}

MAX_LENGTH: Final = 500
"""Maximum length of an expression, in characters."""
MAX_PARTS: Final = 200
"""Maximum number of values, operators and functions in an expression."""
MAX_PROBLEMS: Final = 60
"""Maximum number of wrong expressions that are examined. Not all of them are shown."""
_MAX_POWER: Final = 12
_MAX_EXPONENT: Final = 1000
_EXACT: Final = 2**53  # from here on, whole numbers are kept as floats


class ExpressionError(ValueError):
    """An error in an expression.

    Attributes:
        at: Index of the character. None until it is known.
        problem: The error, the expected value and the remedy.
    """

    def __init__(self, what: str, expected: str = "", hint: str = "", at: int | None = None) -> None:
        self.at, self.problem = at, Problem(what, expected=expected, hint=hint)
        super().__init__(what)


class Quantity(NamedTuple):
    """A number in SI units, and the exponents of the units."""

    amount: Number
    powers: Powers = NONE

    @property
    def unit(self) -> str:
        """The SI unit of the quantity, or "" for a plain number."""
        dimension = _DIMENSIONS.get(self.powers, "")
        if dimension == "number":
            return ""
        if dimension:
            return next(unit for unit in unit_names(dimension) if UNITS[dimension][unit] == 1.0)
        pairs = zip(_BASES, self.powers, strict=True)
        return " ".join(base if power == 1 else f"{base}^{power}" for base, power in pairs if power)

    @property
    def kind(self) -> str:
        """The dimension with an article, such as "a time", "an angle" or "a number"."""
        dimension = _DIMENSIONS.get(self.powers) or f"quantity in {self.unit}"
        return f"{'an' if dimension[0] in 'aeio' else 'a'} {dimension}"


def _checked(amount: Number, powers: Powers) -> Quantity:
    if isinstance(amount, int) and abs(amount) >= _EXACT:
        amount = float(amount)
    if not math.isfinite(amount):
        raise ExpressionError("this number is too large")
    if any(abs(power) > _MAX_POWER for power in powers):
        raise ExpressionError(f"powers of units go up to {_MAX_POWER}")
    return Quantity(amount, powers)


def _require_same_unit(x: Quantity, y: Quantity, done: str) -> None:
    if x.powers != y.powers:
        hint = "give the number its unit" if NONE in (x.powers, y.powers) else ""
        raise ExpressionError(f"{x.kind} and {y.kind} cannot be {done}", hint=hint)


def _add(x: Quantity, y: Quantity) -> Quantity:
    _require_same_unit(x, y, "added")
    return _checked(x.amount + y.amount, x.powers)


def _subtract(x: Quantity, y: Quantity) -> Quantity:
    _require_same_unit(x, y, "subtracted")
    return _checked(x.amount - y.amount, x.powers)


def _multiply(x: Quantity, y: Quantity) -> Quantity:
    return _checked(x.amount * y.amount, tuple(map(operator.add, x.powers, y.powers)))


def _divide(x: Quantity, y: Quantity) -> Quantity:
    if y.amount == 0:
        raise ExpressionError("this divides by zero")
    # 6 / 2 stays a whole number, because settings that count something take no other
    is_whole = isinstance(x.amount, int) and isinstance(y.amount, int) and x.amount % y.amount == 0
    amount = x.amount // y.amount if is_whole else x.amount / y.amount
    return _checked(amount, tuple(map(operator.sub, x.powers, y.powers)))


def _power(x: Quantity, y: Quantity) -> Quantity:
    if y.powers != NONE or abs(y.amount) > _MAX_EXPONENT:
        came = y.kind if y.powers != NONE else f"{y.amount:g}"
        expected = f"a number from -{_MAX_EXPONENT} to {_MAX_EXPONENT}"
        raise ExpressionError(f"the exponent is {came}", expected)
    if x.powers != NONE and not isinstance(y.amount, int):
        raise ExpressionError(f"{x.kind} can only be raised to a whole power", "a whole number as exponent")
    if x.amount == 0 and y.amount < 0:
        raise ExpressionError("this divides by zero")
    if x.amount < 0 and y.amount != int(y.amount):
        raise ExpressionError("a negative number can only be raised to a whole power")
    amount: Number = float(x.amount) ** y.amount  # as floats first, because integers could grow without limit
    if isinstance(x.amount, int) and isinstance(y.amount, int) and y.amount >= 0 and abs(amount) < _EXACT:
        amount = x.amount**y.amount
    return _checked(amount, tuple(power * int(y.amount) for power in x.powers))


_OPERATORS: Final[Mapping[type[ast.operator], Callable[[Quantity, Quantity], Quantity]]] = {
    ast.Add: _add,
    ast.Sub: _subtract,
    ast.Mult: _multiply,
    ast.Div: _divide,
    ast.Pow: _power,
}
_NUMBER_FUNCTIONS: Final[Mapping[str, Callable[[float], Number]]] = {
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "floor": math.floor,
    "ceil": math.ceil,
    "round": round,
}
FUNCTIONS: Final = ("sqrt", *_NUMBER_FUNCTIONS, "abs", "min", "max")
"""The functions that an expression may call."""


def _call(name: str, values: list[Quantity]) -> Quantity:
    if name in ("min", "max"):
        if len(values) < 2:
            raise ExpressionError(f"{name}() takes 2 values or more, not {len(values)}")
        for value in values[1:]:
            _require_same_unit(values[0], value, "compared")
        return (min if name == "min" else max)(values, key=lambda value: value.amount)
    if len(values) != 1:
        raise ExpressionError(f"{name}() takes 1 value, not {len(values)}")
    x = values[0]
    if name == "abs":
        return Quantity(abs(x.amount), x.powers)
    if name == "sqrt":
        if any(power % 2 for power in x.powers):
            raise ExpressionError(f"the square root of {x.kind} has no valid unit")
        return _checked(math.sqrt(x.amount), tuple(power // 2 for power in x.powers))
    takes_angle = name in ("sin", "cos", "tan")
    if x.powers != NONE and not (takes_angle and x.powers == POWERS["angle"]):
        raise ExpressionError(f"{name}() of {x.kind}", "a number" + (" or an angle" if takes_angle else ""))
    return _checked(_NUMBER_FUNCTIONS[name](x.amount), NONE)


_UNITS: Final = "|".join(
    re.escape(unit)
    # the longest first, because "um/ms" is one unit, not "um" divided by something
    for unit in sorted({*(unit for units in UNITS.values() for unit in units), "degC"}, key=len)[::-1]
    if unit not in ("", "%")
)
_TOKEN: Final = re.compile(
    rf"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?:\s*(?P<unit>%|(?:{_UNITS})(?![\w.(])))?"
    r"|(?P<name>[^\W\d]\w*(?:\.\w+)*)|\*\*|/(?!/)|[-+*(),]|\s+"
)


@dataclass(frozen=True, slots=True)
class _Parsed:
    """An expression, parsed.

    Attributes:
        tree: The expression after every number, quantity and name is replaced by "x".
        text: The text of ``tree``.
        shift: Index of its first character in the expression.
        values: Index of each "x" in ``text`` -> the quantity, or the name.
    """

    tree: ast.expr
    text: str
    shift: int
    values: Mapping[int, Quantity | str]


@lru_cache(maxsize=256)
def _parse(text: str) -> _Parsed:
    """Parse an expression with its "=".

    Raises:
        ExpressionError: The text is not an expression, or is too long.
    """
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"the expression has {len(text)} characters", f"at most {MAX_LENGTH}", at=0)
    shift = len(text) - len(text[1:].lstrip())
    replaced, values, at = "", dict[int, Quantity | str](), shift
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            raise _unexpected(text, at)
        if token["number"] or token["name"]:
            values[at - shift] = token["name"] or _literal(token, at)
            # keep the length, so that places in the tree are places in the expression
            replaced += "x".ljust(len(token[0]))
        else:
            replaced += token[0] if token[0].strip() else " " * len(token[0])
        at = token.end()
    try:
        tree = ast.parse(replaced, mode="eval").body
    except SyntaxError as error:
        at = (error.offset or 0) - 1
        if "never closed" in error.msg:
            raise ExpressionError("the '(' that opens here is never closed", "')'", at=at + shift) from None
        raise _unexpected(text, at + shift if at >= 0 else len(text)) from None
    if sum(isinstance(node, ast.expr) for node in ast.walk(tree)) > MAX_PARTS:
        raise ExpressionError(
            f"the expression has more than {MAX_PARTS} parts", "a variable for a part", at=0
        )
    return _Parsed(tree, replaced, shift, values)


def _literal(token: re.Match[str], at: int) -> Quantity:
    number, unit = token["number"], token["unit"] or ""
    amount: Number = float(number)
    if not math.isfinite(amount):
        raise ExpressionError("this number is too large", at=at)
    if unit == "degC":
        return Quantity(amount + ZERO_CELSIUS_K, POWERS["temperature"])
    if unit:
        dimension = dimension_of(unit)
        return Quantity(scaled(amount, UNITS[dimension][unit]), POWERS[dimension])
    return Quantity(int(number) if number.isdecimal() and amount < _EXACT else amount)


def _unexpected(text: str, at: int) -> ExpressionError:
    if not text[at:].strip():
        expected = "a number, an address or '('"
        return ExpressionError("the expression ends too early", expected, at=max(0, len(text) - 1))
    expected = "numbers, addresses, functions, brackets and + - * / **"
    return ExpressionError(f"'{clean(text[at])}' is not allowed here", expected, at=at)


@dataclass(slots=True)
class _Evaluation:
    """Computes one expression.

    Attributes:
        text: The expression.
        parsed: The same, parsed.
        names: Address -> its value.
    """

    text: str
    parsed: _Parsed
    names: Mapping[str, Quantity]

    def value(self, node: ast.expr) -> Quantity:
        """The value of a part.

        Raises:
            ExpressionError: The part has no value. The error includes the place.
        """
        at = node.col_offset
        try:
            match node:
                case ast.Name():
                    value = self.parsed.values[at]
                    return self.names[value] if isinstance(value, str) else value
                case ast.UnaryOp(ast.USub(), operand):
                    x = self.value(operand)
                    return Quantity(-x.amount, x.powers)
                case ast.UnaryOp(ast.UAdd(), operand):
                    return self.value(operand)
                case ast.BinOp(left, sign, right):
                    x, y = self.value(left), self.value(right)
                    at = self._operator(left, right)
                    return _OPERATORS[type(sign)](x, y)
                case ast.Call(ast.Name() as function, arguments, []):
                    return _call(self._function(function), [self.value(argument) for argument in arguments])
                case _:
                    raise _unexpected(self.text, at + self.parsed.shift)
        except OverflowError:
            raise ExpressionError("this number is too large", at=at + self.parsed.shift) from None
        except ExpressionError as error:
            error.at = at + self.parsed.shift if error.at is None else error.at
            raise
        except ValueError:
            raise ExpressionError("this function has no value here", at=at + self.parsed.shift) from None

    def _operator(self, left: ast.expr, right: ast.expr) -> int:
        """Index of the operator between two parts, outside of their brackets."""
        between = self.parsed.text[left.end_col_offset : right.col_offset]
        return (left.end_col_offset or 0) + len(between) - len(between.lstrip(" )"))

    def _function(self, node: ast.Name) -> str:
        name = self.parsed.values[node.col_offset]
        if name in FUNCTIONS:
            return str(name)
        if isinstance(name, Quantity):
            raise _unexpected(self.text, self.text.index("(", node.col_offset + self.parsed.shift))
        what, hint = f"there is no function '{clean(name)}'", did_you_mean(name, FUNCTIONS)
        raise ExpressionError(what, listing(FUNCTIONS), hint)


_KNOWN: Final = "an expression can only use values that are written in its own file, not defaults"


def is_expression(node: Node) -> bool:
    """Whether a value is an expression."""
    return isinstance(node.value, str) and node.value.startswith("=") and not node.value.startswith("==")


def evaluate(root: Node, text: str) -> tuple[Node, dict[Loc, str], dict[Loc, frozenset[Loc]]]:
    """Compute all expressions of a file.

    Args:
        root: The file with its expressions.
        text: Its text, for places within expressions.

    Returns:
        The file with computed values, the text of each expression, and the places on which each depends.

    Raises:
        ConfigError: All errors in the expressions.
    """
    evaluator = _Evaluator(root, re.split(r"\r\n|\r|\n", text))
    result = root
    for loc, node in root.leaves():
        if is_expression(node) and loc[0] != "scan":
            evaluator.nodes[loc] = node
        elif is_expression(node):
            hint = "scan a variable, and compute other values from it"
            evaluator.report(node, ExpressionError("an expression is not allowed in a scan", "a value", hint))
        elif isinstance(node.value, str) and node.value.startswith("==") and loc[:1] != ("scan",):
            text_node = replace(node, value=node.value[1:], raw=node.raw[1:])
            result = result.replaced(loc, text_node, same_key=True)
    evaluator.compute()
    if evaluator.problems:
        raise ConfigError(evaluator.problems)
    for loc, quantity in evaluator.results.items():
        value = _scalar(quantity)
        node = replace(evaluator.nodes[loc], value=value, raw=str(value))
        result = result.replaced(loc, node, same_key=True)
    texts = {loc: str(node.value) for loc, node in evaluator.nodes.items()}
    return result, texts, evaluator.reads


@dataclass(slots=True)
class _Evaluator:
    """Computes the expressions of a file, in the order of their references."""

    root: Node
    lines: list[str]
    problems: list[Problem] = field(default_factory=list[Problem])
    nodes: dict[Loc, Node] = field(default_factory=dict[Loc, Node])
    reads: dict[Loc, frozenset[Loc]] = field(default_factory=dict[Loc, frozenset[Loc]])
    results: dict[Loc, Quantity] = field(default_factory=dict[Loc, Quantity])

    def compute(self) -> None:
        """Compute all expressions with valid references."""
        references: dict[Loc, dict[str, Loc]] = {}
        for loc, node in self.nodes.items():
            if len(self.problems) >= MAX_PROBLEMS:
                return
            try:
                references[loc] = self._references(str(node.value))
            except ExpressionError as error:
                self.report(node, error)
        graph = {
            loc: [other for other in named.values() if other in self.nodes]
            for loc, named in references.items()
        }
        sorter = TopologicalSorter(graph)
        try:
            sorter.prepare()
        except CycleError as error:
            self._report_cycle(error.args[1][::-1], references)
        # after a circular reference too, to report errors in the expressions that it does not block
        while ready := sorter.get_ready():
            for loc in ready:
                if loc in references:
                    self._compute_one(loc, references[loc])
            sorter.done(*ready)

    def _references(self, text: str) -> dict[str, Loc]:
        """The addresses in an expression, and their locations."""
        parsed = _parse(text)
        functions = {node.func.col_offset for node in ast.walk(parsed.tree) if isinstance(node, ast.Call)}
        return {
            value: self._find(value, at + parsed.shift)
            for at, value in parsed.values.items()
            if isinstance(value, str) and value != "pi" and at not in functions
        }

    def _find(self, address: str, at: int) -> Loc:
        try:
            loc = find(self.root, address)
        except ConfigError as error:
            (problem,) = error.problems
            raise ExpressionError(problem.what, problem.expected, problem.hint or _KNOWN, at) from None
        if self.root.at(loc) is None:
            around = self.root.at(loc[:-1])
            near = around.value if around is not None and isinstance(around.value, dict) else {}
            hint = did_you_mean(str(loc[-1]), near) or _KNOWN
            raise ExpressionError(f"there is no '{clean(address)}' in this file", hint=hint, at=at)
        return loc

    def _compute_one(self, loc: Loc, named: Mapping[str, Loc]) -> None:
        node, others = self.nodes[loc], [*named.values()]
        if any(other in self.nodes and other not in self.results for other in others):
            return  # the other expression has an error that is reported
        text = str(node.value)
        parsed = _parse(text)
        try:
            names = {"pi": Quantity(math.pi)}
            for address, other in named.items():
                at = next(at for at, value in parsed.values.items() if value == address)
                names[address] = self.results.get(other) or self._written(other, address, at + parsed.shift)
            result = _Evaluation(text, parsed, names).value(parsed.tree)
            if result.powers not in _DIMENSIONS:
                what = f"the result is in {result.unit}, which is not a unit of any setting"
                raise ExpressionError(what, at=0)
        except ExpressionError as error:
            self.report(node, error)
            return
        self.results[loc] = result
        self.reads[loc] = frozenset(others).union(*(self.reads.get(other, ()) for other in others))

    def _written(self, loc: Loc, address: str, at: int) -> Quantity:
        """The value of a number or a quantity in the file."""
        node = self.root.at(loc)
        assert node is not None
        value = node.value
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return Quantity(value)
        try:
            amount, dimension = parse_any(value if isinstance(value, str) else "")
        except ValueError:
            what = f"'{clean(address)}' is {shown(node.plain(), node.raw)}"
            raise ExpressionError(what, "a number or a quantity", at=at) from None
        return Quantity(amount, POWERS[dimension])

    def _report_cycle(self, ring: list[Loc], references: Mapping[Loc, Mapping[str, Loc]]) -> None:
        # the message starts with the expression of the circle that comes first in the file
        start = ring.index(next(loc for loc in self.nodes if loc in ring))
        ring = [*ring[start:-1], *ring[: start + 1]]
        way = " -> ".join(".".join(map(str, loc)) for loc in ring)
        parsed = _parse(str(self.nodes[ring[0]].value))
        address = next(text for text, loc in references[ring[0]].items() if loc == ring[1])
        at = next(at for at, value in parsed.values.items() if value == address) + parsed.shift
        self.report(
            self.nodes[ring[0]], ExpressionError(f"this is a circular reference: {clean(way)}", at=at)
        )

    def report(self, node: Node, error: ExpressionError) -> None:
        """Record a problem. Its column points to the character if the text is on a line of the file."""
        mark, text, at, problem = node.mark, str(node.value), error.at or 0, error.problem
        what = problem.what
        line = self.lines[mark.line - 1][mark.column - 1 :] if 0 < mark.line <= len(self.lines) else ""
        quoted = line[:1] in ("'", '"')
        if mark.source == self.root.mark.source and line[quoted:].startswith(text):
            mark = mark._replace(column=mark.column + quoted + at)
        elif at:
            what += f" (character {at + 1} of '{clean(text)}')"
        self.problems.append(mark.problem(what, problem.expected, problem.hint))


def _scalar(value: Quantity) -> Number | str:
    """A result as a user would write it, without rounding errors in the last digits."""
    tidy = value.amount
    short = float(f"{tidy:.15g}")
    if isinstance(tidy, float) and len(repr(short)) < len(repr(tidy)) - 1:
        tidy = short
    return f"{tidy!r} {value.unit}" if value.unit else tidy
