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
from labseq.data.follower import Follower
from labseq.data.reader import open_run
from labseq.files import data_root
from labseq.recording.listing import newest_run


def watch_run(
    path: Path | None,
    stream: TextIO | None = None,
    wait: Callable[[float], None] = time.sleep,
    *,
    follow: bool = False,
) -> None:
    """Show a run until it ends, then print its summary. Only its files are read.

    Args:
        follow: Whether to then wait for the next run in the data folder and show that, until Ctrl-C.
    """
    # resolved, to be compared with other runs: the data folder may be relative, or a link
    run_dir, shown = folder_of_run(path).resolve(), stream or sys.stdout
    try:
        _watch_one(run_dir, shown, wait)
        while follow:
            while (newest := newest_run(data_root()).resolve()) == run_dir:
                wait(0.5)
            _watch_one(run_dir := newest, shown, wait)
    except KeyboardInterrupt:
        state = "is over" if Follower(run_dir).is_over else "continues"
        say(f"stopped watching the run {run_dir}, which {state}", stream=shown)


def _watch_one(run_dir: Path, shown: TextIO, wait: Callable[[float], None]) -> None:
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
    finally:
        view.close()
    say(*Summary.of(open_run(run_dir)).as_text(), stream=shown)
