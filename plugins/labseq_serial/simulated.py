"""An instrument simulated from its description: a dry run tests the description."""

from __future__ import annotations

import threading
from typing import Final

from labseq.plugin import Clock
from labseq_serial.settings import CommandSettings, SerialSettings
from labseq_serial.values import Scalar

_IDLE_S: Final = 0.005


class SimulatedPort:
    """A port that recognises the commands that the driver sends, keeps their arguments, and replies.

    A value that has the name of an argument is that argument's last value; a value that a command ``makes``
    is as the command made it; any other value is plausible. Bytes take the time that they take on a line.
    """

    def __init__(self, settings: SerialSettings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self._come = bytearray()
        self._going = bytearray()
        self._values: dict[str, Scalar] = {name: value.typical for name, value in settings.values.items()}
        bits = 1 + settings.data_bits + (settings.parity != "none") + settings.stop_bits
        self._byte_s = bits / settings.baud_rate

    @property
    def in_waiting(self) -> int:
        """Bytes of replies that were not read."""
        return len(self._going)

    def read(self, size: int = 1, /) -> bytes:
        """At most ``size`` bytes of the replies."""
        if not self._going:
            threading.Event().wait(_IDLE_S)
        data = bytes(self._going[:size])
        del self._going[:size]
        return data

    def write(self, data: bytes, /) -> int:
        """Carry out the commands that are complete."""
        settings = self._settings
        end = settings.write_ends_with.encode(settings.encoding)
        self._come += data
        self._clock.sleep(len(data) * self._byte_s)
        while (at := self._come.find(end)) >= 0:
            line = bytes(self._come[:at])
            del self._come[: at + len(end)]
            reply = self._reply(line.decode(settings.encoding, "replace"))
            text = "" if reply is None else reply + settings.read_ends_with
            answer = (line + end if settings.echo else b"") + text.encode(settings.encoding, "replace")
            self._clock.sleep(len(answer) * self._byte_s)
            self._going += answer
        return len(data)

    def reset_input_buffer(self) -> None:
        """Drop the replies."""
        self._going.clear()

    def close(self) -> None:
        """Nothing to close."""

    def _reply(self, text: str) -> str | None:
        settings = self._settings
        if settings.identify is not None and text == settings.identify.ask:
            return settings.identify.simulated_reply()
        for name, value in settings.values.items():
            if text == value.ask:
                return value.reply_with(self._values[name])
        fits = [
            (command, values)
            for command in settings.commands.values()
            if (values := command.values_in(text)) is not None
        ]
        # Two commands may send the same text, a toggle: take the one that changes something.
        for command, values in sorted(fits, key=lambda fit: self._is_made(fit[0])):
            self._values.update({**values, **command.makes})
            return command.simulated_reply()
        return None

    def _is_made(self, command: CommandSettings) -> bool:
        return all(self._values[name] == made for name, made in command.makes.items()) and bool(command.makes)
