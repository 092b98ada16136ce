"""The unit that an instrument wants, and SI."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

from labseq.plugin import UNITS, ZERO_CELSIUS_K, expected, format_quantity, parse_quantity, scaled

_DIMENSION_OF: Final = {unit: dimension for dimension, units in UNITS.items() for unit in units if unit}
_DIGITS: Final = 9


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of a number on the line.

    Attributes:
        name: As the profile writes it; "" for a bare number.
        dimension: One of labseq's dimensions: the number is a quantity then, in SI for the user; "" if
            labseq does not know the unit: the user's number is the one on the line.
    """

    name: str = ""
    dimension: str = ""

    @classmethod
    def of(cls, name: str) -> Self:
        """The unit of this name.

        Raises:
            ValueError: It differs from a unit that labseq knows only by its capitals.

        Example:
            >>> Unit.of("MHz").dimension, Unit.of("mA").dimension
            ('frequency', '')
        """
        if name == "degC":
            return cls(name, "temperature")
        if name in _DIMENSION_OF:
            return cls(name, _DIMENSION_OF[name])
        alike = next((known for known in _DIMENSION_OF if known.lower() == name.lower()), None)
        if alike is not None:
            raise ValueError(f"labseq knows no unit '{name}'; expected another one; did you mean '{alike}'?")
        return cls(name)

    @property
    def is_si(self) -> bool:
        """Whether the number on the line is the user's."""
        return not self.dimension or UNITS[self.dimension].get(self.name) == 1.0

    def read(self, given: object) -> float:
        """A number as the user gives it: SI, or text with a unit.

        Raises:
            ValueError: It is no finite number, or one of another dimension.
        """
        number = self._number(given)
        if not math.isfinite(number):
            raise ValueError(f"{number} is no number; expected a finite one")
        return number

    def _number(self, given: object) -> float:
        if isinstance(given, int | float) and not isinstance(given, bool):
            return float(given)
        if isinstance(given, str) and self.dimension:
            return parse_quantity(given, self.dimension)
        if isinstance(given, str) and self.name and given.strip().endswith(self.name):
            try:
                return float(given.strip().removesuffix(self.name))
            except ValueError:
                pass
        raise ValueError(f"{given!r} does not do; expected {self.expected()}")

    def expected(self) -> str:
        """What a number in this unit looks like, in words."""
        if self.dimension:
            return expected(self.dimension)
        return f"a number in {self.name}" if self.name else "a number"

    def to_line(self, number: float) -> float:
        """From SI to what is sent.

        Example:
            >>> Unit.of("MHz").to_line(80e6), Unit.of("degC").to_line(298.15)
            (80.0, 25.0)
        """
        if self.name == "degC":
            return round(number - ZERO_CELSIUS_K, 9)
        factor = UNITS[self.dimension][self.name] if self.dimension else 1.0
        return scaled(number, 1.0 / factor) if factor < 1.0 else number / factor

    def from_line(self, number: float) -> float:
        """From what was received to SI."""
        if self.name == "degC":
            return number + ZERO_CELSIUS_K
        return scaled(number, UNITS[self.dimension][self.name]) if self.dimension else number

    def shown(self, number: float) -> str:
        """A number in SI in words.

        Example:
            >>> Unit.of("kHz").shown(80e6), Unit.of("mA").shown(120.0)
            ('80 MHz', '120 mA')
        """
        if self.dimension and self.name != "degC":
            return format_quantity(number, self.dimension, _DIGITS)
        return f"{self.to_line(number):.{_DIGITS}g} {self.name}".rstrip()
