"""Waiting for a device that runs in real time, with a deadline and an eye on stop requests."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, TypeVar

from labseq.roles import Clock

T = TypeVar("T")

SLICE_S: Final = 0.02
"""Longest single wait, in seconds, after which a stop request is noticed."""


def wait_for(poll: Callable[[float], T | None], timeout_s: float, clock: Clock) -> T | None:
    """Wait until something comes from a device that runs in real time.

    If nothing comes, a virtual clock also advances by the whole wait.

    Args:
        poll: Waits for at most the given seconds. None if nothing came.
        timeout_s: Longest total wait, in seconds. 0 looks once.
        clock: The session's clock, which is checked for a stop request before each look.

    Returns:
        The result of ``poll``. None if nothing came.

    Raises:
        StopRequested: The operator asked the run to stop.
    """
    deadline_s = time.monotonic() + timeout_s
    while True:
        clock.check()
        left_s = max(0.0, deadline_s - time.monotonic())
        received = poll(min(left_s, SLICE_S))
        if received is not None:
            return received
        if left_s == 0.0:
            break
    if clock.virtual:
        clock.sleep(timeout_s)
    return None
