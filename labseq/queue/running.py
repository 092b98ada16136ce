"""Adds sequences to the queue, and runs its entries one after the other."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from labseq.config.find import find_profile
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.files import explained
from labseq.processes import Process
from labseq.queue.queue import Entry, Queue
from labseq.roles import RunObserver
from labseq.session.assembly import assemble
from labseq.session.check import CheckReport, check
from labseq.session.options import Options
from labseq.session.session import Session

POLL_S: Final = 0.5
"""How often a queue that waits for new entries looks for them."""

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
        left: list[Entry] = []
        for entry in self.queue.entries():
            if entry.is_complete:
                self.queue.drop(entry.id)
            elif entry.id not in self._tried:
                left.append(entry)
        interrupted = [entry for entry in left if entry.is_interrupted]
        waiting = [entry for entry in left if entry.status == "waiting"]
        return next(iter([*interrupted, *waiting]), None)

    def _work(self, entry: Entry) -> None:
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
