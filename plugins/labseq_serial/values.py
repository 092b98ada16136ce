"""Types, units and limits of the arguments of commands and of an instrument's values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from labseq.plugin import Duration, PositiveDuration, Settings, Text, format_quantity, setting_error
from labseq.plugin.messages import clean, one_of
from labseq.plugin.units import UNITS, ZERO_CELSIUS_K, expected, parse_quantity, scaled
from labseq_serial.patterns import VALUE, Sent, compiled, example_of

_DIMENSION_OF: Final = {unit: dimension for dimension, units in UNITS.items() for unit in units if unit}
_DIGITS: Final = 9


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit of a number on the line.

    Attributes:
        name: As the profile writes it, "" for a bare number.
        dimension: One of labseq's dimensions, so that the user's number is a quantity in SI. "" if labseq
            does not know the unit, so that the user's number is the number on the line.
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
            raise ValueError(f"labseq knows no unit '{name}'; did you mean '{alike}'?")
        return cls(name)

    @property
    def is_si(self) -> bool:
        """Whether the number on the line is the user's number."""
        return not self.dimension or UNITS[self.dimension].get(self.name) == 1.0

    @property
    def si_name(self) -> str:
        """The unit of the number that the user gives.

        Example:
            >>> Unit.of("degC").si_name, Unit.of("MHz").si_name, Unit.of("mA").si_name
            ('K', 'Hz', 'mA')
        """
        return next(iter(UNITS[self.dimension])) if self.dimension else self.name

    def read(self, given: object) -> float:
        """A number as the user gives it, SI or text with a unit.

        Raises:
            ValueError: It is not a finite number, or has another dimension.
        """
        number = self._number(given)
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a number; expected a finite one")
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
        raise ValueError(f"{given!r} is not accepted; expected {self.expected()}")

    def expected(self) -> str:
        """Describe a number in this unit."""
        if self.dimension:
            return expected(self.dimension)
        return f"a number in {self.name}" if self.name else "a number"

    def to_line(self, number: float) -> float:
        """Convert from SI to the unit on the line.

        Example:
            >>> Unit.of("MHz").to_line(80e6), Unit.of("degC").to_line(298.15)
            (80.0, 25.0)
        """
        if self.name == "degC":
            return round(number - ZERO_CELSIUS_K, 9)
        factor = UNITS[self.dimension][self.name] if self.dimension else 1.0
        return scaled(number, 1.0 / factor) if factor < 1.0 else number / factor

    def from_line(self, number: float) -> float:
        """Convert from the unit on the line to SI."""
        if self.name == "degC":
            return number + ZERO_CELSIUS_K
        return scaled(number, UNITS[self.dimension][self.name]) if self.dimension else number

    def shown(self, number: float) -> str:
        """Format a number in SI.

        Example:
            >>> Unit.of("kHz").shown(80e6), Unit.of("mA").shown(120.0)
            ('80 MHz', '120 mA')
        """
        if self.dimension and self.name != "degC":
            return format_quantity(number, self.dimension, _DIGITS)
        return f"{self.to_line(number):.{_DIGITS}g} {self.name}".rstrip()


Scalar: TypeAlias = bool | int | float | str
Number: TypeAlias = float | str
"""A number, or a quantity such as "80 MHz"."""

MAX_TEXT: Final = 200
"""Longest text that is sent as an argument."""


NUMBERS: Final = ("float", "int")
_KEYS: Final = {
    "float": {"unit", "min", "max"},
    "int": {"min", "max"},
    "bool": {"words"},
    "text": {"choices"},
}
"""Type -> the keys that only some types have."""


