"""`labseq watch`: the live view of a run in another process, read from the run's files."""

from __future__ import annotations

import math
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from labseq.cli.live import observer_for
from labseq.cli.summary import Summary
from labseq.console.output import say
from labseq.console.runs import chosen_run
from labseq.data import Shot, open_run
from labseq.data.follower import Event, Follower
from labseq.errors import RecordingError
from labseq.recording.index import IndexRow
from labseq.recording.run_file import read_record


def watch_run(
    path: Path | None, stream: TextIO | None = None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Show a run until it ends, then print its summary; only its files are read."""
    run_dir, shown = chosen_run(path).path, stream or sys.stdout
    run = WatchedRun(run_dir)
    view = observer_for(shown, run.now)
    try:
        is_over = False
        while not is_over:
            is_over = run.follower.is_over  # asked first, so that the last events are read
            for name, values in run.events():
                with suppress(KeyError, TypeError, ValueError):  # an event of another version of labseq
                    view.event(name, values)
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


class WatchedRun:
    """The events of a run in another process, with the stages and last images of its shots from their files.

    Args:
        run_dir: The run's folder.
        clock: Clock of this computer in seconds.

    Attributes:
        follower: Reads the run's files.
    """

    def __init__(self, run_dir: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.follower = Follower(run_dir)
        self._record = read_record(run_dir)
        self._clock = clock
        self._rows = defaultdict[tuple[int, int, str], list[IndexRow]](list)
        self._time_s, self._read_s = 0.0, math.nan

    def now(self) -> float:
        """Time of the run in seconds: that of the current event, or since the last was read."""
        waited_s = 0.0 if math.isnan(self._read_s) else self._clock() - self._read_s
        return self._time_s + waited_s

    def events(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """The events since the last call.

        Raises:
            RecordingError: The run can no longer be read.
        """
        events = list(self.follower.events())
        if not events:
            return
        self._read_s = math.nan
        # after the events: a shot is in the index before its event is in the log
        for shot in self.follower.shots():
            self._rows[shot.index, shot.attempt, shot.status].append(shot.row)
        rows = [self._row_ended_by(event) for event in events]
        # reading a shot's file takes 10 ms: of a run that is joined late, only the last ones are opened
        to_open = {id(row) for row in list(filter(None, rows))[-20:]}
        for event, row in zip(events, rows, strict=True):
            self._time_s = event.t_s
            values = {**event.values, "record": self._record}
            if row is not None:
                values["row"] = row
                yield from _stages_and_image(self.follower.shot(row)) if id(row) in to_open else ()
            yield event.name, values
        self._read_s = self._clock()

    def _row_ended_by(self, event: Event) -> IndexRow | None:
        """The row of the attempt that an event ends; None for other events and damaged lines."""
        if event.name not in ("shot_finished", "shot_repeated"):
            return None
        try:
            shot = event.values["shot"]
            # an attempt that was interrupted is made again, under the same number, when the run is resumed
            return self._rows[shot["shot_index"], shot["attempt"], shot["status"]].pop(0)
        except (KeyError, TypeError, IndexError):
            return None


def _stages_and_image(shot: Shot) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The stages of a shot and its last image; empty if its file cannot be read."""
    with suppress(RecordingError):
        for timing in shot.timing:
            yield "stage", {"timing": timing}
        for image in shot.images[-1:]:
            # the log has this event already; the view needs it just before the image of another shot
            yield "shot_started", {"shot": shot.index, "attempt": shot.attempt}
            yield "image", {"image": image, "filling_fraction": shot.filling_fraction}
