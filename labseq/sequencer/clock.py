"""The session's time: real, virtual, or virtual at the speed of real time."""

from __future__ import annotations

import time

from labseq.guard import StopFlag


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
    """Time that passes only in waits, which take no real time."""

    virtual = True

    def __init__(self, stop: StopFlag) -> None:
        self._stop = stop
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds since the session began."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Advance virtual time; raises ``StopRequested`` if the run was asked to stop."""
        self._stop.check()
        self._now_s += max(0.0, duration_s)

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        self._stop.check()


class PacedClock(VirtualClock):
    """Virtual time at the speed of real time, for dry runs that a user watches."""

    def sleep(self, duration_s: float) -> None:
        """Wait in real time, then advance virtual time by the same amount."""
        self._stop.wait(duration_s)
        super().sleep(duration_s)