class LimitedSettings(Settings):
    """Unit and limits of an argument or value."""

    unit: Text | None = Field(
        default=None,
        description="unit of the number on the line. With a unit that labseq knows, as MHz or degC, it is a "
        "quantity in sequences and results. With others, such as mA, it is the number itself",
    )
    min: Number | None = Field(default=None, description="lowest allowed value")
    max: Number | None = Field(default=None, description="highest allowed value")

    @property
    def quantity(self) -> Unit:
        """The unit, or a bare number's where none is given."""
        return Unit.of(self.unit or "")

    @property
    def limits(self) -> tuple[float, float]:
        """Least and most, in SI, infinite where there is none."""
        return limits_of(self.min, self.max, self.quantity)

    def allows(self, value: Scalar) -> bool:
        """Whether a value, in SI, is within the limits. Anything but a number is."""
        return isinstance(value, str | bool) or self.limits[0] <= value <= self.limits[1]

    def shown(self, value: Scalar) -> str:
        """Format a value with its unit."""
        if isinstance(value, bool):
            return str(value).lower()
        return clean(value) if isinstance(value, str) else self.quantity.shown(value)

    def shown_limits(self) -> str:
        """Describe the limits."""
        return format_limits(*self.limits, self.quantity)

    def check_keys(self, type_name: str) -> None:
        """Refuse keys that are not for a type, and invalid limits."""
        others = set[str]().union(*_KEYS.values()) - _KEYS[type_name]
        for key in sorted(others & self.model_fields_set):
            types = " or ".join(kind for kind, keys in _KEYS.items() if key in keys)
            raise setting_error(f"'{key}' is not for type {type_name}", f"type {types}", at=(key,), key=True)
        check_limits(self.unit, self.min, self.max)


class ArgumentSettings(LimitedSettings):
    """An argument of a command."""

    type: Literal["float", "int", "text"] = Field(default="float", description="type of the value")
    choices: tuple[Text, ...] = Field(default=(), description="allowed texts, or none for any text")

    def value_of(self, given: object) -> Scalar:
        """The value of an argument as a step gives it, in SI.

        Raises:
            ValueError: It is of another type, or not one of the choices.
        """
        if self.type == "float":
            return self.quantity.read(given)
        if self.type == "int" and type(given) in (int, float) and float(str(given)).is_integer():
            return int(float(str(given)))
        if self.type == "text" and isinstance(given, str) and self._may_be_sent(given):
            return given
        raise ValueError(f"{given!r} is not accepted; expected {self._expected()}")

    def to_line(self, value: Scalar) -> Sent:
        """Convert a value to the argument on the line."""
        return self.quantity.to_line(value) if isinstance(value, float) else value

    def extremes(self) -> list[tuple[str, Scalar]]:
        """The limits of a number, with their keys, or one value of a text."""
        if self.type not in NUMBERS:
            return [("choices", (*self.choices, "A")[0])]
        low, high = self.limits
        if self.type == "int":
            low, high = math.ceil(low), math.floor(high)
        return [("min", low), ("max", high)]

    def _may_be_sent(self, text: str) -> bool:
        if self.choices:
            return text in self.choices
        return text.isprintable() and 0 < len(text) <= MAX_TEXT and text == text.strip()

    def _expected(self) -> str:
        if self.type == "int":
            return "a whole number"
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        return f"1 to {MAX_TEXT} characters on one line, no space at either end"

    @model_validator(mode="after")
    def _check_type_and_limits(self) -> Self:
        self.check_keys(self.type)
        for key in ("min", "max") if self.type in NUMBERS else ():
            if getattr(self, key) is None:
                raise setting_error(f"'{key}' is missing", "both limits of a number that is sent")
        low, high = self.limits
        if self.type == "int" and math.ceil(low) > math.floor(high):
            raise setting_error("there is no whole number within the limits", "some", at=("min",))
        return self


def check_limits(unit: str | None, low: Number | None, high: Number | None, *at: str) -> None:
    """Refuse limits that are not quantities of their unit, or the wrong way round.

    Args:
        unit: The unit, as the profile has it.
        low: The least.
        high: The most.
        *at: Where the limits are, below the validated model.
    """
    try:
        quantity = Unit.of(unit or "")
    except ValueError as error:
        raise placed(error, "unit") from None
    read: list[float] = []
    for key, limit in (("min", low), ("max", high)):
        if isinstance(limit, float | int) and not quantity.is_si:
            what = f"{key} is {limit:g}, without a unit"
            raise setting_error(what, f"'{limit:g} {unit}', or the number in its unit", at=(*at, key))
        try:
            read += [] if limit is None else [quantity.read(limit)]
        except ValueError as error:
            raise placed(error, *at, key) from None
    if len(read) == 2 and read[0] > read[1]:
        shown = [quantity.shown(limit) for limit in read]
        raise setting_error(f"min is {shown[0]}, more than max, {shown[1]}", "min below max", at=(*at, "min"))


