"""An instrument simulated from its description, which replaces the line to a real one."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from labseq.plugin import Clock, Emergency
from labseq.plugin.serial import SerialMessage
from labseq_serial.settings import SerialSettings
from labseq_serial.values import Scalar


class SimulatedLine:
    """Keeps the values that commands set, and replies like the instrument. It has the methods of a ``Line``.

    A value with the name of an argument is that argument's last value. A value that a command ``makes`` is as
    the command made it. Other values match their examples or limits. Texts take as long as on a
    line.
    """

    broken = False

    def __init__(self, settings: SerialSettings, clock: Clock) -> None:
        self.aborted = threading.Event()
        self._settings = settings
        self._clock = clock
        self._values = {name: value.typical for name, value in settings.values.items()}
        self._free_s = clock.now() + settings.wait_after_open

    def identify(self) -> str:
        """The instrument's identity."""
        identify = self._settings.identify
        return "" if identify is None else self._exchanged(identify.ask, identify.simulated_reply)

    def ask(self, name: str) -> str:
        """A value."""
        value = self._settings.values[name]
        return self._exchanged(value.ask, value.reply_with(self._values[name]))

    def send(self, name: str, arguments: Mapping[str, Scalar]) -> str:
        """Carry out a command."""
        command = self._settings.commands[name]
        changes = {**arguments, **command.makes}
        self._values.update({key: value for key, value in changes.items() if key in self._values})
        return self._exchanged(command.text(arguments), command.simulated_reply)

    def emergency(self, messages: Sequence[SerialMessage]) -> Emergency | None:
        """None, as there is no port that another process could open."""
        del messages

    def close(self) -> None:
        """Nothing to close."""

    def _exchanged(self, text: str, reply: str | None) -> str:
        """The reply, after the time that the texts take."""
        settings = self._settings
        n_bytes = len(text + settings.write_ends_with) * (2 if settings.echo else 1)
        if reply is not None:
            n_bytes += len(reply + settings.read_ends_with)
        bits = 1 + settings.data_bits + (settings.parity != "none") + settings.stop_bits
        self._clock.sleep(max(0.0, self._free_s - self._clock.now()) + n_bytes * bits / settings.baud_rate)
        self._free_s = self._clock.now() + settings.pause
        return reply or ""
