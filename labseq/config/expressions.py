"""Values that follow from others: ``exposure: = 2 * shot.1.image.exposure``.

A scalar that begins with "=" is an expression; "==" stands for text that begins with "=". Every
expression is worked out once, whatever refers to it, and the tree is the file's own otherwise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from labseq.config.addresses import find
from labseq.config.expressions_parsing import (
    Applied,
    Combined,
    ExpressionError,
    Literal,
    Name,
    Negated,
    Tree,
    parse,
)
from labseq.config.expressions_values import POWERS, Quantity, EvaluationError, applied, combined, negative
from labseq.config.nodes import Loc, Mark, Node
from labseq.config.wording import clean, did_you_mean, shown
from labseq.errors import ConfigError, Problem
from labseq.units import parse_any

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
