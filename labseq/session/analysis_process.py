"""The process of one analysis: ``python -m labseq.session.analysis_process RUN_DIR NAME FINISH_WITHIN``.

It reads the run's index, which lists a shot as soon as it is complete on disk: the index is the queue. So
the run never waits for an analysis, an analysis that falls behind takes no memory, and one that is
restarted continues where it was. The end of standard input signals the end of the run.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import Final

from labseq.errors import LabseqError
from labseq.messages import format_error
from labseq.recording import Shot, open_run
from labseq.recording.reader import Follower
from labseq.session.analyses import analyse, analyses_of, prepare, results_of
from labseq.session.observers import FAILED, USE

LOOK_S: Final = 0.1
"""Interval between two readings of the index, in seconds."""


class _End:
    """Detects the end of the run, and the end of the time allowed after it."""

    def __init__(self, finish_within_s: float) -> None:
        self._within_s = finish_within_s
        self._deadline_s = float("inf")
        self._came = threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def came(self) -> bool:
        """Whether the run is over."""
        return self._came.is_set()

    @property
    def time_is_up(self) -> bool:
        """Whether the time after the run is used up: no further shot is analysed."""
        return time.monotonic() > self._deadline_s

    def wait(self) -> None:
        """Wait a moment for new shots, or until the run is over."""
        self._came.wait(LOOK_S)

    def _listen(self) -> None:
        with suppress(OSError):
            sys.stdin.buffer.read()
        self._deadline_s = time.monotonic() + self._within_s
        self._came.set()


def main(run_dir: Path, name: str, finish_within_s: float) -> None:
    """Analyse the shots of a run as they come, until it is over."""
    end = _End(finish_within_s)
    if hasattr(os, "nice"):
        os.nice(10)  # the run comes first
    run = open_run(run_dir)
    prepared = prepare(run, next(one for one in analyses_of(run) if one[USE] == name))
    with results_of(run_dir, prepared) as (log, before):
        analyse(prepared, _as_they_come(run_dir, before, end), log, _report)


def _as_they_come(run_dir: Path, before: set[int], end: _End) -> Generator[Shot]:
    """Yield the shots without a result as they are recorded, until the run is over."""
    follower = Follower(run_dir)
    while True:
        over = end.came  # before the index is read, so that it contains every shot written before the end
        for shot in follower.new():
            if end.time_is_up:
                return
            if shot.index not in before:
                yield shot
        if over:
            return
        end.wait()


def _report(shot: int, error: BaseException) -> None:
    traceback.print_exception(error)
    print(f"{FAILED}shot {shot}: {format_error(error)}", file=sys.stderr, flush=True)  # noqa: T201 - its log


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
    except LabseqError as failure:
        sys.exit(f"{FAILED}{failure}")
