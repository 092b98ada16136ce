"""What goes over the line with a type, a unit and limits: arguments, and what they share with values."""

from __future__ import annotations

import math
from typing import Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from labseq.plugin import Settings, Text, clean, setting_error
from labseq_serial.templates import Sent
from labseq_serial.units import Unit

Scalar: TypeAlias = bool | int | float | str
Number: TypeAlias = float | str
"""A number, or a quantity such as "80 MHz"."""

MAX_TEXT: Final = 200
"""Longest text that is sent as an argument."""


class TypedSettings(Settings):
    """Type, unit and limits of what goes over the line."""

    type: Literal["float", "int", "bool", "text"] = Field(default="float", description="what it is")
    unit: Text | None = Field(
        default=None,
        description="unit of the number on the line; with one that labseq knows, as MHz or degC, it is a "
        "quantity in sequences and results, else, as with mA, the number itself",
    )
    words: tuple[Text, Text] = Field(
        default=("0", "1"), description="what false and true are on the line, of a bool"
    )
    min: Number | None = Field(default=None, description="least that it may be")
    max: Number | None = Field(default=None, description="most that it may be")

    @property
    def is_number(self) -> bool:
        """Whether it is a float or an int."""
        return self.type in ("float", "int")

    @property
    def quantity(self) -> Unit:
        """The unit; that of a bare number where none is given."""
        return Unit.of(self.unit or "")

    @property
    def limits(self) -> tuple[float, float]:
        """Least and most, in SI; infinite where there is none."""
        low, high = self.min, self.max
        read = self.quantity.read
        return (-math.inf if low is None else read(low), math.inf if high is None else read(high))

    def allows(self, value: Scalar) -> bool:
        """Whether a value, in SI, is within the limits; anything but a number is."""
        return isinstance(value, str | bool) or self.limits[0] <= value <= self.limits[1]

    def shown(self, value: Scalar) -> str:
        """A value in words, with its unit."""
        if isinstance(value, bool):
            return str(value).lower()
        return clean(value) if isinstance(value, str) else self.quantity.shown(value)

    def shown_limits(self) -> str:
        """The limits in words."""
        return format_limits(*self.limits, self.quantity)

    @model_validator(mode="after")
    def _type_unit_and_limits_fit(self) -> Self:
        given = self.model_fields_set
        allowed = {"float": {"unit", "min", "max"}, "int": {"min", "max"}, "bool": {"words"}}
        for key in ("unit", "min", "max", "words"):
            if key in given and getattr(self, key) is not None and key not in allowed.get(self.type, ()):
                kinds = " or ".join(kind for kind, keys in allowed.items() if key in keys)
                raise setting_error(
                    f"'{key}' does not go with type {self.type}", f"type {kinds}", at=(key,), key=True
                )
        if self.words[0] == self.words[1]:
            raise setting_error(f"false and true are both '{self.words[0]}'", "two words", at=("words",))
        check_limits(self.unit, self.min, self.max)
        return self


class ArgumentSettings(TypedSettings):
    """An argument of a command."""

    choices: tuple[Text, ...] = Field(default=(), description="what it may be, of a text; none: any text")

    @property
    def kind(self) -> type[Sent]:
        """What it is on the line."""
        return {"float": float, "int": int}.get(self.type, str)

    def value_of(self, given: object) -> Scalar:
        """The value of an argument as a step gives it, in SI.

        Raises:
            ValueError: It is of another type, or not one of the choices.
        """
        if self.type == "float":
            return self.quantity.read(given)
        if self.type == "bool" and isinstance(given, bool):
            return given
        if self.type == "text" and isinstance(given, str) and self._may_be_sent(given):
            return given
        if self.type == "int" and type(given) in (int, float) and float(str(given)).is_integer():
            return int(float(str(given)))
        raise ValueError(f"{given!r} does not do; expected {self._expected()}")

    def to_line(self, value: Scalar) -> Sent:
        """What is sent for a value."""
        if isinstance(value, bool):
            return self.words[value]
        return self.quantity.to_line(value) if self.type == "float" and not isinstance(value, str) else value

    def from_line(self, sent: Sent) -> Scalar | None:
        """The value of what was sent; None if that is none of this argument's."""
        if self.type == "bool":
            return self.words.index(str(sent)) == 1 if sent in self.words else None
        if self.type == "text":
            return sent if not self.choices or sent in self.choices else None
        return self.quantity.from_line(float(sent)) if self.type == "float" else sent

    def extremes(self) -> tuple[Scalar, Scalar]:
        """Its limits, or its first and last choice."""
        if self.type == "bool":
            return False, True
        if self.type == "text":
            return (self.choices[0], self.choices[-1]) if self.choices else ("A", "B9")
        low, high = self.limits
        return (low, high) if self.type == "float" else (math.ceil(low), math.floor(high))

    def _may_be_sent(self, text: str) -> bool:
        if self.choices:
            return text in self.choices
        return text.isprintable() and 0 < len(text) <= MAX_TEXT and text == text.strip()

    def _expected(self) -> str:
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        return {
            "int": "a whole number",
            "bool": "true or false",
        }.get(self.type, f"1 to {MAX_TEXT} characters on one line, no space at either end")

    @model_validator(mode="after")
    def _numbers_have_limits(self) -> Self:
        if self.choices and self.type != "text":
            raise setting_error(
                f"'choices' do not go with type {self.type}", "type text", at=("choices",), key=True
            )
        for key in ("min", "max") if self.is_number else ():
            if getattr(self, key) is None:
                raise setting_error(f"'{key}' is missing", "both limits of a number that is sent")
        low, high = self.limits
        if self.type == "int" and math.ceil(low) > math.floor(high):
            raise setting_error("there is no whole number within the limits", "some", at=("min",))
        return self


def check_limits(unit: str | None, low: Number | None, high: Number | None, *at: str) -> None:
    """Refuse limits that are no quantities of their unit, or the wrong way round.

    Args:
        unit: The unit, as the profile has it.
        low: The least.
        high: The most.
        *at: Where the limits are, below what is validated.

    Raises:
        PydanticCustomError: With its place.
    """
    try:
        quantity = Unit.of(unit or "")
    except ValueError as error:
        raise placed(error, "unit") from None
    read: list[float] = []
    for key, limit in (("min", low), ("max", high)):
        if isinstance(limit, float | int) and not quantity.is_si:
            what = f"{key} is {limit:g}, without a unit"
            raise setting_error(what, f"'{limit:g} {unit}', or what is meant with its unit", at=(*at, key))
        try:
            read += [] if limit is None else [quantity.read(limit)]
        except ValueError as error:
            raise placed(error, *at, key) from None
    if len(read) == 2 and read[0] > read[1]:
        shown = [quantity.shown(limit) for limit in read]
        raise setting_error(f"min is {shown[0]}, more than max, {shown[1]}", "min below max", at=(*at, "min"))


def format_limits(low: float, high: float, quantity: Unit) -> str:
    """Limits in words; infinite ones are none."""
    if math.isinf(low):
        return "anything" if math.isinf(high) else f"at most {quantity.shown(high)}"
    if math.isinf(high):
        return f"at least {quantity.shown(low)}"
    return f"{quantity.shown(low)} to {quantity.shown(high)}"


def placed(error: ValueError, *at: str | int, key: bool = False) -> PydanticCustomError:
    """What a reader of text said, with its place: "what; expected this; do that"."""
    what, _, rest = str(error).partition("; expected ")
    expected, _, hint = rest.partition("; ")
    return setting_error(what, expected, hint, at=at, key=key)
