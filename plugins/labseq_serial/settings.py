"""An instrument on a serial line, as the profile describes it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, Literal, Self

from pydantic import Field, model_validator

from labseq.plugin import Duration, Settings, Text, clean, closest, is_network_port, one_of, setting_error
from labseq_serial.arguments import Scalar, placed
from labseq_serial.commands import Call, CommandSettings, IdentifySettings, PositiveDuration, call_of
from labseq_serial.values import ValueSettings

SIMULATED: Final = "simulated"
"""The port that needs no instrument."""
_SCHEMES: Final = ("socket", "rfc2217")
_MADE: Final[Mapping[str, tuple[type[Scalar], str]]] = {
    "bool": (bool, "true or false"),
    "int": (int, "a whole number"),
    "text": (str, "text, in quotes"),
}
"""Types of values that a command can make, and in words."""


class UsbSettings(Settings):
    """A USB adapter, whichever port it has today."""

    vid: int | None = Field(default=None, ge=0, le=0xFFFF, description="vendor's number, as 0x0403")
    pid: int | None = Field(default=None, ge=0, le=0xFFFF, description="product's number, as 0x6001")
    serial: Text | None = Field(default=None, description="serial number")

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.vid is None and self.pid is None and self.serial is None:
            raise setting_error("this fits every adapter", "vid, pid or serial")
        return self


class SerialSettings(Settings):
    """An instrument on a serial line."""

    port: Text | None = Field(
        default=None,
        description="where it is connected: `/dev/ttyUSB0`, `COM3`, `socket://host:port`, "
        "`rfc2217://host:port`, or `simulated` for an instrument made of this description",
    )
    usb: UsbSettings | None = Field(default=None, description="the adapter, in the place of a port")
    baud_rate: int = Field(default=9600, ge=50, le=12_000_000, description="bits per second")
    data_bits: Literal[5, 6, 7, 8] = Field(default=8, description="bits per character")
    parity: Literal["none", "even", "odd", "mark", "space"] = Field(
        default="none", description="its parity bit"
    )
    stop_bits: Literal[1, 2] = Field(default=1, description="bits between characters")
    flow_control: Literal["none", "rts_cts", "dsr_dtr", "xon_xoff"] = Field(
        default="none", description="how the instrument says that it can take no more"
    )
    write_ends_with: Text = Field(
        description='what ends a command, in double quotes, as `"\\r"`; it is added to what is sent'
    )
    read_ends_with: Text = Field(
        description='what ends a reply: the end of the line, or the next prompt, as `"\\r\\n> "`',
    )
    encoding: Literal["ascii", "latin-1", "utf-8"] = Field(default="ascii", description="of the characters")
    echo: bool = Field(default=False, description="whether the instrument repeats what it is sent")
    timeout: PositiveDuration = Field(default=0.5, description="how long a reply may take")
    retries: int = Field(
        default=2,
        ge=0,
        le=10,
        description="how often what can be repeated is asked again after no reply or an unreadable one",
    )
    pause: Duration = Field(default=0.0, description="time that the instrument needs before the next command")
    wait_after_open: Duration = Field(
        default=0.0, description="time that it needs after the port was opened: an Arduino restarts then"
    )
    identify: IdentifySettings | None = Field(
        default=None, description="how the instrument says what it is; another one is refused"
    )
    on_open: tuple[Call, ...] = Field(
        default=(),
        description="commands sent when it was opened: `[remote, {do: mode, arguments: {number: 1}}]`",
    )
    commands: dict[Text, CommandSettings] = Field(default={}, description="its commands, by name")
    values: dict[Text, ValueSettings] = Field(
        default={}, description="values that it can be asked for, by name"
    )
    safe_state: tuple[Call, ...] = Field(
        default=(), description="commands that make it harmless; none: it is left as it is"
    )

    def asked(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """Everything that may be sent, with its place: questions, and commands at their limits."""
        if self.identify is not None:
            yield ("identify", "ask"), self.identify.ask
        for name, value in self.values.items():
            yield ("values", name, "ask"), value.ask
        for name, command in self.commands.items():
            for values in command.extremes():
                yield ("commands", name, "send"), command.text(values)

    def why_unsendable(self, text: str) -> str:
        """Why a text cannot be sent, and what to do; "" if it can."""
        if self.write_ends_with in text:
            what = f"'{clean(text)}' holds what ends a command"
            return f"{what}; expected it without: 'write_ends_with' is added to what is sent"
        if not _can_be(text, self.encoding):
            return f"'{clean(text)}' is not {self.encoding}; expected another 'encoding', or other characters"
        return ""

    @model_validator(mode="after")
    def _has_one_port(self) -> Self:
        if self.port is None and self.usb is None:
            raise setting_error(
                "it has no port", "'port' or 'usb'", "`labseq devices` names the ports if one is wrong"
            )
        if self.port is not None and self.usb is not None and self.port != SIMULATED:
            raise setting_error("it has both 'port' and 'usb'", "one of them", at=("usb",), key=True)
        scheme, is_url, _ = (self.port or "").partition("://")
        if is_url and not (scheme in _SCHEMES and is_network_port(self.port or "")):
            known = " or ".join(f"{one}://host:port" for one in _SCHEMES)
            raise setting_error(
                f"'{clean(self.port or '')}' is no port", f"{known}, or a port of this computer", at=("port",)
            )
        return self

    @model_validator(mode="after")
    def _texts_can_be_sent(self) -> Self:
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
        for at, text in self.asked():
            if problem := self.why_unsendable(text):
                raise placed(ValueError(problem), *at)
        return self

    @model_validator(mode="after")
    def _calls_can_be_made(self) -> Self:
        for key in ("on_open", "safe_state"):
            calls: tuple[Call, ...] = getattr(self, key)
            for i, call in enumerate(calls):
                self._check_call(call, (key, i))
        return self

    def _check_call(self, call: Call, at: tuple[str | int, ...]) -> None:
        name, arguments = call_of(call)
        command = self.commands.get(name)
        place = at if isinstance(call, str) else (*at, "do")
        if command is None:
            meant = closest(name, self.commands)
            hint = f"did you mean '{meant}'?" if meant else "declare it below 'commands'"
            raise setting_error(f"there is no command '{clean(name)}'", known(self.commands), hint, at=place)
        for argument, given in arguments.items():
            inner = (*at, "arguments", argument)
            declared = command.arguments.get(argument)
            if declared is None:
                what = f"'{name}' has no argument '{clean(argument)}'"
                raise setting_error(what, known(command.arguments), at=inner, key=True)
            try:
                value = declared.value_of(given)
            except ValueError as error:
                raise placed(ValueError(f"{argument}: {error}"), *inner) from None
            if not declared.allows(value):
                raise setting_error(f"{argument} is {given}", declared.shown_limits(), at=inner)
        missing = [argument for argument in command.arguments if argument not in arguments]
        if missing:
            what, first = f"'{name}' needs {', '.join(missing)}", missing[0]
            raise setting_error(what, f"{{do: {name}, arguments: {{{first}: ...}}}}", at=place)

    @model_validator(mode="after")
    def _commands_make_values(self) -> Self:
        for name, command in self.commands.items():
            for made, state in command.makes.items():
                at = ("commands", name, "makes", made)
                value = self.values.get(made)
                if value is None:
                    raise setting_error(
                        f"there is no value '{clean(made)}'", known(self.values), at=at, key=True
                    )
                kind, expected = _MADE.get(value.type, (None, "a value of another type"))
                if type(state) is not kind:
                    raise setting_error(f"the value '{made}' is of type {value.type}", expected, at=at)
        return self


def known(names: Mapping[str, object]) -> str:
    """What the profile declares of something, in words."""
    return one_of(list(names)) if names else "none: the profile declares none"


def _can_be(text: str, encoding: str) -> bool:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True
