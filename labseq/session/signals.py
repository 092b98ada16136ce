"""Ctrl-C, SIGTERM and a lost terminal as a request to stop, never as an exception in the wrong place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final

from labseq.sequencer import StopFlag

_EXIT_SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name)
)


@contextmanager
def stop_on_signals(stop: StopFlag) -> Generator[None]:
    """Let Ctrl-C and SIGTERM set a flag while the block runs.

    Python lets only the main thread handle signals; in any other this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _frame: object) -> None:
        stop.request(signal.SIGTERM if number == signal.SIGTERM else signal.SIGINT)

    before = {number: signal.getsignal(number) for number in _EXIT_SIGNALS}
    for number in _EXIT_SIGNALS:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
