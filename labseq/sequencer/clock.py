"""The session's time, which is real, virtual, or virtual at the speed of real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from labseq.guard import StopFlag

SLEPT: Final = "computer.slept_s"
"""Reading with the time for which the computer was suspended since the previous shot."""
CLOCK_SET: Final = "computer.clock_set_s"
"""Reading with the amount by which the computer's clock was set since the previous shot. It includes the time
asleep on systems that do not report it."""


class RealClock:
    """Real time."""

    virtual = False

    def __init__(self, stop: StopFlag) -> None:
        self._stop = stop

    def now(self) -> float:
        """Monotonic time in seconds."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Wait. Raises ``StopRequested`` at once when the run is asked to stop."""
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
        """Advance virtual time. Raises ``StopRequested`` if the run was asked to stop."""
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


def _boot_s() -> float:
    """A clock that runs while the computer sleeps. Only on Linux is it another clock than ``monotonic``."""
    number = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if number is None else time.clock_gettime(number)


class ClockJumps:
    """Notices that the computer slept or that its clock was set.

    Args:
        wall_s: The computer's clock, which a user or a network may set.
        monotonic_s: A clock that cannot be set, and that stops while the computer sleeps.
        boot_s: A clock that cannot be set, and that runs while the computer sleeps.
    """

    def __init__(
        self,
        wall_s: Callable[[], float] = time.time,
        monotonic_s: Callable[[], float] = time.monotonic,
        boot_s: Callable[[], float] = _boot_s,
    ) -> None:
        self._clocks = wall_s, monotonic_s, boot_s
        self._ahead_s = self._now()

    def since_last(self) -> dict[str, float]:
        """Jumps since the last call, as readings of a shot. Less than 1 s is drift of the clock."""
        before, self._ahead_s = self._ahead_s, self._now()
        slept_s, jumped_s = (now - then for now, then in zip(self._ahead_s, before, strict=True))
        jumps = {SLEPT: slept_s, CLOCK_SET: jumped_s - slept_s}
        return {name: round(jump_s, 3) for name, jump_s in jumps.items() if abs(jump_s) >= 1.0}

    def _now(self) -> tuple[float, float]:
        """Lead of the clock that runs in sleep, and of the wall clock, over the clock that stops in sleep."""
        wall_s, monotonic_s, boot_s = (clock() for clock in self._clocks)
        return boot_s - monotonic_s, wall_s - monotonic_s
