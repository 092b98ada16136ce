"""Commands, and what an instrument is known by."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Final, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Duration, Settings, Text, clean, closest, setting_error
from labseq_serial.arguments import ArgumentSettings, Scalar, placed
from labseq_serial.replies import compiled, example_of
from labseq_serial.templates import Sent, Template

RESERVED: Final = frozenset({"self", "name", "owner", "timeout_s", "function"})
"""Names that arguments cannot have: labseq's own calls have them."""
_SLACK: Final = 1e-9

PositiveDuration: TypeAlias = Annotated[Duration, Field(gt=0)]
"""Seconds, more than 0; "0.5 s"."""


class CallSettings(Settings):
    """A command and its arguments, as a step has them."""

    do: Text = Field(description="a command")
    arguments: dict[str, Scalar] = Field(default={}, description="its arguments")


Call: TypeAlias = Text | CallSettings
"""A command that is sent by itself: its name, or with arguments."""


class IdentifySettings(Settings):
    """How the instrument says what it is."""

    ask: Text = Field(description="what is sent, as it stands")
    reply: Text = Field(
        description="pattern of the reply; groups `model`, `serial_number` and `firmware` are shown by "
        "`labseq devices`"
    )
    example: Text | None = Field(default=None, description="a reply as it may come, as that of a value")

    def simulated_reply(self) -> str | None:
        """A reply that matches."""
        return self.example if self.example is not None else example_of(self.reply)

    @model_validator(mode="after")
    def _reply_can_be_made_up(self) -> Self:
        check_reply(self.reply, self.simulated_reply())
        return self


