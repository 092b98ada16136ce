"""Numbers with dimensions, as expressions reckon with them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Final, NamedTuple

from labseq.units import UNITS, unit_names

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
        raise EvaluationError(f"{x.with_article()} has whole powers only; expected a whole number as exponent")
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
