"""``labseq stop``: end a run after the shot at hand."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from labseq.cli.output import say
from labseq.cli.show import existing
from labseq.errors import ConfigError
from labseq.recording import data_root
from labseq.session.queue import Queue
from labseq.session.stopping import ask_to_stop, find_running, is_running, running_here, owner_text

LOOK_S: Final = 0.1
"""How often ``--wait`` looks."""


def stop_run(run: Path | None, profile: str | None, *, queue: bool, wait: bool) -> None:
    """Ask a run in progress to end after the shot at hand, and say what will happen.

    Args:
        run: Its folder; the only one in progress if left out.
        profile: Its profile, in place of its folder.
        queue: Whether the queue shall end as well.
        wait: Whether to wait for its end.

    Raises:
        ConfigError: No run is in progress, or several are; or the queue is not at work.
        RecordingError: Its folder cannot be written to.
    """
    if queue:
        if not Queue(data_root()).ask_to_stop():
            raise ConfigError("the queue is not at work; 'labseq stop' without --queue ends a run")
        say("the queue takes no further runs")
        if run is None and not running_here(profile):
            return
    folder = find_running(None if run is None else existing(run), profile)
    ask_to_stop(folder)
    say(f"{folder} ({owner_text(folder)}) ends after the shot at hand")
    say(f"go on later with: labseq resume {folder}")
    while wait and is_running(folder):
        time.sleep(LOOK_S)
    if wait:
        say("it has ended")
