"""What an instrument is asked and told, in the words of its description."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Final, TypeVar

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError, LabseqError, clean, format_quantity
from labseq_serial.arguments import Scalar
from labseq_serial.commands import Call, call_of
from labseq_serial.line import Line
from labseq_serial.replies import compiled
from labseq_serial.settings import SerialSettings

T = TypeVar("T")

LOOK_S: Final = 0.02
"""How often a value is read until a command has made it so, in seconds."""
IDENTITY: Final = ("model", "serial_number", "firmware")
"""Groups of the pattern of an identity that are told."""


class RefusedError(DeviceError):
    """The instrument answered that it will not; asking again makes it no better."""


class Instrument:
    """Speaks to an instrument on an open line.

    Args:
        line: The line.
        settings: The description.
        device: Its name, for messages.
        clock: The session's clock.
    """

    def __init__(self, line: Line, settings: SerialSettings, device: str, clock: Clock) -> None:
        self.line = line
        self._settings = settings
        self._device = device
        self._clock = clock

    def identify(self) -> dict[str, str]:
        """Ask what it is; empty if the profile does not say how.

        Raises:
            DeviceError: It is another instrument, or does not answer.
        """
        identify = self._settings.identify
        if identify is None:
            return {}

        def ask() -> dict[str, str]:
            reply = self.line.exchange(identify.ask, self._settings.timeout)
            match = compiled(identify.reply).fullmatch(reply)
            if match is None:
                what = f"the instrument says that it is '{clean(reply)}'"
                raise DeviceError(
                    self._device, f"{what}; expected '{clean(identify.reply)}'; is it the right port?"
                )
            told = {key: text for key, text in match.groupdict().items() if key in IDENTITY and text}
            return {"model": reply, **told}

        return self._tried(ask)

    def read(self, name: str) -> Scalar:
        """Ask for a value, in SI.

        Raises:
            DeviceError: It does not answer, or in a way that the description does not know.
        """
        value = self._settings.values[name]

        def ask() -> Scalar:
            reply = self.line.exchange(value.ask, value.timeout or self._settings.timeout)
            self._refuse(value.error, value.ask, reply)
            try:
                return value.value_in(reply)
            except ValueError as error:
                text = f"{name}: '{clean(value.ask)}' was answered by '{clean(reply)}': {error}"
                raise DeviceError(self._device, text) from None

        return self._tried(ask)

    def carry_out(self, name: str, values: Mapping[str, Scalar]) -> None:
        """Send a command, wait for its reply, and until it has made what it makes.

        Args:
            name: Its name.
            values: Its arguments, in SI, checked.

        Raises:
            DeviceError: No or a wrong reply.
        """
        command = self._settings.commands[name]
        timeout_s = command.timeout or self._settings.timeout
        text = command.text(values)

        def send() -> None:
            reply = self.line.exchange(text, timeout_s, answered=command.reply is not None)
            self._refuse(command.error, text, reply)
            if command.reply is not None and compiled(command.reply).fullmatch(reply) is None:
                what = f"{name}: '{clean(text)}' was answered by '{clean(reply)}'"
                raise DeviceError(self._device, f"{what}; expected '{clean(command.reply)}'")

        if command.makes and self._differing(command.makes) is None:
            return
        self._tried(send) if command.repeatable else send()
        end_s = self._clock.now() + timeout_s
        while (differing := self._differing(command.makes)) is not None:
            if self._clock.now() >= end_s:
                waited = format_quantity(timeout_s, "time")
                text = f"{name}: '{clean(text)}' was sent, but after {waited} {differing}"
                raise DeviceTimeoutError(self._device, text, timeout_s)
            self._clock.sleep(LOOK_S)

    def carry_out_all(self, calls: Iterable[Call]) -> list[LabseqError]:
        """Carry out calls of the description, also after one that fails.

        Returns:
            What failed.
        """
        failures: list[LabseqError] = []
        for call in calls:
            try:
                self.call(call)
            except LabseqError as failure:
                failures.append(failure)
        return failures

    def call(self, call: Call) -> None:
        """Carry out a call of the description; its arguments were checked with the profile."""
        name, given = call_of(call)
        arguments = self._settings.commands[name].arguments
        self.carry_out(name, {key: arguments[key].value_of(value) for key, value in given.items()})

    def _differing(self, makes: Mapping[str, Scalar]) -> str | None:
        """The first value that is not as a command makes it, in words; None if all are."""
        for name, made in makes.items():
            value = self._settings.values[name]
            if (reading := self.read(name)) != made:
                return f"{name} is {value.shown(reading)}; expected {value.shown(made)}"
        return None

    def _refuse(self, pattern: str | None, text: str, reply: str) -> None:
        if pattern is not None and compiled(pattern).fullmatch(reply):
            raise RefusedError(self._device, f"'{clean(text)}' was refused: '{clean(reply)}'")

    def _tried(self, ask: Callable[[], T]) -> T:
        """Ask again after no reply or an unreadable one, as often as the profile says."""
        for _ in range(self._settings.retries):
            try:
                return ask()
            except RefusedError:
                raise
            except DeviceError:
                if self.line.given_up.is_set():
                    raise
        return ask()
