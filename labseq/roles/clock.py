"""The session's time."""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """The session's time: real, or virtual where no device needs real time."""

    @property
    def virtual(self) -> bool:
        """Whether waiting costs no real time."""
        ...

    def now(self) -> float:
        """Monotonic time in seconds; its zero is arbitrary."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait. Looks for a stop request at least every 50 ms.

        Raises:
            StopRequested: The operator asked the run to stop.
        """
        ...

    def check(self) -> None:
        """Raise ``StopRequested`` if the operator asked the run to stop; else return at once."""
        ...


class NeverStopped:
    """A real clock that nobody stops; for plugins used outside of a run."""

    virtual = False

    def now(self) -> float:
        """Monotonic time in seconds."""
        import time

        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        import threading

        threading.Event().wait(max(0.0, duration_s))

    def check(self) -> None:
        """Nothing to look for."""
