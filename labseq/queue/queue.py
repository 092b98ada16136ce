"""The queue of runs that wait, each in its own file."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Final, Literal

from pydantic import TypeAdapter, ValidationError

from labseq.assembly.options import Options
from labseq.config.document import StoredText
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import explained, make_folder, read_file, write_file
from labseq.messages import visible
from labseq.plain import dumps, now, now_utc, parse_object
from labseq.processes import Holder, Lock, Process
from labseq.recording.folders import STOP_FILE
from labseq.recording.run_file import read_state
from labseq.text_files import MAX_BYTES, decode, read_bytes

FOLDER: Final = "queue"
PAUSE_FILE: Final = "PAUSE"
"""Exists while the queue is paused."""
FORMAT: Final = 1
"""Version of an entry's file."""
DONE_FOLDER: Final = "done"
"""Holds the entries whose runs are complete, so that the list can show them the next morning."""
EntryStatus = Literal["waiting", "running", "stopped", "failed", "skipped", "complete"]
IfFails = Literal["stop", "skip", "retry"]

_NUMBER: Final = re.compile(r"(\d{4,})\.(?:json|id)")


@dataclass(frozen=True, slots=True)
class Rules:
    """What an entry requires of the process that runs the queue.

    Attributes:
        if_fails: What happens if its run fails. "stop" ends the queue and "skip" continues it. "retry"
            resumes or begins the run once more, then continues the queue.
        until_utc: No shot begins after this time, ISO 8601, UTC. "" for no limit.
        needs: Kind of calibration -> its maximum age in seconds when the run begins. An older calibration
            is taken again first.
    """

    if_fails: IfFails = "stop"
    until_utc: str = ""
    needs: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def is_too_late(self) -> bool:
        """Whether its time limit has passed."""
        return bool(self.until_utc) and now() >= datetime.fromisoformat(self.until_utc)


@dataclass(frozen=True, slots=True)
class Entry:
    """A queued run.

    Attributes:
        id: Its number, counted from 1. No later entry gets the same number.
        position: Entries are taken in order of their positions.
        added_utc: When it was added, ISO 8601, UTC.
        sequence: Absolute path of the sequence's file.
        text: The text of that file when it was added, which will run.
        options: The options that the user gave.
        status: "waiting", "running", or how its run ended early.
        run_dir: The folder of its run, once there is one.
        error: Why it did not start or ended early, or "".
        owner: The process that runs or ran it.
        rules: What it requires of the process that runs the queue.
        expected_s: How long its run takes, in seconds. None if unknown, as in virtual time.
        n_failures: Number of times that its run has failed.
        begun_utc: When its run began or was resumed, ISO 8601, UTC, or "".
        ended_utc: When its run ended, or "".
    """

    id: int
    position: Fraction
    added_utc: str
    sequence: Path
    text: str
    options: Options
    status: EntryStatus = "waiting"
    run_dir: Path | None = None
    error: str = ""
    owner: Process | None = None
    rules: Rules = Rules()
    expected_s: float | None = None
    n_failures: int = 0
    begun_utc: str = ""
    ended_utc: str = ""

    @property
    def stored_text(self) -> StoredText:
        """The text that is read instead of the file."""
        return StoredText(self.text, f"{self.sequence} (as queued)")

    @property
    def is_interrupted(self) -> bool:
        """Whether the process that ran it died before its end."""
        # a process on another computer counts as gone because it cannot be checked
        is_gone = self.owner is None or not (self.owner.is_here and self.owner.is_running)
        return self.status == "running" and is_gone

    @property
    def is_complete(self) -> bool:
        """Whether the run of the entry is complete, by the queue or by `labseq resume`."""
        return self.run_dir is not None and read_state(self.run_dir)[0] == "complete"

    @property
    def state(self) -> str:
        """State of the entry in one word: its status, "interrupted" or "complete"."""
        if self.is_complete:
            return "complete"
        return "interrupted" if self.is_interrupted else self.status

    @property
    def has_changed(self) -> bool:
        """Whether the sequence's file has changed since it was added, or is gone."""
        try:
            return decode(read_bytes(self.sequence), visible(str(self.sequence))) != self.text
        except ConfigError:
            return True


