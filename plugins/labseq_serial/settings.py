"""Settings of an instrument on a serial line with its port and commands, and their checks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from labseq.plugin import Duration, PositiveDuration, Settings, Text, setting_error
from labseq.plugin.messages import clean, closest, one_of
from labseq.plugin.serial import is_network_port, port_identities, ports_here
from labseq_serial.patterns import Piece, compiled, example_of, pieces
from labseq_serial.values import ArgumentSettings, Scalar, ValueSettings, placed

RESERVED: Final = frozenset({"self", "name", "owner", "timeout_s", "function"})
"""Names that arguments cannot have, because labseq's own calls use them."""
_SLACK: Final = 1e-9
"""Relative error of a limit that the conversion of units may cause."""
SIMULATED: Final = "simulated"
"""The port of a simulated instrument."""
_MADE: Final[Mapping[str, tuple[type[Scalar], str]]] = {
    "bool": (bool, "true or false"),
    "int": (int, "a whole number"),
    "text": (str, "text, in quotes"),
}
"""Types of values that a command can make, with their descriptions."""


class UsbSettings(Settings):
    """A USB adapter, on any port."""

    vid: int | None = Field(default=None, ge=0, le=0xFFFF, description="vendor's number, as 0x0403")
    pid: int | None = Field(default=None, ge=0, le=0xFFFF, description="product's number, as 0x6001")
    serial: Text | None = Field(default=None, description="serial number")

    @property
    def given(self) -> dict[str, int | str]:
        """The given numbers, by pyserial's names."""
        wanted = {"vid": self.vid, "pid": self.pid, "serial_number": self.serial}
        return {key: value for key, value in wanted.items() if value is not None}

    def ports(self) -> list[Any]:
        """The ports of this computer whose adapter fits."""
        given = self.given.items()
        return [port for port in ports_here() if all(getattr(port, key, None) == it for key, it in given)]

    @model_validator(mode="after")
    def _check_any(self) -> Self:
        if not self.given:
            raise setting_error("this fits every adapter", "vid, pid or serial")
        return self


class IdentifySettings(Settings):
    """How the instrument reports what it is."""

    ask: Text = Field(description="text that is sent")
    reply: Text = Field(
        description="pattern of the reply. Groups `model`, `serial_number` and `firmware` are shown by "
        "`labseq devices`"
    )
    example: Text | None = Field(default=None, description="an example of a reply, for dry runs")

    @property
    def simulated_reply(self) -> str | None:
        """A reply that matches, None if the profile needs an example."""
        return example_of(self.reply) if self.example is None else self.example

    @model_validator(mode="after")
    def _check_reply(self) -> Self:
        check_reply(self.reply, self.example)
        return self


class CommandSettings(Settings):
    """A command of the instrument."""

    send: Text = Field(description="text to send. `{name}` or `{name:.3f}` is an argument, `{{` a brace")
    arguments: dict[str, ArgumentSettings] = Field(default={}, description="its arguments, by name")
    reply: str | None = Field(
        default=None,
        description='pattern that the reply must match, like that for a value. `""` is an empty line or a '
        "mere prompt. With none, no reply comes",
    )
    error: Text | None = Field(default=None, description="pattern of a reply that reports an error")
    makes: dict[str, bool | int | str] = Field(
        default={},
        description="values after the command. They are read first, and if they have these values "
        "already, nothing is sent. Afterwards they are read until they have them",
    )
    repeatable: bool = Field(
        default=False, description="whether it may be sent again when the reply is missing or unreadable"
    )
    timeout: PositiveDuration | None = Field(
        default=None,
        description="how long the reply and the values of `makes` may take, or none for the usual `timeout`",
    )
    example: str | None = Field(default=None, description="an example of a reply, for dry runs")

    @property
    def pieces(self) -> list[Piece]:
        """``send``, split at its arguments."""
        return pieces(self.send)

    @property
    def simulated_reply(self) -> str | None:
        """A reply that matches, None if none comes or the profile needs an example."""
        if self.reply is None or self.example is not None:
            return self.example
        return example_of(self.reply)

    def text(self, values: Mapping[str, Scalar]) -> str:
        """The text for these arguments, in SI.

        Example:
            >>> level = {"unit": "mV", "min": "0 V", "max": "1 V"}
            >>> command = CommandSettings(send="VOLT {level:.1f} mV", arguments={"level": level})
            >>> command.text({"level": 0.25})
            'VOLT 250.0 mV'
        """
        sent = {name: self.arguments[name].to_line(value) for name, value in values.items()}
        return "".join(
            piece.literal + (piece.written(sent[piece.name]) if piece.name else "") for piece in self.pieces
        )

    @model_validator(mode="after")
    def _check_placeholders(self) -> Self:
        for name in self.arguments:
            if not name.isidentifier() or name in RESERVED:
                expected = f"a word of letters, digits and '_', none of {', '.join(sorted(RESERVED))}"
                raise setting_error(
                    f"an argument is called '{clean(name)}'", expected, at=("arguments", name), key=True
                )
        try:
            names = {piece.name: None for piece in self.pieces if piece.name}
        except ValueError as error:
            raise placed(error, "send") from None
        for name in names:
            if name not in self.arguments:
                raise unknown(f"'{{{name}}}' is not an argument", name, self.arguments, "send")
        for name in self.arguments:
            if name not in names:
                what = f"the argument '{name}' has no place in '{clean(self.send)}'"
                raise setting_error(
                    what, f"a placeholder {{{name}}} in 'send'", at=("arguments", name), key=True
                )
        return self

    @model_validator(mode="after")
    def _check_formats(self) -> Self:
        for piece in filter(lambda piece: piece.name, self.pieces):
            for key, value in self.arguments[piece.name].extremes():
                try:
                    text = piece.written(self.arguments[piece.name].to_line(value))
                except ValueError as error:
                    raise placed(error, "send") from None
                if isinstance(value, float):
                    self._check_rounded(piece.name, key, text)
        return self

    def _check_rounded(self, name: str, key: str, text: str) -> None:
        """Check the limits as they are sent. Rounding keeps the order, so this covers all values."""
        argument = self.arguments[name]
        low, high = argument.limits
        slack = _SLACK * max(abs(low), abs(high))
        try:
            value = argument.quantity.from_line(float(text))
        except ValueError:
            raise setting_error(
                f"'{text}' is not a plain number", "a format such as .3f", at=("send",)
            ) from None
        if not low - slack <= value <= high + slack:
            what = f"{key} as '{clean(text)}' would be {argument.quantity.shown(value)}, beyond the limit"
            raise setting_error(
                what, "a limit with no more digits than are sent", at=("arguments", name, key)
            )

    @model_validator(mode="after")
    def _check_replies(self) -> Self:
        if self.reply is None:
            for key in ("error", "example"):
                if getattr(self, key) is not None:
                    what = f"'{key}' is about a reply, but there is no 'reply'"
                    raise setting_error(what, "a 'reply'", at=(key,), key=True)
            return self
        check_reply(self.reply, self.example)
        check_pattern(self.error, "error")
        return self


