"""``labseq watch``: the live view of a run in another process."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, TextIO

from labseq.cli.following import Follower
from labseq.cli.live import ClosableObserver, observer_for
from labseq.cli.output import say
from labseq.cli.show import chosen_run, summary_lines
from labseq.recording import open_run

POLL_S: Final = 0.5
"""How often the run's files are looked at."""


def watch_run(
    path: Path | None, stream: TextIO | None = None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Show a run until it ends, then its summary; only its files are read.

    Args:
        path: The run's folder or any file in it; None for the newest run.
        stream: Where it is shown; stdout by default.
        wait: Waits for so many seconds.

    Raises:
        ConfigError: There is no such run.
        RecordingError: It is damaged.
    """
    run = chosen_run(path)
    follower = Follower(run)
    shown = stream or sys.stdout
    view = observer_for(shown, follower.now)
    try:
        follow(follower, view, wait)
    except KeyboardInterrupt:
        view.close()
        say(f"no longer watched; {run.path} goes on", stream=shown)
    else:
        view.close()
        say(*summary_lines(open_run(run.path)), stream=shown)
    finally:
        view.close()


def follow(follower: Follower, view: ClosableObserver, wait: Callable[[float], None]) -> None:
    """Tell a view what comes, until the run is over.

    Args:
        follower: Reads the run.
        view: Is told its events.
        wait: Waits for so many seconds.

    Raises:
        RecordingError: The run cannot be read any more.
    """
    while True:
        over = follower.is_over()  # before the last events are read
        for name, values in follower.read():
            with suppress(KeyError, TypeError, ValueError):  # an event of another version of labseq
                view.event(name, values)
        view.refresh()
        if over:
            return
        wait(POLL_S)