class Queue:
    """The queue of a data root."""

    def __init__(self, root: Path) -> None:
        self.folder = root.absolute() / FOLDER

    def lock(self) -> Lock:
        """The lock of the process that runs the queue."""
        return Lock(self.folder / ".lock", "labseq queue run")

    def entries(self) -> list[Entry]:
        """All entries, in the order in which they are taken.

        Raises:
            RecordingError: An entry is damaged, or cannot be read.
        """
        return sorted(_read_all(self.folder), key=lambda entry: (entry.position, entry.id))

    def add(
        self,
        sequence: Path,
        text: str,
        options: Options,
        rules: Rules = Rules(),
        expected_s: float | None = None,
    ) -> Entry:
        """Add a sequence at the end, with the text that will run.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        last = max((entry.position for entry in self.entries()), default=Fraction(0))
        entry = Entry(
            self._new_id(), last + 1, now_utc(), sequence, text, options, rules=rules, expected_s=expected_s
        )
        self.write(entry)
        return entry

    def done(self, within: timedelta) -> list[Entry]:
        """The entries whose runs were completed within a time before now, in the order of their ends.

        Raises:
            RecordingError: An entry is damaged, or cannot be read.
        """
        first = now() - within
        entries = _read_all(self.folder / DONE_FOLDER)
        ended = [entry for entry in entries if datetime.fromisoformat(entry.ended_utc) >= first]
        return sorted(ended, key=lambda entry: entry.ended_utc)

    def complete(self, entry: Entry) -> None:
        """Take an entry whose run is complete out of the queue, and keep it for the list.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        done = replace(entry, status="complete", error="", owner=None, ended_utc=entry.ended_utc or now_utc())
        self._write(self.folder / DONE_FOLDER, done)
        self.drop(entry.id)

    def wait_again(self, number: int) -> None:
        """Let a stopped, failed or skipped entry wait again, so that its run is resumed.

        Raises:
            ConfigError: There is no such entry, or it waits, runs or is complete.
        """
        entry = self._find(number)
        if entry.state not in {"stopped", "failed", "skipped"}:
            expected = "an entry that was stopped, failed or was skipped"
            raise ConfigError(Problem(f"entry {number} is {entry.state}", expected=expected))
        rules = replace(entry.rules, until_utc="") if entry.rules.is_too_late else entry.rules
        self.write(replace(entry, status="waiting", error="", n_failures=0, rules=rules))

    def write(self, entry: Entry) -> None:
        """Write an entry to its file.

        Raises:
            RecordingError: The disk is full, or the queue cannot be written to.
        """
        self._write(self.folder, entry)

    def _write(self, folder: Path, entry: Entry) -> None:
        values = {"format": FORMAT, **_adapter().dump_python(entry, mode="json")}
        with explained(folder):
            make_folder(folder)
        write_file(folder / f"{entry.id:04d}.json", dumps(values, indent=1).encode() + b"\n")

    def remove(self, ids: Sequence[int]) -> None:
        """Take entries out of the queue. Their runs stay.

        Raises:
            ConfigError: There is no such entry, or it is running. Nothing is removed.
        """
        for entry in [self._find(number) for number in ids]:
            if entry.status == "running" and not entry.is_interrupted and not entry.is_complete:
                command = "labseq stop" if entry.run_dir is None else f"labseq stop {entry.run_dir}"
                hint = f"'{command}' ends it first"
                raise ConfigError(Problem(f"entry {entry.id} is running", hint=hint))
        for number in ids:
            self.drop(number)

    def drop(self, number: int) -> None:
        """Take an entry out. It may be missing already."""
        with explained(self._file(number)):
            self._file(number).unlink(missing_ok=True)

    def move(self, number: int, before: int) -> None:
        """Put an entry before another one.

        Raises:
            ConfigError: There is no such entry.
        """
        entry, next_entry = self._find(number), self._find(before)
        if entry.id == next_entry.id:
            return
        positions = [queued.position for queued in self.entries() if queued.id != entry.id]
        lower = max((p for p in positions if p < next_entry.position), default=next_entry.position - 2)
        # a fraction, because there is always another one between two
        self.write(replace(entry, position=(lower + next_entry.position) / 2))

    def ask_to_stop(self) -> bool:
        """Ask the process that runs the queue to take no further entry. False if there is no process.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        if self.holder() is None:
            return False
        write_file(self.folder / STOP_FILE, b"")
        return True

    @property
    def is_asked_to_stop(self) -> bool:
        """Whether the queue is asked to take no further entry."""
        return (self.folder / STOP_FILE).exists()

    def clear_stop(self) -> None:
        """Withdraw the request to stop."""
        with suppress(OSError):
            (self.folder / STOP_FILE).unlink(missing_ok=True)

    @property
    def is_paused(self) -> bool:
        """Whether the process that runs the queue waits before its next entry."""
        return (self.folder / PAUSE_FILE).exists()

    def pause(self, is_paused: bool) -> None:
        """Let the process that runs the queue wait before its next entry, or continue.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        path = self.folder / PAUSE_FILE
        with explained(path):
            if is_paused:
                make_folder(self.folder)
                path.touch()
            else:
                path.unlink(missing_ok=True)

    def holder(self) -> Holder | None:
        """The process that runs the queue, or None."""
        if not self.folder.is_dir():
            return None
        lock = self.lock()
        with suppress(OSError):
            # no process runs the queue if the lock can be taken
            if (holder := lock.take()) is not None:
                return holder
            lock.release()
        return None

    def _find(self, number: int) -> Entry:
        entries = self.entries()
        for entry in entries:
            if entry.id == number:
                return entry
        expected = ", ".join(str(entry.id) for entry in entries) or "none: the queue is empty"
        raise ConfigError(Problem(f"the queue has no entry {number}", expected=expected))

    def _file(self, number: int) -> Path:
        return self.folder / f"{number:04d}.json"

    def _new_id(self) -> int:
        """A number that no entry has or had. The file ``<number>.id`` marks the last one as used."""
        with explained(self.folder):
            make_folder(self.folder)
            while True:
                used = [
                    int(match[1]) for path in self.folder.iterdir() if (match := _NUMBER.fullmatch(path.name))
                ]
                number = max(used, default=0) + 1
                try:
                    # of several processes that add entries at once, only one creates the file
                    (self.folder / f"{number:04d}.id").touch(exist_ok=False)
                except FileExistsError:
                    continue
                # one mark is enough because no lower number is given again
                for older in used:
                    (self.folder / f"{older:04d}.id").unlink(missing_ok=True)
                return number


