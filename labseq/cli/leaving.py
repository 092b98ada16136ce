"""The end of the process, whatever plugins have left running."""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import suppress
from typing import Any, Final, NoReturn

from labseq.cli.output import discard_unwritten, say
from labseq.errors import RecordingError

MAX_WAIT_S: Final = 1.0
"""How long threads may take to end by themselves."""


def end_process(code: Any) -> NoReturn:
    """Leave with an exit code, also where a thread is left that Python would wait for.

    All data is on disk by now, and every device is safe: nothing is lost with such a thread.

    Args:
        code: As for ``sys.exit``.
    """
    with suppress(KeyboardInterrupt):  # Ctrl-C: no more patience
        _wait()
    names = sorted(thread.name for thread in _left_over())
    if not names:
        sys.exit(code)
    with suppress(RecordingError):
        threads = "a thread" if len(names) == 1 else f"{len(names)} threads"
        text = f"warning: {threads} of a plugin would not end: {', '.join(names)}; ended with the process"
        say(text, stream=sys.stderr)
    discard_unwritten()
    os._exit(code if isinstance(code, int) else int(code is not None))


def _wait() -> None:
    deadline = time.monotonic() + MAX_WAIT_S
    for thread in _left_over():
        thread.join(max(0.0, deadline - time.monotonic()))


def _left_over() -> list[threading.Thread]:
    """Threads that keep the process from ending."""
    here = threading.current_thread()
    return [t for t in threading.enumerate() if t is not here and not t.daemon]
