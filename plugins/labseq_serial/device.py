"""The driver of an instrument that the profile describes."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from labseq.plugin import (
    Context,
    Device,
    DeviceError,
    LabseqError,
    LimitError,
    TransientError,
    clean,
)
from labseq_serial.arguments import Scalar
from labseq_serial.instrument import Instrument
from labseq_serial.line import Line
from labseq_serial.ports import open_line
from labseq_serial.settings import SIMULATED, SerialSettings, known
from labseq_serial.simulated import SimulatedPort


class SerialDevice(Device):
    """An instrument on a serial line, described in the profile.

    A line that breaks in a shot fails the shot with ``TransientError``. The next call opens the port once
    more, makes sure that the same instrument is there, and sends ``on_open`` again; if that fails, it is a
    ``DeviceError``, which ends the run.

    Args:
        settings: The description.
        context: Name and clock.
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
        """Open the port, make sure that it is the right instrument, and send ``on_open``.

        Raises:
            DeviceError: It cannot be opened, does not answer, or is another.
        """
        with self._lock:
            if self._instrument is None:
                self._instrument = self._connected()

    def close(self) -> None:
        """Close the port; legal in any state."""
        with self._lock:
            if self._instrument is not None:
                self._instrument.line.close()
            self._instrument = None

    def safe_state(self) -> None:
        """Send every command of the safe state, also after one that fails; legal in any state.

        Raises:
            DeviceError: Some failed; all were tried.
        """
        instrument = self._instrument
        if instrument is None or not self._settings.safe_state:
            return
        instrument.line.given_up.set()  # whoever waits for a reply shall not keep us
        with self._lock:
            instrument.line.given_up.clear()
            if self._instrument is None:
                return
            failures = self._ready(on_open=False).carry_out_all(self._settings.safe_state)
        if failures:
            raise DeviceError(self._name, "; ".join(map(self._unnamed, failures)))

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a declared command.

        Args:
            name: Its name.
            **arguments: Its arguments: quantities in SI, or as text such as "80 MHz".

        Raises:
            DeviceError: Not open, an unknown command or argument, no or a wrong reply.
            LimitError: An argument is past its limit; nothing was sent.
            TransientError: The line broke.
        """
        values = self._checked(name, arguments)
        with self._lock:
            self._ready().carry_out(name, values)

    def check_command(self, name: str, **arguments: Any) -> None:
        """Check a command and its arguments; nothing is sent, and the device need not be open.

        Raises:
            DeviceError: An unknown command or argument, or one of another type.
            LimitError: An argument is past its limit.
        """
        self._checked(name, arguments)

    def read(self, name: str) -> Scalar:
        """Ask for a declared value; quantities are in SI.

        Raises:
            DeviceError: Not open, an unknown or implausible value, no or a wrong reply.
            TransientError: The line broke.
        """
        if name not in self._settings.values:
            raise DeviceError(
                self._name, f"unknown value '{clean(name)}'; expected {known(self._settings.values)}"
            )
        with self._lock:
            reading = self._ready().read(name)
            self._readings[name] = self._clock.now(), reading
            return reading

    def poll(self) -> Mapping[str, Scalar]:
        """Read the values that are kept with each shot."""
        return {name: self.read(name) for name, value in self._settings.values.items() if value.poll}

    def check_interlocks(self) -> None:
        """Read the values that have an interlock, unless they were read just now.

        Raises:
            DeviceError: One is past its limit, or cannot be read.
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
                text = f"{name} is {value.shown(reading)}; the interlock expects {lock.shown(value.quantity)}"
                raise DeviceError(self._name, f"{text}; {lock.message}" if lock.message else text)

    def self_test(self) -> None:
        """Read every declared value; it must be plausible."""
        for name in self._settings.values:
            self.read(name)

    def describe(self) -> Mapping[str, Any]:
        """Port, commands, values, and what the instrument says of itself; it is asked anew if it is open."""
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
        }

    def _ready(self, *, on_open: bool = True) -> Instrument:
        """The instrument; a line that broke is opened anew."""
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
        is_simulated = settings.port == SIMULATED
        port = SimulatedPort(settings, self._clock) if is_simulated else open_line(settings, self._name)
        line = Line(port, settings, self._name, self._clock)
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
        """Send ``on_open``; after a failure nothing stays half set up."""
        try:
            for call in self._settings.on_open:
                instrument.call(call)
        except LabseqError:
            instrument.carry_out_all(self._settings.safe_state)
            raise

    def _checked(self, name: str, given: Mapping[str, object]) -> dict[str, Scalar]:
        """The arguments of a command, in SI."""
        command = self._settings.commands.get(name)
        if command is None:
            text = f"unknown command '{clean(name)}'; expected {known(self._settings.commands)}"
            raise DeviceError(self._name, text)
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
        """What an error says, without the name that stands before it."""
        return str(error).removeprefix(f"{self._name}: ")