def _read_all(folder: Path) -> list[Entry]:
    """The entries in a folder, by their numbers."""
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    entries = [_read(file) for file in files if _NUMBER.fullmatch(file.name)]
    return [entry for entry in entries if entry is not None]


def _read(file: Path) -> Entry | None:
    """Read an entry. None if it has just been removed.

    Raises:
        RecordingError: The entry is damaged, or cannot be read.
    """
    try:
        values = parse_object(read_file(file)) or {}
    except RecordingError:
        if not os.path.lexists(file):  # another command has removed it since it was listed
            return None
        raise
    if values.get("format") != FORMAT:
        raise RecordingError(file, f"is not a queue entry of format {FORMAT}", "move it away")
    try:
        if not re.fullmatch(r"-?\d{1,1000}(/0*[1-9]\d{0,999})?", str(values.get("position"))):
            raise ValueError("position: expected a number such as 3 or 5/2")
        entry = _adapter().validate_python(values)
        _check(entry, file)
    except ValueError as error:
        problem = str(error)
        if isinstance(error, ValidationError):
            first_error = error.errors()[0]
            problem = f"{'.'.join(map(str, first_error['loc']))}: {first_error['msg']}"
        raise RecordingError(file, f"is a damaged queue entry: {problem}", "move it away") from error
    options = entry.options
    options = replace(options, overrides=tuple(options.overrides), tags=tuple(options.tags))
    return replace(entry, options=options)


def _check(entry: Entry, file: Path) -> None:
    """Check the values of an entry whose types are right.

    Raises:
        ValueError: A value is not as :meth:`Queue.add` writes it.
    """
    for time in (entry.added_utc, entry.begun_utc, entry.ended_utc, entry.rules.until_utc):
        if time and ((then := datetime.fromisoformat(time)).tzinfo is None or not 2000 <= then.year < 3000):
            raise ValueError(f"{time}: expected a time of the years 2000 to 2999, with its zone")
    if not 0.0 <= (entry.expected_s or 0.0) < 1e9:  # else the expected end would be no date
        raise ValueError("expected_s: expected seconds below 1e9")
    if file.name != f"{entry.id:04d}.json":
        raise ValueError("id: expected the number in the name of the file")
    if len(entry.text) > MAX_BYTES:
        raise ValueError(f"text: it is longer than {MAX_BYTES >> 10} KiB")
    paths = {"sequence": entry.sequence, "output": entry.options.output, "run_dir": entry.run_dir}
    for name, path in paths.items():
        # an edited entry must not lead elsewhere
        if path is not None and (".." in path.parts or "\0" in str(path)):
            raise ValueError(f"{name}: expected a path without '..'")


@cache
def _adapter() -> TypeAdapter[Entry]:
    return TypeAdapter(Entry)