def limits_of(low: Number | None, high: Number | None, quantity: Unit) -> tuple[float, float]:
    """Least and most, in SI, infinite where there is none."""
    return -math.inf if low is None else quantity.read(low), math.inf if high is None else quantity.read(high)


def format_limits(low: float, high: float, quantity: Unit) -> str:
    """Describe limits, without infinite ones."""
    if math.isinf(low):
        return "anything" if math.isinf(high) else f"at most {quantity.shown(high)}"
    if math.isinf(high):
        return f"at least {quantity.shown(low)}"
    return f"{quantity.shown(low)} to {quantity.shown(high)}"


def placed(error: ValueError, *at: str | int, key: bool = False) -> PydanticCustomError:
    """The error of a text reader, "what; expected this; do that", with its place."""
    what, _, rest = str(error).partition("; expected ")
    expected, _, hint = rest.partition("; ")
    return setting_error(what, expected, hint, at=at, key=key)


class InterlockSettings(Settings):
    """Condition on a value, without which no atoms are picked up."""

    min: Number | None = Field(default=None, description="lowest allowed value")
    max: Number | None = Field(default=None, description="highest allowed value")
    one_of: tuple[Scalar, ...] = Field(default=(), description="allowed values of a bool or text")
    message: str = Field(default="", description="advice in the message if the condition is not met")
    max_age: Duration = Field(
        default=0.0,
        description="how old a reading may be. Each check that needs a new one waits for the instrument",
    )

    def allows(self, value: Scalar, quantity: Unit) -> bool:
        """Whether a value, in SI, meets the condition."""
        if self.one_of:
            return any(type(value) is type(good) and value == good for good in self.one_of)
        low, high = self.limits(quantity)
        return not isinstance(value, str) and low <= value <= high

    def limits(self, quantity: Unit) -> tuple[float, float]:
        """Least and most, in SI, infinite where there is none."""
        return limits_of(self.min, self.max, quantity)

    def shown(self, quantity: Unit) -> str:
        """Describe the allowed values."""
        if self.one_of:
            return " or ".join(
                str(good).lower() if isinstance(good, bool) else str(good) for good in self.one_of
            )
        return format_limits(*self.limits(quantity), quantity)


