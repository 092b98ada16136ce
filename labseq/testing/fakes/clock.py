"""A clock for tests."""

from __future__ import annotations

from labseq.sequencer.clock import StopFlag, VirtualClock


class FakeClock(VirtualClock):
    """Virtual time that notes every wait.

    Attributes:
        stop: The request to stop that its waits look for.
        sleeps: Every wait in seconds, in order.

    Example:
        >>> clock = FakeClock()
        >>> clock.sleep(0.5)
        >>> clock.now(), clock.sleeps
        (0.5, [0.5])
    """

    def __init__(self, stop: StopFlag | None = None) -> None:
        self.stop = stop or StopFlag()
        self.sleeps: list[float] = []
        super().__init__(self.stop)

    def sleep(self, duration_s: float) -> None:
        """Let time pass and note it."""
        super().sleep(duration_s)
        self.sleeps.append(duration_s)
