"""A leader on a serial line."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Final

from labseq.plugin import BROKEN, DeviceError, Port, open_port
from labseq_follow.links import SEND_S, SLICE_S, Listener
from labseq_follow.settings import SerialLeaderSettings

AGAIN_S: Final = 0.5
"""Time between two attempts to open a port that was unplugged."""


class SerialLink:
    """A port that is opened alone, and opened again if it was unplugged.

    Args:
        settings: The port.
        device: Name of the device, for messages.
    """

    def __init__(self, settings: SerialLeaderSettings, device: str) -> None:
        self._settings = settings
        self._device = device
        self._port: Port | None = None
        self._is_known = False
        self._again_s = 0.0
        self._sending = threading.Lock()

    @property
    def address(self) -> str:
        """The port."""
        return self._settings.port

    def open(self) -> None:
        """Open the port.

        Raises:
            DeviceError: There is no such port, or somebody else has it open.
        """
        self._port = self._opened()

    def serve(self, listener: Listener) -> None:
        """Hear what the leader says; open a port that was unplugged."""
        if self._port is None:
            self._reopen()
            return
        if not self._is_known:
            self._is_known = True
            listener.connected(f"whoever is on {self.address}")
        try:
            data = self._port.read(max(1, self._port.in_waiting))
        except (*BROKEN, TypeError) as error:  # pyserial reads from a port that was closed as from None
            self._drop()
            listener.lost(f"{' '.join(str(error).split())}; unplugged?")
        else:
            if data:
                listener.came(data)

    def send(self, line: bytes) -> None:
        """Send a line."""
        with self._sending:
            if self._port is None:
                raise ConnectionError(f"{self.address} is not open")
            try:
                self._port.write(line)
            except BROKEN as error:
                raise ConnectionError(str(error)) from error

    def close(self) -> None:
        """Close the port."""
        self._drop()

    def _opened(self) -> Port:
        return open_port(self.address, self._device, self._settings.baud_rate, write_timeout=SEND_S)

    def _reopen(self) -> None:
        threading.Event().wait(SLICE_S)
        if time.monotonic() >= self._again_s:
            self._again_s = time.monotonic() + AGAIN_S
            with suppress(DeviceError):
                self._port = self._opened()

    def _drop(self) -> None:
        with self._sending:
            port, self._port, self._is_known = self._port, None, False
        if port is not None:
            with suppress(*BROKEN):
                port.close()