class CommandSettings(Settings):
    """A command of the instrument."""

    send: Text = Field(
        description="what is sent; `{name}` or `{name:.3f}` stands for an argument, `{{` for a brace"
    )
    arguments: dict[str, ArgumentSettings] = Field(default={}, description="its arguments, by name")
    reply: str | None = Field(
        default=None,
        description='pattern that the reply must match, as that of a value; `""` for an empty line or a '
        "mere prompt; none: nothing is answered",
    )
    error: Text | None = Field(default=None, description="pattern of a reply that reports an error")
    makes: dict[str, bool | int | str] = Field(
        default={},
        description="values that are so afterwards: they are read before, and if they are so already "
        "nothing is sent, and after, until they are so",
    )
    repeatable: bool = Field(
        default=False, description="whether it may be sent again when the reply is missing or unreadable"
    )
    timeout: PositiveDuration | None = Field(
        default=None,
        description="how long the reply, and what the command makes, may take; none: as for all",
    )
    example: str | None = Field(default=None, description="a reply as it may come, as that of a value")

    @property
    def template(self) -> Template:
        """``send``, taken apart."""
        return Template.parse(self.send)

    @property
    def kinds(self) -> dict[str, type[Sent]]:
        """What each argument is on the line."""
        return {name: argument.kind for name, argument in self.arguments.items()}

    def text(self, values: Mapping[str, Scalar]) -> str:
        """What is sent for these arguments, in SI."""
        return self.template.format(
            {name: self.arguments[name].to_line(value) for name, value in values.items()}
        )

    def values_in(self, text: str) -> dict[str, Scalar] | None:
        """The arguments, in SI, in what was sent; None if it is not this command."""
        sent = self.template.read(text, self.kinds)
        if sent is None:
            return None
        values = {name: self.arguments[name].from_line(one) for name, one in sent.items()}
        known = {name: value for name, value in values.items() if value is not None}
        return known if len(known) == len(values) else None

    def simulated_reply(self) -> str | None:
        """A reply that matches; None if nothing is answered, or none can be made up."""
        if self.reply is None or self.example is not None:
            return self.example
        return example_of(self.reply)

    def extremes(self) -> list[dict[str, Scalar]]:
        """Arguments at their limits: all at the least, all at the most, and mixed."""
        ends = {name: argument.extremes() for name, argument in self.arguments.items()}
        if not ends:
            return [{}]
        orders = ((0, 0), (1, 1), (0, 1), (1, 0))
        return [{name: pair[order[k % 2]] for k, (name, pair) in enumerate(ends.items())} for order in orders]

    @model_validator(mode="after")
    def _arguments_have_places(self) -> Self:
        for name in self.arguments:
            if not name.isidentifier() or name in RESERVED:
                expected = f"a word of letters, digits and '_', none of {', '.join(sorted(RESERVED))}"
                raise setting_error(
                    f"an argument is called '{clean(name)}'", expected, at=("arguments", name), key=True
                )
        try:
            names = self.template.names
        except ValueError as error:
            raise placed(error, "send") from None
        for name in names:
            if name not in self.arguments:
                meant = closest(name, self.arguments)
                hint = f"did you mean '{meant}'?" if meant else f"declare '{name}' below 'arguments'"
                raise setting_error(
                    f"'{{{name}}}' is not an argument", _listed(self.arguments), hint, at=("send",)
                )
        for name in self.arguments:
            if name not in names:
                what = f"the argument '{name}' has no place in '{clean(self.send)}'"
                raise setting_error(
                    what, f"a placeholder {{{name}}} in 'send'", at=("arguments", name), key=True
                )
        return self

    @model_validator(mode="after")
    def _what_is_sent_can_be_read(self) -> Self:
        for values in self.extremes():
            sent = {name: self.arguments[name].to_line(value) for name, value in values.items()}
            try:
                rounded, text = self.template.rounded(sent), self.template.format(sent)
            except ValueError as error:
                raise placed(error, "send") from None
            if self.template.read(text, self.kinds) != rounded:
                what = f"the arguments cannot be told apart in '{clean(text)}'"
                raise setting_error(what, "something between the placeholders", at=("send",))
            for name, value in rounded.items():
                self._check_rounded(name, value, text)
        return self

    def _check_rounded(self, name: str, sent: Sent, text: str) -> None:
        argument = self.arguments[name]
        value = argument.from_line(sent)
        if value is None or isinstance(value, str | bool):
            return
        low, high = argument.limits
        slack = _SLACK * max(abs(low), abs(high))
        if not low - slack <= value <= high + slack:
            key = "min" if value < low else "max"
            what = f"as '{clean(text)}' it would be {argument.quantity.shown(value)}, beyond the limit"
            raise setting_error(
                what, "a limit with no more digits than are sent", at=("arguments", name, key)
            )

    @model_validator(mode="after")
    def _replies_fit(self) -> Self:
        if self.reply is None:
            for key in ("error", "example"):
                if getattr(self, key) is not None:
                    what = f"'{key}' is about a reply, but no 'reply' is waited for"
                    raise setting_error(what, "a 'reply'", at=(key,), key=True)
            return self
        check_reply(self.reply, self.simulated_reply())
        check_pattern(self.error, "error")
        return self


def check_pattern(pattern: str | None, key: str) -> re.Pattern[str] | None:
    """Refuse what is no pattern.

    Raises:
        PydanticCustomError: With its place.
    """
    try:
        return None if pattern is None else compiled(pattern)
    except ValueError as error:
        raise placed(error, key) from None


def check_reply(pattern: str, example: str | None) -> None:
    """Refuse a pattern of replies for which there is no example.

    Raises:
        PydanticCustomError: With its place.
    """
    compiled_pattern = check_pattern(pattern, "reply")
    if example is None:
        what = f"labseq cannot make up a reply like '{clean(pattern)}'"
        raise setting_error(what, "an example of one", "add 'example'", at=("reply",))
    if compiled_pattern is not None and compiled_pattern.fullmatch(example) is None:
        what = f"the reply '{clean(example)}' does not do"
        raise setting_error(what, f"one like '{clean(pattern)}'", at=("example",))


def call_of(call: Call) -> tuple[str, Mapping[str, Scalar]]:
    """Name and arguments of a call."""
    return (call, {}) if isinstance(call, str) else (call.do, call.arguments)


def _listed(names: Mapping[str, object] | Sequence[str]) -> str:
    return f"one of {', '.join(names)}" if names else "no placeholder: the command has no arguments"
