"""`labseq watch`: the live view of a run in another process, read from the run's files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from labseq.cli.live import observer_for
from labseq.cli.summary import Summary
from labseq.console.output import say
from labseq.console.runs import folder_of_run
from labseq.data import open_run
from labseq.data.follower import Follower


def watch_run(
    path: Path | None, stream: TextIO | None = None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Show a run until it ends, then print its summary; only its files are read."""
    run_dir, shown = folder_of_run(path), stream or sys.stdout
    follower = Follower(run_dir)
    view = observer_for(shown, follower.now)
    try:
        is_over = False
        while not is_over:
            is_over = follower.is_over  # asked first, so that the last events are read
            for event in follower.events():
                with suppress(KeyError, TypeError, ValueError):  # an event of another version of labseq
                    view.event(event.name, event.values)
            view.refresh()
            if not is_over:
                wait(0.5)
    except KeyboardInterrupt:
        lines = [f"no longer watched; the run {run_dir} continues"]
    else:
        lines = Summary.of(open_run(run_dir)).as_text()
    finally:
        view.close()
    say(*lines, stream=shown)