class SerialSettings(Settings):
    """An instrument on a serial line."""

    port: Text | None = Field(
        default=None,
        description="where it is connected: `/dev/ttyUSB0`, `COM3`, `socket://host:port`, "
        "`rfc2217://host:port`, or `simulated` for an instrument made of this description",
    )
    usb: UsbSettings | None = Field(default=None, description="the adapter, instead of a port")
    baud_rate: int = Field(default=9600, ge=50, le=12_000_000, description="bits per second")
    data_bits: Literal[5, 6, 7, 8] = Field(default=8, description="bits per character")
    parity: Literal["none", "even", "odd", "mark", "space"] = Field(default="none", description="parity bit")
    stop_bits: Literal[1, 2] = Field(default=1, description="bits between characters")
    flow_control: Literal["none", "rts_cts", "dsr_dtr", "xon_xoff"] = Field(
        default="none", description="how the instrument signals that it can take no more"
    )
    write_ends_with: Text = Field(
        description='what ends a command, in double quotes, as `"\\r"`. It is added to each text'
    )
    read_ends_with: Text = Field(
        description='what ends a reply, either a line end or the next prompt, as `"\\r\\n> "`',
    )
    encoding: Literal["ascii", "latin-1", "utf-8"] = Field(default="ascii", description="text encoding")
    echo: bool = Field(default=False, description="whether the instrument repeats what it is sent")
    timeout: PositiveDuration = Field(default=0.5, description="how long a reply may take")
    retries: int = Field(
        default=2,
        ge=0,
        le=10,
        description="how often a question or repeatable command is repeated if its reply is missing or "
        "unreadable",
    )
    pause: Duration = Field(default=0.0, description="time that the instrument needs before the next command")
    wait_after_open: Duration = Field(
        default=0.0, description="time that it needs after the port was opened, as an Arduino restarts then"
    )
    identify: IdentifySettings | None = Field(
        default=None, description="how the instrument reports what it is. Any other instrument is refused"
    )
    on_open: tuple[Text, ...] = Field(
        default=(), description="commands without arguments that are sent once it is open, such as `[remote]`"
    )
    commands: dict[Text, CommandSettings] = Field(default={}, description="its commands, by name")
    values: dict[Text, ValueSettings] = Field(default={}, description="values that can be read, by name")
    safe_state: tuple[Text, ...] = Field(
        default=(), description="commands without arguments that make it safe, or none to leave it as it is"
    )

    def texts(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """All texts that are sent, with their places. Commands are without their arguments."""
        if self.identify is not None:
            yield ("identify", "ask"), self.identify.ask
        for name, value in self.values.items():
            yield ("values", name, "ask"), value.ask
        for name, command in self.commands.items():
            yield ("commands", name, "send"), command.send

    def why_unsendable(self, text: str) -> str:
        """Why a text cannot be sent, and what to do, "" if it can be sent."""
        if self.write_ends_with in text:
            what = f"'{clean(text)}' contains the end of a command"
            return f"{what}; leave it out, since 'write_ends_with' is added to each text"
        if not _can_be(text, self.encoding):
            return f"'{clean(text)}' is not {self.encoding}; use another 'encoding', or other characters"
        return ""

    @property
    def polled(self) -> list[str]:
        """Names of the values that are recorded with each shot."""
        return [name for name, value in self.values.items() if value.poll]

    def identities(self) -> tuple[str, ...]:
        """Names of the line, which only one process can use."""
        if self.usb is None:
            return () if self.port in (None, SIMULATED) else port_identities(self.port)
        fits = self.usb.ports()
        found = port_identities(fits[0].device) if len(fits) == 1 else ()
        return (f"USB adapter {self.usb.model_dump(exclude_none=True)}", *found)

    @model_validator(mode="after")
    def _check_port(self) -> Self:
        if self.port is None and self.usb is None:
            raise setting_error(
                "it has no port", "'port' or 'usb'", "`labseq devices` names the ports if one is wrong"
            )
        if self.port is not None and self.usb is not None and self.port != SIMULATED:
            raise setting_error("it has both 'port' and 'usb'", "one of them", at=("usb",), key=True)
        if "://" in (self.port or "") and not is_network_port(self.port or ""):
            what = f"'{clean(self.port or '')}' is not a port"
            expected = "socket://host:port or rfc2217://host:port, or a port of this computer"
            raise setting_error(what, expected, at=("port",))
        return self

    @model_validator(mode="after")
    def _check_texts(self) -> Self:
        for key in ("write_ends_with", "read_ends_with"):
            text: str = getattr(self, key)
            if "\\" in text:
                raise setting_error(
                    f"'{text}' holds a backslash",
                    "control characters",
                    'write "\\r" in double quotes',
                    at=(key,),
                )
            if not _can_be(text, self.encoding):
                raise setting_error(
                    f"'{clean(text)}' is not {self.encoding}", "another encoding", at=("encoding",)
                )
        for at, text in self.texts():
            if problem := self.why_unsendable(text):
                raise placed(ValueError(problem), *at)
        return self

    @model_validator(mode="after")
    def _check_calls(self) -> Self:
        for key in ("on_open", "safe_state"):
            names: tuple[str, ...] = getattr(self, key)
            for i, name in enumerate(names):
                command = self.commands.get(name)
                if command is None:
                    raise unknown(f"there is no command '{clean(name)}'", name, self.commands, key, i)
                if command.arguments:
                    what = f"'{name}' needs {', '.join(command.arguments)}"
                    hint = "declare one with their values in its text"
                    raise setting_error(what, "a command without arguments", hint, at=(key, i))
        return self

    @model_validator(mode="after")
    def _check_made_values(self) -> Self:
        for name, command in self.commands.items():
            for made, state in command.makes.items():
                at = ("commands", name, "makes", made)
                value = self.values.get(made)
                if value is None:
                    raise unknown(f"there is no value '{clean(made)}'", made, self.values, *at, key=True)
                kind, expected = _MADE.get(value.type, (None, "a value of another type"))
                if type(state) is not kind:
                    raise setting_error(f"the value '{made}' is of type {value.type}", expected, at=at)
        return self

    @model_validator(mode="after")
    def _check_simulated_replies(self) -> Self:
        if self.port != SIMULATED:
            return self
        for at, pattern, reply in self._simulated_replies():
            if reply is None:
                what = f"a simulated instrument cannot make a reply of the pattern '{clean(pattern)}'"
                raise setting_error(what, "an example of one", "add 'example'", at=(*at, "reply"))
        return self

    def _simulated_replies(self) -> Iterator[tuple[tuple[str, ...], str, str | None]]:
        """Place and pattern of each reply, and the simulated instrument's reply."""
        if self.identify is not None:
            yield ("identify",), self.identify.reply, self.identify.simulated_reply
        for name, command in self.commands.items():
            if command.reply is not None:
                yield ("commands", name), command.reply, command.simulated_reply
        for name, value in self.values.items():
            yield ("values", name), value.reply, value.reply_with(value.typical)


def unknown(
    what: str, name: str, names: Mapping[str, object], *at: str | int, key: bool = False
) -> PydanticCustomError:
    """The error for a name that the profile does not declare."""
    meant = closest(name, names)
    expected = one_of(list(names)) if names else "none, as the profile declares none"
    return setting_error(what, expected, f"did you mean '{meant}'?" if meant else "", at=at, key=key)


def _can_be(text: str, encoding: str) -> bool:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True


def check_pattern(pattern: str | None, key: str) -> re.Pattern[str] | None:
    """Refuse a text that is not a pattern."""
    try:
        return None if pattern is None else compiled(pattern)
    except ValueError as error:
        raise placed(error, key) from None


def check_reply(pattern: str, example: str | None) -> None:
    """Refuse an invalid pattern, and an example that does not match it."""
    found = check_pattern(pattern, "reply")
    if found is not None and example is not None and found.fullmatch(example) is None:
        what = f"the reply '{clean(example)}' does not match"
        raise setting_error(what, f"one like '{clean(pattern)}'", at=("example",))
