"""Conditions such as "filling:before == 1", which select shots of a run or runs of a data folder."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from labseq.data.columns import columns_of
from labseq.data.quantities import find_quantity
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, closest
from labseq.model.image_quantities import OF_IMAGES, parse_name
from labseq.units import dimension_of, parse_any

_COMPARISONS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    # a computed value and a typed one differ in their last digits
    "==": lambda a, b: math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12),
    "!=": lambda a, b: not math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12),
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}


@dataclass(frozen=True, slots=True)
class Condition:
    """A comparison of a named value with a limit.

    Attributes:
        name: Name of the value.
        comparison: One of ``==``, ``!=``, ``>=``, ``<=``, ``>`` and ``<``.
        limit: The limit as it was typed.
    """

    name: str
    comparison: str
    limit: str

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse a condition.

        Raises:
            ConfigError: The text is not a condition.
        """
        match = re.match(r"\s*(\S+?)\s*(==|!=|>=|<=|>|<)\s*(\S.*?)\s*\Z", text)
        if match is None:
            message = f"'{clean(text)}' is not a condition"
            raise ConfigError(Problem(message, "--where", expected="for example 'filling:before == 1'"))
        return cls(*match.groups())

    def of_numbers(self, unit: str = "") -> Callable[[float], bool]:
        """The condition as a function of a number in SI. It is false for nan.

        Args:
            unit: SI unit of the number. "" for a fraction, or if it is unknown.

        Raises:
            ConfigError: The limit is not a number, or has another unit.
        """
        try:
            is_plain = re.fullmatch(r"[-+.\deE]+", self.limit)
            limit, dimension = (float(self.limit), "") if is_plain else parse_any(self.limit)
        except ValueError as error:
            expected = "a number, or one with a unit"
            raise ConfigError(Problem(str(error), "--where", expected=expected)) from error
        if unit and dimension not in ("", dimension_of(unit)):
            what = f"'{clean(self.limit)}' does not have the unit of '{clean(self.name)}'"
            raise ConfigError(Problem(what, "--where", expected=f"a number in {unit}, or one with its unit"))
        return lambda value: not math.isnan(value) and _COMPARISONS[self.comparison](value, limit)

    def of_texts(self) -> Callable[[str], bool]:
        """The condition as a function of text.

        Raises:
            ConfigError: The comparison is not == or !=.
        """
        if self.comparison not in ("==", "!="):
            what = f"'{self.comparison}' does not compare text"
            raise ConfigError(Problem(what, "--where", expected="== or !="))
        return lambda value: (value == self.limit) == (self.comparison == "==")


def select_shots(run: Run, conditions: Iterable[str]) -> tuple[Shot, ...]:
    """The shots of a run that meet every condition.

    Raises:
        ConfigError: A condition cannot be read, or names neither a quantity nor a column of the run.
    """
    shots = tuple(run.shots)
    for condition in map(Condition.of, conditions):
        meets = _meets(run, condition)
        shots = tuple(shot for shot in shots if meets(shot))
    return shots


def _meets(run: Run, condition: Condition) -> Callable[[Shot], bool]:
    """A function that tells whether a shot meets a condition on an exported column or a quantity."""
    name, columns = condition.name, {column.name: column for column in columns_of(run)}
    if name in columns:
        values, unit = columns[name].values, columns[name].units
        of_shot = dict(zip((shot.index for shot in run.shots), values.tolist(), strict=True))
        of_value: Callable[[Any], bool] = (
            condition.of_texts() if values.dtype == object else condition.of_numbers(unit)
        )
        return lambda shot: of_value(of_shot[shot.index])
    if parse_name(name).kind not in OF_IMAGES:
        near = closest(name, [*columns, *OF_IMAGES])
        raise ConfigError(
            Problem(
                f"there is no quantity or column '{clean(name)}'",
                "--where",
                expected="a quantity, such as filling:before, or a column of labseq export",
                hint=f"did you mean '{near}'?" if near else "",
            )
        )
    quantity, of_number = find_quantity(run, name), condition.of_numbers()
    return lambda shot: of_number(quantity.of_shot(shot))
