"""The driver of an instrument that the profile describes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, TypeVar

from labseq.plugin import (
    Clock,
    Context,
    Device,
    DeviceError,
    DeviceTimeoutError,
    Emergency,
    LabseqError,
    LimitError,
    TransientError,
    format_quantity,
)
from labseq.plugin.messages import clean, unknown_name
from labseq.plugin.serial import SerialMessage
from labseq_serial.line import Line, open_line
from labseq_serial.patterns import compiled
from labseq_serial.settings import SerialSettings
from labseq_serial.simulated import SimulatedLine
from labseq_serial.values import Scalar

T = TypeVar("T")

LOOK_S: Final = 0.02
"""Time between two readings of a value that a command changes, in seconds."""
IDENTITY: Final = ("model", "serial_number", "firmware")
"""Groups of the pattern of an identity that ``describe`` shows."""


class RefusedError(DeviceError):
    """The instrument reported an error. Sending the same again does not help."""


class Instrument:
    """The commands and values of an instrument on an open line."""

    def __init__(
        self, line: Line | SimulatedLine, settings: SerialSettings, device: str, clock: Clock
    ) -> None:
        self.line = line
        self._settings = settings
        self._device = device
        self._clock = clock

    def identify(self) -> dict[str, str]:
        """Ask for the instrument's identity, empty if the profile has no ``identify``."""
        identify = self._settings.identify
        if identify is None:
            return {}

        def ask() -> dict[str, str]:
            reply = self.line.identify()
            match = compiled(identify.reply).fullmatch(reply)
            if match is None:
                what = f"the instrument reports that it is '{clean(reply)}'"
                raise DeviceError(
                    self._device, f"{what}, not '{clean(identify.reply)}'; is it the right port?"
                )
            identity = {key: text for key, text in match.groupdict().items() if key in IDENTITY and text}
            return {"model": reply, **identity}

        return self._retried(ask)

    def read(self, name: str) -> Scalar:
        """Read a value, in SI."""
        value = self._settings.values[name]

        def ask() -> Scalar:
            reply = self.line.ask(name)
            self._refuse(value.error, value.ask, reply)
            try:
                return value.value_in(reply)
            except ValueError as error:
                text = f"{name}: '{clean(value.ask)}' was answered by '{clean(reply)}': {error}"
                raise DeviceError(self._device, text) from None

        return self._retried(ask)

    def carry_out(self, name: str, arguments: Mapping[str, Scalar]) -> None:
        """Send a command, wait for its reply, and until the values are as the command makes them."""
        command = self._settings.commands[name]
        timeout_s = command.timeout or self._settings.timeout
        text = command.text(arguments)

        def send() -> None:
            reply = self.line.send(name, arguments)
            self._refuse(command.error, text, reply)
            if command.reply is not None and compiled(command.reply).fullmatch(reply) is None:
                what = f"{name}: '{clean(text)}' was answered by '{clean(reply)}'"
                raise DeviceError(self._device, f"{what}; expected '{clean(command.reply)}'")

        if command.makes and self._differing(command.makes) is None:
            return
        # a toggle whose reply was lost may have been carried out, so only the profile knows what to repeat
        self._retried(send) if command.repeatable else send()
        end_s = self._clock.now() + timeout_s
        while (differing := self._differing(command.makes)) is not None:
            if self._clock.now() >= end_s:
                waited = format_quantity(timeout_s, "time")
                text = f"{name}: '{clean(text)}' was sent, but after {waited} {differing}"
                raise DeviceTimeoutError(self._device, text, timeout_s)
            self._clock.sleep(LOOK_S)

    def carry_out_all(self, names: Iterable[str]) -> list[LabseqError]:
        """Carry out commands without arguments, even after one fails.

        Returns:
            The failures.
        """
        failures: list[LabseqError] = []
        for name in names:
            try:
                self.carry_out(name, {})
            except LabseqError as failure:
                failures.append(failure)
        return failures

    def message(self, name: str) -> SerialMessage:
        """The text of a command without arguments, and its effect, for another process."""
        settings = self._settings
        command = settings.commands[name]
        answered = command.reply is not None
        return SerialMessage(
            command.text({}) + settings.write_ends_with,
            settings.read_ends_with if answered else "",
            command.timeout or settings.timeout if answered else settings.pause,
            command.reply or "",
            command.error,
            repeatable=command.repeatable,
            unless=tuple(self._question(made, state) for made, state in command.makes.items()),
        )

    def _question(self, name: str, state: bool | int | str) -> SerialMessage:
        """The message that asks whether a value is as a command makes it."""
        settings, value = self._settings, self._settings.values[name]
        return SerialMessage(
            value.ask + settings.write_ends_with,
            settings.read_ends_with,
            value.timeout or settings.timeout,
            value.reply,
            value.error,
            value=value.words[state] if isinstance(state, bool) else state,
            choices=tuple(value.words) if isinstance(state, bool) else (),
        )

    def _differing(self, makes: Mapping[str, Scalar]) -> str | None:
        """Describe the first value that is not as a command makes it, None if all are."""
        for name, made in makes.items():
            value = self._settings.values[name]
            if (reading := self.read(name)) != made:
                return f"{name} is {value.shown(reading)}, not {value.shown(made)}"
        return None

    def _refuse(self, pattern: str | None, text: str, reply: str) -> None:
        if pattern is not None and compiled(pattern).fullmatch(reply):
            raise RefusedError(self._device, f"'{clean(text)}' was refused: '{clean(reply)}'")

    def _retried(self, ask: Callable[[], T]) -> T:
        """Repeat after no reply or an unreadable one, as often as the profile says."""
        for _ in range(self._settings.retries):
            try:
                return ask()
            except RefusedError:
                raise
            except DeviceError:
                if self.line.aborted.is_set():
                    raise
        return ask()


