"""`labseq queue`: adds sequences, runs the entries one after the other, and prints them."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.assembly.assemble import assemble
from labseq.assembly.options import Options
from labseq.config.find import find_profile
from labseq.console.errors import exit_code_of, report, warning_lines
from labseq.console.output import say
from labseq.console.report import Column, print_report, table
from labseq.console.text import plural
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.files import data_root, explained
from labseq.messages import MAX_ERROR, clean, visible
from labseq.processes import Process
from labseq.queue.queue import Entry, Queue
from labseq.roles import RunObserver
from labseq.session.check import CheckReport, check
from labseq.session.session import Session

POLL_S: Final = 0.5
"""Time between two looks for new entries while the queue waits, in seconds."""

Opening = Callable[[RunObserver | None], Session]
"""Opens a session whose events go to an observer."""


def add_checked(queue: Queue, sequence: Path, options: Options) -> tuple[Entry, CheckReport]:
    """Check a sequence as ``labseq check`` does, and add it at the end of the queue.

    Raises:
        LabseqError: Something is wrong with the sequence, the profile or an option; nothing is added.
        RecordingError: The queue cannot be written to.
    """
    with Session.open(sequence, **asdict(options)) as session:
        document = session.assembly.document
        report, text, path = check(session), document.text, document.path.absolute()
    # absolute, as `labseq queue run` may be started in another folder
    profile = None if options.profile is None else str(find_profile(options.profile, Path()).absolute())
    output = None if options.output is None else options.output.absolute()
    options = replace(options, profile=profile, output=output, overrides=tuple(options.overrides))
    return queue.add(path, text, options), report


@dataclass(slots=True)
class QueueRun:
    """Takes the entries of a queue: first one that was interrupted, then those that wait, in order.

    Attributes:
        queue: The queue.
        take: Runs the session that its argument opens, and shows it.
        begin: Called with each entry that is taken.
        fail: Called with each error after which the queue continues.
        keep_going: Whether the queue continues after an entry that failed.
        first_error: The error of the first entry that failed.
    """

    queue: Queue
    take: Callable[[Opening], None]
    begin: Callable[[Entry], None]
    fail: Callable[[LabseqError], object]
    keep_going: bool = False
    first_error: LabseqError | None = None
    _tried: set[int] = field(default_factory=set[int])

    def run(self, *, watch: bool = False) -> None:
        """Take entries until none waits, or the queue is asked to stop; while it is paused, wait.

        Args:
            watch: Whether to wait for new ones when none waits.

        Raises:
            ConfigError: Another process runs the queue.
            LabseqError: The error that ended a run, unless the queue keeps going.
            StopRequested: Ctrl-C or SIGTERM.
        """
        lock = self.queue.lock()
        with explained(self.queue.folder):
            holder = lock.take()
        if holder is not None:
            raise ConfigError(Problem(f"the queue is already being run: {holder}", str(self.queue.folder)))
        self.queue.clear_stop()
        try:
            # read each time, as other commands change the queue meanwhile
            while not self.queue.is_asked_to_stop:
                is_paused = self.queue.is_paused
                entry = None if is_paused else self._next()
                if entry is not None:
                    self._work(entry)
                elif watch or is_paused:
                    time.sleep(POLL_S)
                else:
                    break
        finally:
            self.queue.clear_stop()
            lock.release()

    def _next(self) -> Entry | None:
        """The entry to take; entries whose runs are complete leave the queue."""
        open_entries: list[Entry] = []
        for entry in self.queue.entries():
            if entry.is_complete:
                self.queue.drop(entry.id)
            elif entry.id not in self._tried:
                open_entries.append(entry)
        interrupted = [entry for entry in open_entries if entry.is_interrupted]
        waiting = [entry for entry in open_entries if entry.status == "waiting"]
        # an interrupted run holds shots already: its entry comes before all others
        return next(iter([*interrupted, *waiting]), None)

    def _work(self, entry: Entry) -> None:
        # an entry that fails is not taken again by this process
        self._tried.add(entry.id)
        self.begin(entry)
        recorder = _EntryRecorder(
            self.queue, replace(entry, status="running", owner=Process.current(), error="")
        )
        recorder.write()
        try:
            self.take(lambda observer: _open(entry, recorder.passing_to(observer)))
        except StopRequested as stop:
            if stop.after_shot or stop.signal_number == signal.SIGINT:
                recorder.end("stopped", str(stop))
            if not stop.after_shot:  # after SIGTERM the entry is interrupted, and will be resumed
                raise
        except KeyboardInterrupt:
            recorder.end("stopped", "stopped by Ctrl-C")
            raise
        except LabseqError as error:
            recorder.end("failed", str(error))
            self.first_error = self.first_error or error
            if not self.keep_going:
                raise
            self.fail(error)
        else:
            self.queue.drop(entry.id)


class _EntryRecorder:
    """Implements ``RunObserver``: keeps the file of the entry that is being taken up to date."""

    def __init__(self, queue: Queue, entry: Entry) -> None:
        self._queue = queue
        self._entry = entry
        self._observer: RunObserver | None = None

    def passing_to(self, observer: RunObserver | None) -> _EntryRecorder:
        """Pass all events on to an observer, too."""
        self._observer = observer
        return self

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Record the run's folder as soon as there is one."""
        if name == "run_starting":
            self._entry = replace(self._entry, run_dir=Path(values["run_dir"]))
            with suppress(RecordingError):  # the run itself reports a full disk
                self.write()
        if self._observer is not None:
            self._observer.event(name, values)

    def write(self) -> None:
        """Write the entry."""
        self._queue.write(self._entry)

    def end(self, status: Any, error: str) -> None:
        """Record how it ended; an entry without a run keeps waiting."""
        if self._entry.run_dir is None:
            status = "waiting"
        self._entry = replace(self._entry, status=status, error=error, owner=None)
        with suppress(RecordingError):
            self.write()


