"""Conditions such as "filling:before == 1", which choose shots of a run, and runs of a data folder."""

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
from labseq.units import parse_any

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
        limit: As it was typed.
    """

    name: str
    comparison: str
    limit: str

    @classmethod
    def of(cls, text: str) -> Self:
        """The condition in a text.

        Raises:
            ConfigError: It is not one.
        """
        match = re.match(r"\s*(\S+?)\s*(==|!=|>=|<=|>|<)\s*(\S.*?)\s*\Z", text)
        if match is None:
            message = f"this is not a condition: '{clean(text)}'"
            raise ConfigError(Problem(message, "--where", expected="for example 'filling:before == 1'"))
        return cls(*match.groups())

    def of_numbers(self) -> Callable[[float], bool]:
        """The condition on a number, SI.

        Raises:
            ConfigError: The limit is not a number.
        """
        try:
            is_plain = re.fullmatch(r"[-+.\deE]+", self.limit)
            limit = float(self.limit) if is_plain else parse_any(self.limit)[0]
        except ValueError as error:
            expected = "a number, or one with a unit"
            raise ConfigError(Problem(str(error), "--where", expected=expected)) from error
        return lambda value: _COMPARISONS[self.comparison](value, limit)

    def of_texts(self) -> Callable[[str], bool]:
        """The condition on a text.

        Raises:
            ConfigError: It is not one of equality.
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
        value_of, is_text = _values_of_shots(run, condition.name)
        meets: Callable[[Any], bool] = condition.of_texts() if is_text else condition.of_numbers()
        shots = tuple(shot for shot in shots if meets(value_of(shot)))
    return shots


def _values_of_shots(run: Run, name: str) -> tuple[Callable[[Shot], Any], bool]:
    """The values of a column of the export, or of a quantity, and whether they are text."""
    columns = {column.name: column for column in columns_of(run)}
    if name in columns:
        values = columns[name].values
        of_shot = dict(zip((shot.index for shot in run.shots), values.tolist(), strict=True))
        return lambda shot: of_shot[shot.index], values.dtype == object
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
    return find_quantity(run, name).of_shot, False