class ValueSettings(LimitedSettings):
    """A value that is read from the instrument."""

    type: Literal["float", "int", "bool", "text"] = Field(default="float", description="type of the value")
    words: tuple[Text, Text] = Field(
        default=("0", "1"), description="texts for false and true on the line, for a bool"
    )
    ask: Text = Field(description="text that is sent")
    reply: Text = Field(
        default=f"(?P<{VALUE}>.*)",
        description="regular expression for the whole reply, without the spaces at its ends, "
        f"with the value in a group `(?P<{VALUE}>...)`",
    )
    error: Text | None = Field(default=None, description="pattern of a reply that reports an error")
    poll: bool = Field(
        default=False, description="whether it is read at the start of each shot and recorded with it"
    )
    interlock: InterlockSettings | None = Field(
        default=None,
        description="condition on the value. If it is not met, no atoms are picked up and the run ends",
    )
    timeout: PositiveDuration | None = Field(
        default=None, description="how long the reply may take, or none for the instrument's `timeout`"
    )
    example: Text | None = Field(
        default=None,
        description="an example of a reply, for dry runs. Needed if the pattern, with a value in place of "
        "the group, does not match itself",
    )

    def value_in(self, reply: str) -> Scalar:
        """Read the value, in SI, from a reply.

        Raises:
            ValueError: The reply does not match, or its value is implausible.
        """
        match = compiled(self.reply).fullmatch(reply)
        if match is None or match[VALUE] is None:
            raise ValueError(f"expected a reply like '{clean(self.reply)}'")
        value = self._read(match[VALUE].strip())
        if not self.allows(value):
            came = self.shown(value)
            raise ValueError(f"its value, {came}, is implausible; expected {self.shown_limits()}")
        return value

    def reply_with(self, value: Scalar) -> str | None:
        """A reply with this value by a simulated instrument, None if the profile needs an example.

        The value is put into the example. If the result does not match the pattern, it is the example.
        """
        if self.example is None:
            return example_of(self.reply, self._written(value))
        pattern = compiled(self.reply)
        match = pattern.fullmatch(self.example)
        assert match is not None, "checked with the profile"
        decimals = len(match[VALUE].partition(".")[2])
        text = self._written(value, f".{decimals}f" if decimals else "")
        reply = self.example[: match.start(VALUE)] + text + self.example[match.end(VALUE) :]
        return reply if pattern.fullmatch(reply) else self.example

    @property
    def typical(self) -> Scalar:
        """The example's value, or else the value nearest to 0 on the line that all limits allow."""
        if self.example is not None:
            return self.value_in(self.example)
        lock = self.interlock or InterlockSettings()
        if lock.one_of:
            return lock.one_of[0]
        if self.type not in NUMBERS:
            return False if self.type == "bool" else "0"
        value = self.quantity.from_line(0.0)
        for low, high in (self.limits, lock.limits(self.quantity)):
            value = min(max(value, low), high)
        return round(value) if self.type == "int" else value

    def _read(self, text: str) -> Scalar:
        if self.type == "text":
            return text
        if self.type == "bool":
            if text not in self.words:
                raise ValueError(f"its value is '{clean(text)}'; expected {one_of(self.words)}")
            return self.words.index(text) == 1
        try:
            number = float(text) if self.type == "float" else int(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or "_" in text:
            kind = "a number" if self.type == "float" else "a whole number"
            raise ValueError(f"its value is '{clean(text)}'; expected {kind}")
        return self.quantity.from_line(number) if isinstance(number, float) else number

    def _written(self, value: Scalar, spec: str = "") -> str:
        if isinstance(value, bool):
            return self.words[value]
        if isinstance(value, float):
            return format(self.quantity.to_line(value), spec or ".12g")
        return str(value)

    @model_validator(mode="after")
    def _check_type_and_words(self) -> Self:
        self.check_keys(self.type)
        if self.words[0] == self.words[1]:
            raise setting_error(f"false and true are both '{self.words[0]}'", "two words", at=("words",))
        return self

    @model_validator(mode="after")
    def _patterns_are_patterns(self) -> Self:
        for key in ("reply", "error"):
            try:
                pattern = compiled(getattr(self, key) or "")
            except ValueError as error:
                raise placed(error, key) from None
            if key == "reply" and VALUE not in pattern.groupindex:
                what = f"'{clean(self.reply)}' has no group '{VALUE}'"
                raise setting_error(what, f"the value in brackets, (?P<{VALUE}>...)", at=(key,))
        return self

    @model_validator(mode="after")
    def _interlock_fits(self) -> Self:
        lock = self.interlock
        if lock is None:
            return self
        if lock.min is None and lock.max is None and not lock.one_of:
            raise setting_error(
                "the interlock allows everything", "min, max or one_of", at=("interlock",), key=True
            )
        wrong = ("one_of",) if self.type in NUMBERS else ("min", "max")
        for key in wrong:
            if getattr(lock, key) not in (None, ()):
                expected = "min and max" if self.type in NUMBERS else "one_of"
                what = f"'{key}' is not for a value of type {self.type}"
                raise setting_error(what, expected, at=("interlock", key), key=True)
        kind = bool if self.type == "bool" else str
        for i, good in enumerate(lock.one_of):
            if type(good) is not kind:
                expected = "true or false" if kind is bool else "text, in quotes"
                raise setting_error(
                    f"the value is of type {self.type}", expected, at=("interlock", "one_of", i)
                )
        check_limits(self.unit, lock.min, lock.max, "interlock")
        return self

    @model_validator(mode="after")
    def _example_fits(self) -> Self:
        if self.example is None:
            return self
        try:
            self.value_in(self.example)
        except ValueError as error:
            text = f"the reply '{clean(self.example)}' does not match: {error}"
            raise placed(ValueError(text), "example") from None
        return self
