"""Follows a run in progress by its files, for the live view of another process, a page or an analysis."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labseq.data.shot import Shot, caching_loader
from labseq.files import NewLines
from labseq.model.records import RunStatus
from labseq.recording.folders import EVENTS_FILE, INDEX_FILE
from labseq.recording.index import IndexRow, row_of_line
from labseq.recording.run_file import read_state


@dataclass(frozen=True, slots=True)
class Event:
    """A line of a run's event log.

    Attributes:
        t_utc: Wall time, ISO 8601, UTC.
        t_s: Time that the run has taken so far, in seconds, independent of the computer's clock: all parts
            of a resumed run together, without the time between them.
        name: What happened; one of :data:`labseq.roles.EVENTS`.
        values: The details.
    """

    t_utc: str
    t_s: float
    name: str
    values: Mapping[str, Any]


class Follower:
    """Reads what a run has added to its index and its event log since the last call.

    Args:
        run_dir: The run's folder.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._index = NewLines(run_dir / INDEX_FILE)
        self._log = NewLines(run_dir / EVENTS_FILE)
        self._load = caching_loader()
        self._time_s = self._last_s = 0.0

    @property
    def is_over(self) -> bool:
        """Whether the run or its process has ended."""
        return self.state()[0] != "running"

    def state(self) -> tuple[RunStatus, str]:
        """Status of the run, and the error that ended it."""
        return read_state(self._run_dir)

    def is_replaced(self) -> bool:
        """Whether the index was replaced, as `labseq doctor` does: a new follower is needed."""
        return self._index.is_replaced()

    def lines(self) -> Generator[tuple[int, IndexRow | None]]:
        """The new lines of the index: where each begins in the file, and its row; None if it is damaged.

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

    def events(self) -> Generator[Event]:
        """The new lines of the event log, without damaged ones.

        Raises:
            RecordingError: The log cannot be read.
        """
        for line in self._log.read():
            self._advance(line.get("t_s"))
            name, values = line.get("event"), line.get("values")
            if isinstance(name, str) and isinstance(values, dict):
                yield Event(str(line.get("t_utc", "")), self._time_s, name, values)

    def _advance(self, t_s: Any) -> None:
        """Advance to the time of a line; each part of a resumed run begins at 0."""
        if type(t_s) in (int, float) and 0 <= t_s < 1e12:  # a damaged line must not move the time
            self._time_s += t_s - self._last_s if t_s >= self._last_s else t_s
            self._last_s = t_s
