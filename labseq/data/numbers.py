"""Numbers that runs have measured, with error and unit. Imports little, so that lists of runs are fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from labseq.units import UNITS, dimension_of, readable_unit, with_error


@dataclass(frozen=True, slots=True)
class Parameter:
    """A fitted parameter.

    Attributes:
        value: Its value in SI. Per cent values are stored as fractions.
        error: Its standard error. 0 if it was fixed.
        text_unit: SI unit for text. "%" stands for a fraction, as in "%/s".
    """

    value: float
    error: float
    text_unit: str

    @property
    def unit(self) -> str:
        """SI unit of the value. "" for none."""
        return self.text_unit.replace("%/", "1/").replace("%", "")

    def __str__(self) -> str:
        """The value with its error in a readable unit.

        Example:
            >>> str(Parameter(32.9, 0.8, "s")), str(Parameter(15e-6, 0, "K"))
            ('32.9(8) s', '15 uK (fixed)')
            >>> str(Parameter(0.97, 0.01, "%")), str(Parameter(-4e3, 1e2, "%/s"))
            ('97(1) %', '-400(10) %/ms')
        """
        unit, factor = readable(self.value, self.text_unit)
        text = f"{with_error(self.value / factor, self.error / factor)} {unit}".rstrip()
        return text if self.error else f"{text} (fixed)"

    def as_json(self) -> dict[str, Any]:
        """The parameter as JSON-ready values, SI."""
        return {"value": self.value, "error": self.error, "unit": self.unit}


def readable(value: float, unit: str) -> tuple[str, float]:
    """A unit in which an SI value is easy to read, and its factor to SI."""
    dimension = dimension_of(unit)
    if dimension and dimension != "fraction":
        unit = readable_unit(value, dimension)
        return unit, UNITS[dimension][unit]
    numerator, _, denominator = unit.partition("/")
    factor = 0.01 if numerator == "%" else 1.0
    base, _, power = denominator.partition("^")
    sizes = {
        f"{numerator}/{denominator.replace(base, one)}": factor / size ** int(power or 1)
        for one, size in UNITS.get(dimension_of(base) if base else "", {}).items()
        if one not in ("min", "h")
    }
    if not sizes or not value:
        return unit, factor
    # the smallest number that is not below 1
    best = min(sizes, key=lambda one: (abs(value) < sizes[one], abs(math.log10(abs(value) / sizes[one]))))
    return best, sizes[best]


@dataclass(frozen=True, slots=True)
class Result:
    """A number that a run has measured.

    Attributes:
        name: A fitted parameter such as "decay", or a quantity such as "survival:before,after".
        value: Its value with error and unit.
        at: The values of the other axes of the scan, as written. "" without any.
    """

    name: str
    value: Parameter
    at: str = ""

    def __str__(self) -> str:
        """Name and value, as the list of runs shows them."""
        return f"{self.name} {self.value}" + (f" at {self.at}" if self.at else "")
