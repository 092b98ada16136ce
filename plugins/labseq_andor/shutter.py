"""The camera's shutter."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import Clock
from labseq_andor.codes import Features
from labseq_andor.sdk import Sdk
from labseq_andor.settings import AndorSettings

AUTO, OPEN, CLOSED = 0, 1, 2
LEVELS: Final = {"low": 0, "high": 1}


class Shutter:
    """Opens and closes the shutter, and waits until it is open.

    Args:
        sdk: The camera.
        settings: How the shutter is used.
        clock: The session's clock.

    Attributes:
        state: "open", "closed", "auto", or "none" for a camera that controls none.
    """

    def __init__(self, sdk: Sdk, settings: AndorSettings, clock: Clock) -> None:
        self._sdk = sdk
        self._clock = clock
        self._level = LEVELS[settings.shutter_opens_at]
        self._is_auto = settings.shutter == "auto"
        self._open_at_s = 0.0
        self.state = "none"
        self._times_ms = (0, 0)
        if sdk.capabilities.ulFeatures & Features.SHUTTER:
            with sdk.selected() as lib:
                closing_ms, opening_ms = lib.GetShutterMinTimes()
            self._times_ms = int(closing_ms), int(opening_ms)
            self.state = "closed"

    def open(self) -> None:
        """Begin to open it; no effect if it is open."""
        if self.state == "closed":
            with self._sdk.selected() as lib:
                lib.SetShutter(self._level, AUTO if self._is_auto else OPEN, *self._times_ms)
            self.state = "auto" if self._is_auto else "open"
            self._open_at_s = self._clock.now() + (0.0 if self._is_auto else self._times_ms[1] / 1e3)

    def wait(self) -> None:
        """Wait until it is open."""
        self._clock.sleep(max(0.0, self._open_at_s - self._clock.now()))

    def close(self, lib: Any) -> None:
        """Close it; for :meth:`labseq_andor.sdk.Sdk.attempt`."""
        if self.state != "none":
            lib.SetShutter(self._level, CLOSED, *self._times_ms)
            self.state = "closed"
