"""The session's time, and the request to stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final

from labseq.errors import StopRequested

LOOK_S: Final = 0.05
"""How often everything that waits looks for a stop request; Windows wakes no waiting thread for Ctrl-C."""


class StopFlag:
    """Set by a signal, looked at by every wait.

    While it is held (the devices are being made safe) waits no longer raise, so
    that a driver can ramp down in peace.
    """

    def __init__(self) -> None:
        self._event = threading.Event()
        self._n_holds = 0
        self.signal_number = 2

    def request(self, signal_number: int = 2) -> None:
        """Ask the run to stop; safe to call from a signal handler."""
        if not self._event.is_set():
            self.signal_number = signal_number
        self._event.set()

    @contextmanager
    def held(self) -> Generator[None]:
        """Within the block let waits finish."""
        self._n_holds += 1
        try:
            yield
        finally:
            self._n_holds -= 1

    @property
    def is_set(self) -> bool:
        """Whether the run was asked to stop, even if held."""
        return self._event.is_set()

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        if self._event.is_set() and not self._n_holds:
            raise StopRequested(self.signal_number)

    def wait(self, duration_s: float) -> None:
        """Wait in real time, or raise ``StopRequested`` as soon as it is asked for."""
        deadline_s = time.monotonic() + duration_s
        self.check()
        while (left_s := deadline_s - time.monotonic()) > 0:
            if self._n_holds:
                time.sleep(min(left_s, LOOK_S))
            elif self._event.wait(min(left_s, LOOK_S)):
                self.check()


class RealClock:
    """Real time."""

    virtual = False

    def __init__(self, stop: StopFlag) -> None:
        self._stop = stop

    def now(self) -> float:
        """Monotonic time in seconds."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Wait; raises ``StopRequested`` at once when the run is asked to stop."""
        self._stop.wait(duration_s)

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        self._stop.check()


class VirtualClock:
    """Time that passes only when somebody waits, and then at no cost."""

    virtual = True

    def __init__(self, stop: StopFlag) -> None:
        self._stop = stop
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds since the session began."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let time pass; raises ``StopRequested`` if the run was asked to stop."""
        self._stop.check()
        self._now_s += max(0.0, duration_s)

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        self._stop.check()


class PacedClock(VirtualClock):
    """Virtual time that takes as long as it says: a dry run to be watched."""

    def sleep(self, duration_s: float) -> None:
        """Wait really, then let the same time pass."""
        self._stop.wait(duration_s)
        super().sleep(duration_s)