class SerialDevice(Device):
    """An instrument on a serial line, described in the profile.

    A line that breaks in a shot fails the shot with ``TransientError``. The next call opens the port once
    more, checks that it is the same instrument, and sends ``on_open`` again. If that fails, a ``DeviceError``
    ends the run.
    """

    def __init__(self, settings: SerialSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "device"
        self._clock = context.clock
        self._lock = threading.RLock()
        self._instrument: Instrument | None = None
        self._identity: dict[str, str] = {}
        self._readings: dict[str, tuple[float, Scalar]] = {}

    def open(self) -> None:
        """Open the port, check that it is the right instrument, and send ``on_open``.

        Raises:
            DeviceError: It cannot be opened, does not answer, or is another instrument.
        """
        with self._lock:
            if self._instrument is None:
                self._instrument = self._connected()

    def close(self) -> None:
        """Close the port. Legal in any state."""
        with self._lock:
            if self._instrument is not None:
                self._instrument.line.close()
            self._instrument = None

    def safe_state(self) -> None:
        """Send every command of the safe state, even after one fails. Legal in any state.

        Raises:
            DeviceError: Some failed. All were tried.
        """
        instrument = self._instrument
        if instrument is None or not self._settings.safe_state:
            return
        instrument.line.aborted.set()  # end a wait for a reply in another thread
        with self._lock:
            instrument.line.aborted.clear()
            if self._instrument is None:
                return
            failures = self._ready(on_open=False).carry_out_all(self._settings.safe_state)
        if failures:
            raise DeviceError(self._name, "; ".join(map(self._unnamed, failures)))

    def emergency(self) -> Emergency | None:
        """The commands of the safe state, which another process sends."""
        instrument, settings = self._instrument, self._settings
        if instrument is None or not settings.safe_state:
            return None
        ready = [SerialMessage("", within_s=settings.wait_after_open)] if settings.wait_after_open else []
        messages = [*ready, *map(instrument.message, settings.safe_state)]
        return instrument.line.emergency(messages)

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a declared command.

        Args:
            name: Its name.
            **arguments: Its arguments, quantities in SI or as text such as "80 MHz".

        Raises:
            DeviceError: Not open, an unknown command or argument, no or a wrong reply.
            LimitError: An argument is outside its limits. Nothing was sent.
            TransientError: The line broke.
        """
        values = self._checked(name, arguments)
        with self._lock:
            self._ready().carry_out(name, values)

    def check_command(self, name: str, **arguments: Any) -> None:
        """Check a command and its arguments. Nothing is sent, and the device need not be open.

        Raises:
            DeviceError: An unknown command or argument, or one of another type.
            LimitError: An argument is outside its limits.
        """
        self._checked(name, arguments)

    def read(self, name: str) -> Scalar:
        """Read a declared value. Quantities are in SI.

        Raises:
            DeviceError: Not open, an unknown or implausible value, no or a wrong reply.
            TransientError: The line broke.
        """
        if name not in self._settings.values:
            raise unknown_name(self._name, "value", name, [*self._settings.values])
        with self._lock:
            reading = self._ready().read(name)
            self._readings[name] = self._clock.now(), reading
            return reading

    def poll(self) -> Mapping[str, Scalar]:
        """Read the values that are recorded with each shot."""
        return {name: self.read(name) for name in self._settings.polled}

    def check_interlocks(self) -> None:
        """Read the values that have an interlock, unless they were read just now.

        Raises:
            DeviceError: One is outside its limits, or cannot be read.
            TransientError: The line broke.
        """
        for name, value in self._settings.values.items():
            lock = value.interlock
            if lock is None:
                continue
            read_s, reading = self._readings.get(name, (0.0, False))
            is_fresh = name in self._readings and self._clock.now() - read_s < lock.max_age
            reading = reading if is_fresh else self.read(name)
            if not lock.allows(reading, value.quantity):
                text = f"{name} is {value.shown(reading)}, but must be {lock.shown(value.quantity)}"
                raise DeviceError(self._name, f"{text}; {lock.message}" if lock.message else text)

    def self_test(self) -> None:
        """Read every declared value, which must be plausible."""
        for name in self._settings.values:
            self.read(name)

    def describe(self) -> Mapping[str, Any]:
        """Port, commands, values, and the identity of the instrument, read again if it is open."""
        settings, instrument = self._settings, self._instrument
        if instrument is not None:
            with self._lock:
                self._identity = self._ready().identify()
        return {
            "model": "serial instrument",
            **self._identity,
            "port": settings.port or (settings.usb and settings.usb.model_dump(exclude_none=True)),
            "baud_rate": settings.baud_rate,
            "commands": list(settings.commands),
            "values": list(settings.values),
            "units": {name: value.quantity.si_name for name, value in settings.values.items() if value.unit},
        }

    def _ready(self, *, on_open: bool = True) -> Instrument:
        """The instrument. A broken line is opened again."""
        if self._instrument is None:
            raise DeviceError(self._name, "not open; call open() first")
        if self._instrument.line.broken:
            self._instrument.line.close()
            try:
                self._instrument = self._connected(on_open=on_open)
            except DeviceError as error:
                text = f"the line broke and could not be opened again: {self._unnamed(error)}"
                raise DeviceError(self._name, text) from error
        return self._instrument

    def _connected(self, *, on_open: bool = True) -> Instrument:
        """The right instrument on an open line."""
        settings = self._settings
        line = open_line(settings, self._name, self._clock)
        instrument = Instrument(line, settings, self._name, self._clock)
        try:
            self._identity = instrument.identify()
            if on_open:
                self._begin(instrument)
        except TransientError as error:
            line.close()
            raise DeviceError(self._name, self._unnamed(error)) from error
        except BaseException:
            line.close()
            raise
        return instrument

    def _begin(self, instrument: Instrument) -> None:
        """Send ``on_open``, after a failure also ``safe_state``."""
        try:
            for name in self._settings.on_open:
                instrument.carry_out(name, {})
        except LabseqError:
            # half set up, with the port about to be closed, so nothing else would make it safe
            instrument.carry_out_all(self._settings.safe_state)
            raise

    def _checked(self, name: str, given: Mapping[str, object]) -> dict[str, Scalar]:
        """The arguments of a command, in SI."""
        command = self._settings.commands.get(name)
        if command is None:
            raise unknown_name(self._name, "command", name, [*self._settings.commands])
        if {*given} != {*command.arguments}:
            came = f"the arguments {', '.join(given)}" if given else "no arguments"
            expected = ", ".join(command.arguments) or "none"
            raise DeviceError(self._name, f"'{name}' has {came}; expected {expected}")
        values: dict[str, Scalar] = {}
        for key, argument in command.arguments.items():
            try:
                values[key] = argument.value_of(given[key])
            except ValueError as error:
                raise DeviceError(self._name, f"{key} of '{name}': {error}") from None
            if not argument.allows(values[key]):
                what = f"{self._name}: {key} of '{name}'"
                raise LimitError(what, argument.shown(values[key]), argument.shown_limits())
        if problem := self._settings.why_unsendable(command.text(values)):
            raise DeviceError(self._name, problem)
        return values

    def _unnamed(self, error: LabseqError) -> str:
        """The text of an error without the device's name."""
        return str(error).removeprefix(f"{self._name}: ")
