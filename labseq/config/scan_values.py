"""The values of one scanned address: a list, ``linspace`` or ``range``, with units."""

from __future__ import annotations

import math
import re
from typing import Final, NamedTuple

import numpy as np

from labseq.config.nodes import Mark, Node
from labseq.config.wording import clean, did_you_mean, listing, shown
from labseq.errors import ConfigError
from labseq.units import UNITS, scaled

MAX_POINTS: Final = 10_000
"""Most points of a scan."""

_EXPECTED: Final = "a list such as [3, 5, 7], {linspace: [50 um/ms, 200 um/ms, 4]} or {range: [0, 20, 5]}"
_FORMS: Final = {
    "linspace": "[first, last, number of values]",
    "range": "[start, stop, step]",
}
_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*)?\Z")
_FITS: Final = 1e-9  # of a step: what rounding may take from the last value of a range


class Number(NamedTuple):
    """A number as written: 50, "um/ms" and the dimension that the unit belongs to ("" without unit)."""

    amount: float
    unit: str
    dimension: str
    is_whole: bool


def values_of(node: Node, address: str, name: str) -> list[Node]:
    """The values that an address takes, each with its place.

    Args:
        node: What the scan says of the address.
        address: The address, for messages.
        name: The sequence's name in messages.

    Raises:
        ConfigError: It is no list, ``linspace`` or ``range``, is empty, or has more than
            :data:`MAX_POINTS` values.
    """
    if isinstance(node.value, list):
        if not node.value:
            raise _error(node.mark, name, f"the scan of '{clean(address)}' has no values", _EXPECTED)
        return node.value
    if not isinstance(node.value, dict) or len(node.value) != 1:
        what = f"the scan of '{clean(address)}' is {shown(node.plain(), node.raw)}"
        raise _error(node.mark, name, what, _EXPECTED)
    kind, given = next(iter(node.value.items()))
    if kind not in _FORMS:
        what = f"'{clean(kind)}' is no way to give values"
        raise _error(node.keys[kind], name, what, listing(_FORMS), did_you_mean(kind, _FORMS))
    if not isinstance(given.value, list) or len(given.value) != 3:
        raise _error(given.mark, name, f"{kind} is {shown(given.plain(), given.raw)}", _FORMS[kind])
    return _linspace(given, name) if kind == "linspace" else _range(given, name)


def _linspace(given: Node, name: str) -> list[Node]:
    assert isinstance(given.value, list)
    first, last = alike(given.value[:2], name)
    count = given.value[2]
    if type(count.value) is not int or not 2 <= count.value <= MAX_POINTS:
        what = f"the number of values is {shown(count.plain(), count.raw)}"
        raise _error(count.mark, name, what, f"a whole number from 2 to {MAX_POINTS}")
    amounts = np.linspace(first.amount, last.amount, count.value)
    return _nodes(amounts.tolist(), first, given.mark, whole=first.is_whole and last.is_whole)


def _range(given: Node, name: str) -> list[Node]:
    assert isinstance(given.value, list)
    start, stop, step = alike(given.value, name)
    way = stop.amount - start.amount
    n_steps = way / step.amount if step.amount else math.nan
    if not n_steps >= 0:
        what = (
            f"the step {shown(given.value[2].plain(), given.value[2].raw)} does not lead from start to stop"
        )
        raise _error(given.value[2].mark, name, what, "a step towards the stop")
    if n_steps >= MAX_POINTS:
        raise _error(given.mark, name, f"the range has {n_steps:.3g} values", f"at most {MAX_POINTS}")
    amounts = [start.amount + i * step.amount for i in range(math.floor(n_steps + _FITS) + 1)]
    return _nodes(amounts, start, given.mark, whole=start.is_whole and step.is_whole)


def alike(nodes: list[Node], name: str) -> list[Number]:
    """Numbers of one dimension, all in the unit of the first.

    Args:
        nodes: The numbers, with or without units.
        name: The sequence's name in messages.

    Raises:
        ConfigError: One is no number, or is of another dimension than the first.
    """
    numbers = [_number(node, name) for node in nodes]
    first = numbers[0]
    alike = [first]
    for node, number in zip(nodes[1:], numbers[1:], strict=True):
        if number.dimension != first.dimension:
            what = f"{shown(node.plain(), node.raw)} does not go with {shown(nodes[0].plain(), nodes[0].raw)}"
            dimension = first.dimension
            expected = f"a {dimension} with its unit" if dimension else "a number without a unit"
            raise _error(node.mark, name, what, expected)
        alike.append(_in_unit(number, first))
    return alike


def _number(node: Node, name: str) -> Number:
    if type(node.value) in (int, float) and math.isfinite(amount := float(node.value)):  # pyright: ignore[reportArgumentType]
        return Number(amount, "", "", isinstance(node.value, int))
    match = _NUMBER.match(node.value.strip()) if isinstance(node.value, str) else None
    unit = (match[2] or "") if match else ""
    dimension = next((known for known, units in UNITS.items() if unit and unit in units), "")
    if match is None or not dimension or not math.isfinite(float(match[1])):
        what = f"{shown(node.plain(), node.raw)} stands among the limits of a scan"
        raise _error(node.mark, name, what, "a number, or a number with a unit such as '50 um/ms'")
    return Number(float(match[1]), unit, dimension, is_whole=False)


def _in_unit(number: Number, of: Number) -> Number:
    if number.unit == of.unit:
        return number
    units = UNITS[of.dimension]
    amount = scaled(number.amount, units[number.unit]) / units[of.unit]
    return number._replace(amount=amount, unit=of.unit)


def _nodes(amounts: list[float], like: Number, mark: Mark, *, whole: bool) -> list[Node]:
    """The values as somebody would have written them: with the unit, without the dust of rounding."""
    nodes: list[Node] = []
    for amount in amounts:
        tidy = float(f"{amount:.12g}")
        if like.unit:
            text = f"{tidy:.12g} {like.unit}"
            nodes.append(Node(text, mark, raw=text))
        elif whole and tidy.is_integer():
            nodes.append(Node(int(tidy), mark, raw=str(int(tidy))))
        else:
            nodes.append(Node(tidy, mark, raw=repr(tidy)))
    return nodes


def _error(mark: Mark, name: str, what: str, expected: str, hint: str = "") -> ConfigError:
    return ConfigError(mark.problem(name, what, expected, hint))
