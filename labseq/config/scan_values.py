"""The values that a scan gives for an address: a list, ``linspace`` or ``range``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from labseq.config.yaml_nodes import Mark, Node
from labseq.errors import ConfigError
from labseq.messages import clean, did_you_mean, listing, shown
from labseq.units import UNITS, dimension_of, factor_of, scaled, split_quantity

MAX_POINTS: Final = 10_000
"""Maximum number of points of a scan, and of values of an address."""


class Number(NamedTuple):
    """A number as written: 50, its unit "um/ms" ("" if it has none), and whether it is whole."""

    amount: float
    unit: str
    is_whole: bool

    @property
    def si(self) -> float:
        """The value in SI."""
        return scaled(self.amount, factor_of(self.unit))


def numbers_of(nodes: Sequence[Node], name: str) -> list[Number]:
    """Read numbers of one dimension, all in the unit of the first.

    Raises:
        ConfigError: One is no number, or is of another dimension than the first.
    """
    numbers: list[Number] = []
    for node in nodes:
        number, first = _number(node, name), numbers[0] if numbers else None
        if first is not None and dimension_of(number.unit) != dimension_of(first.unit):
            dimension = dimension_of(first.unit)
            what = f"{shown(node.plain(), node.raw)} does not go with {shown(nodes[0].plain(), nodes[0].raw)}"
            expected = f"a {dimension} with its unit" if dimension else "a number without a unit"
            raise scan_error(node.mark, name, what, expected)
        if first is not None and number.unit != first.unit:
            number = Number(number.si / factor_of(first.unit), first.unit, is_whole=False)
        numbers.append(number)
    return numbers


def _number(node: Node, name: str) -> Number:
    value = node.value
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return Number(float(value), "", isinstance(value, int))
    amount, unit = split_quantity(value) if isinstance(value, str) else (math.nan, "")
    if not math.isfinite(amount) or not any(unit in units for units in UNITS.values() if unit):
        what = f"{shown(node.plain(), node.raw)} is among the limits of a scan"
        raise scan_error(node.mark, name, what, "a number, or a number with a unit such as '50 um/ms'")
    return Number(amount, unit, is_whole=False)


_VALUES: Final = "a list such as [3, 5, 7], {linspace: [50 um/ms, 200 um/ms, 4]} or {range: [0, 20, 5]}"
_FORMS: Final = {
    "linspace": "[first, last, number of values]",
    "range": "[start, stop, step]",
}
_TOLERANCE: Final = 1e-9  # of a step: rounding must not drop the last value of a range


def values_of(node: Node, address: str, name: str) -> list[Node]:
    """The values that an address takes, each with its place.

    Args:
        node: The values in the scan.
        address: The address, for messages.
        name: The sequence's name in messages.

    Raises:
        ConfigError: It is no list, ``linspace`` or ``range``, is empty, or has more than
            :data:`MAX_POINTS` values.
    """
    if isinstance(node.value, list):
        if not node.value:
            raise scan_error(node.mark, name, f"the scan of '{clean(address)}' has no values", _VALUES)
        return node.value
    if not isinstance(node.value, dict) or len(node.value) != 1:
        what = f"the scan of '{clean(address)}' is {shown(node.plain(), node.raw)}"
        raise scan_error(node.mark, name, what, _VALUES)
    kind, given = next(iter(node.value.items()))
    if kind not in _FORMS:
        what = f"'{clean(kind)}' is no way to give values"
        raise scan_error(node.keys[kind], name, what, listing(_FORMS), did_you_mean(kind, _FORMS))
    if not isinstance(given.value, list) or len(given.value) != 3:
        raise scan_error(given.mark, name, f"{kind} is {shown(given.plain(), given.raw)}", _FORMS[kind])
    limits = given.value
    amounts, first = _linspace(limits, name) if kind == "linspace" else _range(given.mark, limits, name)
    return [_written_node(float(f"{amount:.12g}"), first, given.mark) for amount in amounts]


def _linspace(limits: list[Node], name: str) -> tuple[list[float], Number]:
    """The values of a ``linspace``, in the unit of the first; integers if both ends are integers."""
    (first, last), count = numbers_of(limits[:2], name), limits[2]
    if type(count.value) is not int or not 2 <= count.value <= MAX_POINTS:
        what = f"the number of values is {shown(count.plain(), count.raw)}"
        raise scan_error(count.mark, name, what, f"a whole number from 2 to {MAX_POINTS}")
    amounts = np.linspace(first.amount, last.amount, count.value).tolist()
    return amounts, first._replace(is_whole=first.is_whole and last.is_whole)


def _range(mark: Mark, limits: list[Node], name: str) -> tuple[list[float], Number]:
    """The values of a ``range``, in the unit of its start; integers if start and step are integers."""
    start, stop, step = numbers_of(limits, name)
    n_steps = (stop.amount - start.amount) / step.amount if step.amount else math.nan
    if not n_steps >= 0:
        what = f"the step {shown(limits[2].plain(), limits[2].raw)} does not lead from start to stop"
        raise scan_error(limits[2].mark, name, what, "a step towards the stop")
    if n_steps >= MAX_POINTS:
        raise scan_error(mark, name, f"the range has {n_steps:.3g} values", f"at most {MAX_POINTS}")
    amounts = [start.amount + i * step.amount for i in range(math.floor(n_steps + _TOLERANCE) + 1)]
    return amounts, start._replace(is_whole=start.is_whole and step.is_whole)


def _written_node(amount: float, like: Number, mark: Mark) -> Node:
    """A value as a user would write it: with the unit, without rounding errors."""
    if like.unit:
        text = f"{amount:.12g} {like.unit}"
        return Node(text, mark, raw=text)
    value = int(amount) if like.is_whole and amount.is_integer() else amount
    return Node(value, mark, raw=repr(value))


def scan_error(mark: Mark, name: str, what: str, expected: str, hint: str = "") -> ConfigError:
    """Create an error at a place in the sequence; ``name`` is that of the sequence in messages."""
    return ConfigError(mark.problem(name, what, expected, hint))
