"""Follows a run in progress by reading its files, for the live view, the web page or an analysis."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from labseq.data.shot import CachingLoader, Shot
from labseq.errors import RecordingError
from labseq.files import NewLines
from labseq.recording.folders import EVENTS_FILE, INDEX_FILE
from labseq.recording.index import IndexRow, row_of_line
from labseq.recording.run_file import read_record, read_state


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in a run.

    Attributes:
        t_utc: Wall time, ISO 8601, UTC.
        t_s: Time that the run has taken so far, in seconds, independent of the computer's clock. Sums all
            parts of a resumed run, without the time between them.
        name: What happened, one of :data:`labseq.roles.EVENTS`.
        values: The details of the event.
    """

    t_utc: str
    t_s: float
    name: str
    values: Mapping[str, Any]


class Follower:
    """Reads what a run has added to its index and its event log since the last call.

    Args:
        clock: Clock of this computer in seconds.
    """

    def __init__(self, run_dir: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._run_dir = run_dir
        self._clock = clock
        self._index = NewLines(run_dir / INDEX_FILE)
        self._log = NewLines(run_dir / EVENTS_FILE)
        self._load = CachingLoader()
        self._taken = defaultdict[tuple[int, int, str], list[Shot]](list)
        self._logged_s = self._line_s = 0.0
        self._event_s, self._told_s = 0.0, clock()

    @property
    def is_over(self) -> bool:
        """Whether the run or its process has ended."""
        return read_state(self._run_dir)[0] != "running"

    def now(self) -> float:
        """Time of the run in seconds. It continues from the time of the last of :meth:`events`."""
        return self._event_s + self._clock() - self._told_s

    def is_replaced(self) -> bool:
        """Whether the index was replaced, as `labseq doctor` does. If so, a new follower is needed."""
        return self._index.is_replaced()

    def lines(self) -> Generator[tuple[int, IndexRow | None]]:
        """The new lines of the index: start of each in the file, and its row. None if it is damaged.

        Raises:
            RecordingError: The index cannot be read.
        """
        for start, values in self._index.placed():
            yield start, None if values is None else row_of_line(values)

    def shots(self) -> list[Shot]:
        """The new attempts at shots, in the order in which they were written.

        Raises:
            RecordingError: The index cannot be read.
        """
        return [self.shot(row) for _, row in self.lines() if row is not None]

    def shot(self, row: IndexRow) -> Shot:
        """The shot of a row of the index."""
        return Shot(self._run_dir, row, self._load)

    def log(self) -> Generator[Event]:
        """The new lines of the event log. Damaged lines are left out.

        Raises:
            RecordingError: The log cannot be read.
        """
        for line in self._log.read():
            t_s: Any = line.get("t_s")
            if type(t_s) in (int, float) and 0 <= t_s < 1e12:  # a damaged line must not move the time
                # each part of a resumed run begins at 0
                self._logged_s += t_s - self._line_s if t_s >= self._line_s else t_s
                self._line_s = t_s
            name, values = line.get("event"), line.get("values")
            if isinstance(name, str) and isinstance(values, dict):
                yield Event(str(line.get("t_utc", "")), self._logged_s, name, values)

    def events(self) -> Generator[Event]:
        """The events that the run's own observer has received since the last call.

        Events and values that the log leaves out (``UNLOGGED_EVENTS`` and ``UNLOGGED_VALUES`` in
        ``recording/folders.py``) are read from the run's other files.

        Raises:
            RecordingError: The run can no longer be read.
        """
        logged = list(self.log())
        # after the log, because a shot is in the index before its event is in the log
        for shot in self.shots():
            self._taken[shot.index, shot.attempt, shot.status].append(shot)
        shots = [self._shot_ended_by(event) for event in logged]
        # reading a shot's file takes 10 ms, so for a run that is joined late only the last ones are opened
        to_open = {id(shot) for shot in list(filter(None, shots))[-20:]}
        for event, shot in zip(logged, shots, strict=True):
            self._event_s, self._told_s = event.t_s, self._clock()
            values = dict(event.values)
            if event.name == "run_starting":
                values["record"] = read_record(self._run_dir)
            if shot is not None:
                values["row"] = shot.row
                if id(shot) in to_open:
                    yield from _inside(shot, event)
            yield replace(event, values=values)

    def _shot_ended_by(self, event: Event) -> Shot | None:
        """The attempt that an event ends. None for other events and damaged lines."""
        if event.name not in ("shot_finished", "shot_repeated"):
            return None
        try:
            shot = event.values["shot"]
            # an interrupted attempt is repeated under the same number when the run is resumed
            return self._taken[shot["shot_index"], shot["attempt"], shot["status"]].pop(0)
        except (KeyError, TypeError, IndexError):
            return None


def _inside(shot: Shot, end: Event) -> Iterator[Event]:
    """Events for the stages and the last image of a shot, at its end. None if its file cannot be read."""
    with suppress(RecordingError):
        for timing in shot.timing:
            yield replace(end, name="stage", values={"timing": timing})
        for image in shot.images[-1:]:
            # the log has this event already, but here it says whose image follows
            yield replace(end, name="shot_started", values={"shot": shot.index, "attempt": shot.attempt})
            values = {"image": image, "filling_fraction": shot.filling_fraction}
            yield replace(end, name="image", values=values)
