"""Ctrl-C, SIGTERM and a lost terminal as a request to stop, never as an exception in the wrong place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final

from labseq.guard import StopFlag

_SIGHUP: Final = getattr(signal, "SIGHUP", None)
_EXIT_SIGNALS: Final = {  # signal -> what the run says it was stopped by
    getattr(signal, name): meaning
    for name, meaning in {
        "SIGINT": signal.SIGINT,
        "SIGTERM": signal.SIGTERM,
        "SIGHUP": signal.SIGTERM,  # the terminal or the ssh connection is gone
        "SIGBREAK": signal.SIGINT,  # Ctrl-Break on Windows
    }.items()
    if hasattr(signal, name)
}


@contextmanager
def stop_on_signals(stop: StopFlag) -> Generator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP set a flag while the block runs.

    Where a lost terminal is to be ignored (``nohup``) it stays so. Python lets only
    the main thread handle signals; in any other this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _frame: object) -> None:
        stop.request(_EXIT_SIGNALS[number])

    before = {number: signal.getsignal(number) for number in _EXIT_SIGNALS}
    if before.get(_SIGHUP) is signal.SIG_IGN:
        del before[_SIGHUP]
    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
