"""Values that an instrument is asked for."""

from __future__ import annotations

import math
from typing import Annotated, Final, Self

from pydantic import Field, model_validator

from labseq.plugin import Duration, Settings, Text, clean, one_of, setting_error
from labseq_serial.arguments import Number, Scalar, TypedSettings, check_limits, format_limits, placed
from labseq_serial.replies import VALUE, compiled, example_of
from labseq_serial.units import Unit

_PLAIN: Final = (".12g", ".9f", ".6f", ".3f", ".2f", ".1f", ".0f", ".6e", ".6E")
_SPECS: Final = (*_PLAIN, *(f"+{spec}" for spec in _PLAIN))
"""Formats in which a simulated instrument may give a number, the more exact ones first."""


class InterlockSettings(Settings):
    """What a value must be, or nothing is picked up."""

    min: Number | None = Field(default=None, description="least that the value may be")
    max: Number | None = Field(default=None, description="most that it may be")
    one_of: tuple[Scalar, ...] = Field(default=(), description="what it may be, of a bool or text")
    message: str = Field(default="", description="what to do when it is not, for the message")
    max_age: Duration = Field(
        default=0.0,
        description="how old a reading may be; each check that needs a new one waits for the instrument",
    )

    def allows(self, value: Scalar, quantity: Unit) -> bool:
        """Whether a value, in SI, is as it must be."""
        if self.one_of:
            return any(type(value) is type(good) and value == good for good in self.one_of)
        low, high = self.limits(quantity)
        return not isinstance(value, str) and low <= value <= high

    def limits(self, quantity: Unit) -> tuple[float, float]:
        """Least and most, in SI; infinite where there is none."""
        low = -math.inf if self.min is None else quantity.read(self.min)
        return low, math.inf if self.max is None else quantity.read(self.max)

    def shown(self, quantity: Unit) -> str:
        """What is allowed, in words."""
        if self.one_of:
            return " or ".join(
                str(good).lower() if isinstance(good, bool) else str(good) for good in self.one_of
            )
        return format_limits(*self.limits(quantity), quantity)


class ValueSettings(TypedSettings):
    """A value that the instrument is asked for."""

    ask: Text = Field(description="what is sent, as it stands")
    reply: Text = Field(
        default=f"(?P<{VALUE}>.*)",
        description="pattern of the reply: a regular expression for all of it, without spaces at its ends, "
        f"with the value in a group `(?P<{VALUE}>...)`",
    )
    error: Text | None = Field(default=None, description="pattern of a reply that reports an error")
    poll: bool = Field(
        default=False, description="whether it is read at the start of each shot and kept with it"
    )
    interlock: InterlockSettings | None = Field(
        default=None, description="what it must be, or nothing is picked up and the run ends"
    )
    timeout: Annotated[Duration, Field(gt=0)] | None = Field(
        default=None, description="how long the reply may take; none: as for all"
    )
    example: Text | None = Field(
        default=None,
        description="a reply as it may come, for dry runs; only needed if labseq cannot make one up",
    )

    def value_in(self, reply: str) -> Scalar:
        """Read the value, in SI, out of a reply.

        Raises:
            ValueError: The reply is another than expected, or its value is implausible.
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
        """A reply with this value, as a simulated instrument gives it; None if none can be written."""
        if self.example is not None:
            return self.example
        return next(filter(None, (example_of(self.reply, text) for text in self._written(value))), None)

    @property
    def typical(self) -> Scalar:
        """A value that is plausible and that the interlock allows."""
        if self.interlock is not None and self.interlock.one_of:
            return self.interlock.one_of[0]
        if not self.is_number:
            return False if self.type == "bool" else "0"
        pairs = (
            [self.limits] if self.interlock is None else [self.limits, self.interlock.limits(self.quantity)]
        )
        low, high = max(pair[0] for pair in pairs), min(pair[1] for pair in pairs)
        if math.isinf(low) and math.isinf(high):
            middle = self.quantity.from_line(0.0)
        elif math.isinf(low) or math.isinf(high):
            middle = high if math.isinf(low) else low
        else:
            middle = (low + high) / 2
        return math.floor(middle) if self.type == "int" else middle

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

    def _written(self, value: Scalar) -> list[str]:
        if isinstance(value, bool):
            return [self.words[value]]
        if isinstance(value, str):
            return [value]
        if self.type == "int":
            return [f"{value:d}", f"{value:+d}"]
        on_line = self.quantity.to_line(value)
        return [format(on_line, spec) for spec in _SPECS]

    @model_validator(mode="after")
    def _patterns_are_patterns(self) -> Self:
        for key in ("reply", "error"):
            try:
                pattern = compiled(getattr(self, key) or "")
            except ValueError as error:
                raise placed(error, key) from None
            if key == "reply" and VALUE not in pattern.groupindex:
                what = f"'{clean(self.reply)}' has no group '{VALUE}'"
                raise setting_error(what, f"the value in brackets: (?P<{VALUE}>...)", at=(key,))
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
        wrong = ("one_of",) if self.is_number else ("min", "max")
        for key in wrong:
            if getattr(lock, key) not in (None, ()):
                expected = "min and max" if self.is_number else "one_of"
                what = f"'{key}' does not go with a value of type {self.type}"
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
            reply = self.reply_with(self.typical)
            if reply is None:
                what = f"labseq cannot make up a reply like '{clean(self.reply)}' with the value "
                raise setting_error(
                    what + self.shown(self.typical), "an example of one", "add 'example'", at=("reply",)
                )
        else:
            reply = self.example
        try:
            self.value_in(reply)
        except ValueError as error:
            raise placed(ValueError(f"the reply '{clean(reply)}' does not do: {error}"), "example") from None
        return self
