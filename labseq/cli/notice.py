"""Says that something takes long, but only once it does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, Protocol

PATIENCE_S: Final = 2.0
"""What is over sooner is not worth a word: loading the kernels takes about 1 s, compiling them many."""


FIRST_RUN: Final = "(the first run after an installation compiles the kernels)"
"""Why the preparations of a run may take long."""


class Timer(Protocol):
    """What a notice needs of ``threading.Timer``."""

    def start(self) -> None:
        """Start to wait."""
        ...

    def cancel(self) -> None:
        """Stop to wait."""
        ...


MakeTimer = Callable[[float, Callable[[], None]], Timer]


class Notice:
    """Announces a task that takes longer than ``PATIENCE_S``, and says when it is over.

    Args:
        say: Prints a line; called from a thread of its own.
        now: Monotonic time in seconds.
        make_timer: Makes a timer, given the time to wait and what to call then.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        now: Callable[[], float] = time.monotonic,
        make_timer: MakeTimer | None = None,
    ) -> None:
        self._say = say
        self._now = now
        self._make_timer = make_timer or _daemon_timer
        self._timer: Timer | None = None
        self._task = ""
        self._start_s = 0.0
        self._announced = False

    def begin(self, task: str, remark: str = "") -> None:
        """A task begins; the one before it is over."""
        self.end()
        self._task, self._start_s, self._announced = task, self._now(), False

        def announce() -> None:
            self._announced = True
            self._say(f"{task} ... {remark}".rstrip())

        self._timer = self._make_timer(PATIENCE_S, announce)
        self._timer.start()

    def end(self) -> None:
        """The task is over; legal without one."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._timer = None
        if self._announced:
            self._say(f"{self._task} took {self._now() - self._start_s:.1f} s")


def _daemon_timer(delay_s: float, call: Callable[[], None]) -> Timer:
    timer = threading.Timer(delay_s, call)
    timer.daemon = True
    return timer