def _open(entry: Entry, observer: RunObserver) -> Session:
    """The session of an entry: that of its run if that was interrupted, else a new one."""
    options = entry.options
    if entry.run_dir is not None and entry.run_dir.is_dir():
        return Session.resume(entry.run_dir, realtime=options.realtime, observer=observer)
    return Session(assemble(entry.sequence, options, kept=entry.stored_text), options, observer)


def add_entry(sequence: Path, options: Options) -> None:
    """Check a sequence and add it to the queue."""
    entry, report = add_checked(Queue(data_root()), sequence, options)
    for warning in report.warnings:
        say(*warning_lines(warning), stream=sys.stderr)
    say(f"{entry.id}: {clean(str(sequence))}, {plural(report.n_shots, 'shot')}, with its present text")


@dataclass(frozen=True, slots=True)
class EntryRow:
    """An entry of the queue.

    Attributes:
        changed: Whether its sequence was changed or removed since; the queued text will run.
    """

    id: int
    state: str
    sequence: Path
    changed: bool
    added_utc: str
    options: Options
    run_dir: Path | None
    error: str | None

    @classmethod
    def of(cls, entry: Entry) -> EntryRow:
        """An entry as the queue's file has it."""
        return cls(
            id=entry.id,
            state=entry.state,
            sequence=entry.sequence,
            changed=entry.has_changed,
            added_utc=entry.added_utc,
            options=entry.options,
            run_dir=entry.run_dir,
            error=entry.error or None,
        )

    @property
    def added_text(self) -> str:
        """When it was added, by this computer's clock."""
        return f"{datetime.fromisoformat(self.added_utc).astimezone():%Y-%m-%d %H:%M}"

    @property
    def options_text(self) -> str:
        """The options that differ from their defaults."""
        return clean(", ".join(f"{address}={value}" for address, value in self.options.changes().items()))

    @property
    def notes(self) -> list[str]:
        """Notes for the user, for example why its run ended."""
        notes: list[str] = []
        if self.changed and self.state != "complete":
            name = clean(_short(self.sequence))
            notes.append(f"{name} was changed or removed since; the queued text will run")
        if self.error:
            notes.append(visible(self.error.splitlines()[0][:MAX_ERROR]))
        if self.state in {"stopped", "failed"} and self.run_dir is not None:
            notes.append(f"labseq resume {visible(str(self.run_dir))}")
        return [f"{self.id}: {note}" for note in notes]


ENTRIES: Final[Sequence[Column[EntryRow]]] = (
    Column("id", lambda entry: entry.id, right=True),
    Column("state", lambda entry: entry.state),
    Column("sequence", lambda entry: clean(_short(entry.sequence))),
    Column("added", lambda entry: entry.added_text),
    Column("options", lambda entry: entry.options_text),
)


@dataclass(frozen=True, slots=True)
class QueueList:
    """The entries of the queue, in order.

    Attributes:
        run_by: The process that runs them, or None.
        paused: Whether no further entry is started.
    """

    entries: Sequence[EntryRow]
    run_by: str | None
    paused: bool

    def as_text(self) -> list[str]:
        """A row per entry, notes on some of them, and the state of the queue."""
        lines = table(self.entries, ENTRIES) if self.entries else ["the queue is empty"]
        notes = [note for entry in self.entries for note in entry.notes]
        state = [] if self.run_by is None else [f"run by: {self.run_by}"]
        state += ["paused: 'labseq queue pause --off' continues it"] if self.paused else []
        return [*lines, *([""] if notes else []), *notes, *([""] if state else []), *state]


def list_entries(*, as_json: bool) -> None:
    """Print the entries of the queue, in order."""
    queue = Queue(data_root())
    entries, holder = [EntryRow.of(entry) for entry in queue.entries()], queue.holder()
    run_by = None if holder is None else str(holder)
    print_report(QueueList(entries, run_by, queue.is_paused), as_json=as_json)


def pause_queue(is_paused: bool) -> None:
    """Pause the queue, or continue it, and print that."""
    Queue(data_root()).pause(is_paused)
    paused_text = "the queue is paused: 'labseq queue pause --off' continues it"
    say(paused_text if is_paused else "the queue continues")


def run_entries(run_session: Callable[[Opening], None], *, keep_going: bool, watch: bool) -> int:
    """Run the entries of the queue.

    Args:
        run_session: Runs the session that its argument opens, and prints the result.

    Returns:
        The exit code: that of the first entry that failed, or 0.
    """
    runs = QueueRun(Queue(data_root()), run_session, _report, report, keep_going=keep_going)
    runs.run(watch=watch)
    return 0 if runs.first_error is None else exit_code_of(runs.first_error)


def _report(entry: Entry) -> None:
    resumed_run = f", resuming {entry.run_dir}" if entry.run_dir is not None else ""
    say(f"queue: {entry.id} {clean(str(entry.sequence))}{resumed_run}")


def _short(path: Path) -> str:
    """The path relative to the current folder if it is below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
