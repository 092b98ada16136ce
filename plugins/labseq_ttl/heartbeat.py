"""Signs of life, for a box that turns all lines off without them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from labseq.plugin import DeviceError

PER_TIMEOUT: Final = 4
"""How often within its timeout the box hears something."""


class Heartbeat(threading.Thread):
    """Says something to the box again and again, until it is stopped.

    Args:
        beat: Says it; may fail: the driver finds out why by itself.
        timeout_s: After so long without it the box turns all lines off.
    """

    def __init__(self, beat: Callable[[], object], timeout_s: float) -> None:
        super().__init__(name="labseq ttl heartbeat", daemon=True)
        self._beat = beat
        self._period_s = timeout_s / PER_TIMEOUT
        self._is_over = threading.Event()

    def run(self) -> None:
        """Until it is stopped."""
        while not self._is_over.wait(self._period_s):
            with suppress(DeviceError):
                self._beat()

    def stop(self) -> None:
        """End it; returns when it has ended."""
        self._is_over.set()
        self.join()
