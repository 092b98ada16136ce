"""Quantities with units, converted to plain SI numbers.

Only YAML files and displays use units such as "45 ms". All values inside labseq and on disk are SI. In Python
a plain number is in SI. In a file it needs its unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_MICRO = ("u", "µ", "μ")  # ASCII, MICRO SIGN, GREEK SMALL LETTER MU


def _with_micro(units: dict[str, float]) -> Mapping[str, float]:
    """Add the variants with both micro signs for every unit with "u"."""
    spelled = dict(units)
    for unit, factor in units.items():
        if unit.startswith("u"):
            spelled |= {micro + unit[1:]: factor for micro in _MICRO}
    return MappingProxyType(spelled)


UNITS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "time": _with_micro({"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}),
        "length": _with_micro({"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}),
        "frequency": MappingProxyType({"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9}),
        "speed": _with_micro(
            {"m/s": 1.0, "mm/s": 1e-3, "mm/ms": 1.0, "um/ms": 1e-3, "um/us": 1.0, "um/s": 1e-6}
        ),
        "voltage": _with_micro({"V": 1.0, "mV": 1e-3, "uV": 1e-6}),
        "power": _with_micro({"W": 1.0, "mW": 1e-3, "uW": 1e-6}),
        "temperature": _with_micro({"K": 1.0, "mK": 1e-3, "uK": 1e-6}),
        "angle": MappingProxyType({"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0}),
        "fraction": MappingProxyType({"%": 1e-2, "": 1.0}),
    }
)
"""Dimension -> unit -> factor to SI."""

EXAMPLES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "time": "45 ms",
        "length": "4.49 um",
        "frequency": "80 MHz",
        "speed": "130 um/ms",
        "voltage": "200 mV",
        "power": "10 mW",
        "temperature": "300 uK",
        "angle": "60 deg",
        "fraction": "75 %",
    }
)
"""Dimension -> an example of a quantity."""


ZERO_CELSIUS_K: Final = 273.15
"""0 degC in kelvins. degC is the only unit with a different zero."""

_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*?)?\s*\Z")


def parse_quantity(text: str, dimension: str) -> float:
    """Convert a quantity such as "45 ms" to SI.

    Args:
        text: A number and a unit. The space between them may be left out.
        dimension: A key of :data:`UNITS`.

    Returns:
        The value in the SI unit of the dimension.

    Raises:
        ValueError: The text is not a quantity, or its unit is of another dimension.

    Example:
        >>> parse_quantity("45 ms", "time")
        0.045
        >>> parse_quantity("130 um/ms", "speed")
        0.13
    """
    units = UNITS[dimension]
    match = _NUMBER.match(text)
    if match is None:
        raise ValueError(f"'{text}' is not {_a(dimension)}; expected {expected(dimension)}")
    unit = match[2] or ""
    if unit == "degC" and dimension == "temperature":
        return float(match[1]) + ZERO_CELSIUS_K
    if unit not in units:
        other = next(
            (name for name, units_of_dimension in UNITS.items() if unit in units_of_dimension and unit), None
        )
        if not unit:
            hint = f"write {with_units(match[1], dimension)}"
            raise ValueError(f"'{text}' has no unit; expected {expected(dimension)}; {hint}")
        if other is not None:
            fault = f"'{text}' is {_a(other)}, not {_a(dimension)}"
        else:
            fault = f"'{unit}' in '{text}' is not a unit of {dimension}"
        raise ValueError(f"{fault}; expected {expected(dimension)}")
    return scaled(float(match[1]), units[unit])


def split_quantity(text: str) -> tuple[float, str]:
    """Split a quantity into its number and unit as written. nan and "" for other text.

    Example:
        >>> split_quantity("45 ms")
        (45.0, 'ms')
    """
    match = _NUMBER.match(text)
    return (math.nan, "") if match is None else (float(match[1]), match[2] or "")


def parse_any(text: str) -> tuple[float, str]:
    """Convert a quantity of any dimension to SI.

    Returns:
        The value, and its dimension ("fraction" for percents).

    Raises:
        ValueError: The text is not a number with a unit.

    Example:
        >>> parse_any("45 ms")
        (0.045, 'time')
    """
    unit = split_quantity(text)[1]
    dimension = "temperature" if unit == "degC" else dimension_of(unit)
    if not dimension:
        raise ValueError(f"'{text}' is not a number with a unit")
    return parse_quantity(text, dimension), dimension


def dimension_of(unit: str) -> str:
    """The dimension of a unit, or "" for an unknown unit.

    Example:
        >>> dimension_of("um/ms")
        'speed'
    """
    return next((name for name, units in UNITS.items() if unit and unit in units), "")


def si_unit_of(text: str) -> str:
    """The SI unit of a quantity of any dimension, or "" for a fraction and for other text.

    Example:
        >>> si_unit_of("60 ms"), si_unit_of("130 um/ms"), si_unit_of("75 %"), si_unit_of("7")
        ('s', 'm/s', '', '')
    """
    unit = split_quantity(text)[1]
    if unit == "degC":
        return "K"
    known = next((units for units in UNITS.values() if unit and unit in units), {})
    return next((name for name, factor in known.items() if factor == 1.0), "")


def factor_of(unit: str) -> float:
    """Factor from a unit of any dimension to SI. 1 for "" and for an unknown unit."""
    return next((units[unit] for units in UNITS.values() if unit and unit in units), 1.0)


def written(value: float, unit: str) -> str:
    """A value in SI as text in a unit of any dimension, without rounding errors.

    Example:
        >>> written(0.0002, "us"), written(7, "")
        ('200 us', '7')
    """
    if not unit:
        return str(value) if isinstance(value, int) else f"{value:.12g}"
    return f"{value / factor_of(unit):.12g} {unit}"


def with_error(value: float, error: float) -> str:
    """A value with the error of its last digit in brackets, or "-" for nan.

    Args:
        value: In any unit.
        error: Its standard error in the same unit. nan if unknown.

    Example:
        >>> with_error(29.6142, 0.031), with_error(5988.0, 12.0), with_error(1.0, 0.0)
        ('29.61(3)', '5990(10)', '1')
        >>> with_error(0.4, 0.096), with_error(7.123456, math.nan)
        ('0.4(1)', '7.123')
        >>> with_error(99.555555555555543, 8e-15)  # rounding is not an error
        '99.56'
    """
    if math.isnan(value):
        return "-"
    # A relative scatter below 1e-12 is only rounding.
    if not math.isfinite(error) or error <= 1e-12 * abs(value):
        return f"{value:.4g}"
    digit = math.floor(math.log10(error))
    if round(error / 10.0**digit) == 10:
        digit += 1
    rounded = round(error / 10.0**digit)
    if digit >= 0:
        return f"{round(value, -digit):.0f}({rounded * 10**digit})"
    return f"{value:.{-digit}f}({rounded})"


def scaled(number: float, factor: float) -> float:
    """Multiply without rounding errors for powers of ten, so that 4.49 um is 4.49e-06, not 4.4899...e-06.

    Example:
        >>> scaled(4.49, 1e-6)
        4.49e-06
    """
    inverse = round(1.0 / factor) if 0.0 < factor < 1.0 else 0
    if inverse and math.isclose(inverse * factor, 1.0, rel_tol=1e-12):
        return number / inverse
    return number * factor


def expected(dimension: str) -> str:
    """Describe a quantity of a dimension, for messages.

    Example:
        >>> expected("time")
        "a time such as '45 ms' (s, ms, us, ns, min, h)"
    """
    names = unit_names(dimension)
    plain = " or a plain number" if dimension == "fraction" else ""
    article = "an" if dimension == "angle" else "a"
    return f"{article} {dimension} such as '{EXAMPLES[dimension]}' ({', '.join(names)}){plain}"


def with_units(number: str, dimension: str) -> str:
    """A number as it is written, with the usual unit and with the SI unit, for messages.

    Example:
        >>> with_units("500", "time")
        "'500 ms' or '500 s'"
    """
    units = [split_quantity(EXAMPLES[dimension])[1], unit_names(dimension)[0]]
    units += ["degC"] if dimension == "temperature" else []
    return " or ".join(f"'{number} {unit}'" for unit in units)


def unit_names(dimension: str) -> list[str]:
    """The units of a dimension, micro with "u" only.

    Example:
        >>> unit_names("time")
        ['s', 'ms', 'us', 'ns', 'min', 'h']
    """
    return [unit for unit in UNITS[dimension] if unit and not unit.startswith(_MICRO[1:])]


def _a(dimension: str) -> str:
    return f"an {dimension}" if dimension[0] in "aeiou" else f"a {dimension}"


_LADDERS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "time": ("s", "ms", "us", "ns"),
        "length": ("m", "mm", "um", "nm"),
        "frequency": ("GHz", "MHz", "kHz", "Hz"),
        "speed": ("um/ms",),
        "voltage": ("V", "mV", "uV"),
        "power": ("W", "mW", "uW"),
        "temperature": ("K", "mK", "uK"),
        "angle": ("deg",),
        "fraction": ("%",),
    }
)
"""Dimension -> the units that values are shown in, the largest first."""


def readable_unit(value: float, dimension: str) -> str:
    """The unit that a physicist would choose for an SI value.

    Example:
        >>> readable_unit(0.045, "time"), readable_unit(15e-6, "temperature")
        ('ms', 'uK')
    """
    units, ladder = UNITS[dimension], _LADDERS[dimension]
    if value == 0:
        return next((u for u in ladder if units[u] == 1.0), ladder[-1])
    return next((u for u in ladder if abs(value) >= units[u] * (1 - 1e-9)), ladder[-1])


def format_quantity(value: float, dimension: str, digits: int = 3) -> str:
    """Format an SI value with the unit that a physicist would choose.

    Very large values are written with an exponent.

    Example:
        >>> format_quantity(0.045, "time")
        '45 ms'
        >>> format_quantity(4.49e-6, "length")
        '4.49 um'
        >>> format_quantity(1e300, "time")
        '1e+300 s'
    """
    units, unit = UNITS[dimension], readable_unit(value, dimension)
    amount = value / units[unit]
    number = f"{amount:.{digits}g}"
    if "e" in number and abs(amount) < 1e9:  # larger numbers keep the exponent
        number = f"{amount:.0f}"
    return f"{number} {unit}"


def size_text(n_bytes: int) -> str:
    """Write a size on disk.

    Example:
        >>> size_text(6_351_456), size_text(900)
        ('6.4 MB', '0.9 kB')
    """
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes / 1e3:.1f} kB"
