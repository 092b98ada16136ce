"""Takes the entries of a queue, one after the other."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.recording.durable import explained
from labseq.recording.process import Owner
from labseq.roles import RunObserver
from labseq.session.assembly import assemble
from labseq.session.queue import Entry, Queue
from labseq.session.session import Session

LOOK_S: Final = 0.5
"""How often a queue that waits for new entries looks for them."""

Opening = Callable[[RunObserver | None], Session]
"""Opens a session that tells an observer everything."""


class QueueRun:
    """Takes the entries of a queue: first one that was interrupted, then those that wait, in order.

    Args:
        queue: The queue.
        take: Runs what its argument opens, and shows it.
        begin: Told each entry that is taken.
        fail: Told each error of an entry after which the queue goes on.
        keep_going: Whether the queue goes on after an entry that failed.
    """

    def __init__(
        self,
        queue: Queue,
        take: Callable[[Opening], None],
        begin: Callable[[Entry], None],
        fail: Callable[[LabseqError], object],
        *,
        keep_going: bool = False,
    ) -> None:
        self.first_error: LabseqError | None = None
        self._queue = queue
        self._take = take
        self._begin = begin
        self._fail = fail
        self._keep_going = keep_going
        self._tried: set[int] = set()

    def run(self, *, watch: bool = False) -> None:
        """Take entries until none waits, or the queue is asked to stop.

        Args:
            watch: Whether to wait for new ones when none waits.

        Raises:
            ConfigError: Somebody else runs the queue.
            LabseqError: Whatever ended a run, unless the queue keeps going.
            StopRequested: Ctrl-C or SIGTERM.
        """
        lock = self._queue.lock()
        with explained(self._queue.folder):
            holder = lock.take()
        if holder is not None:
            raise ConfigError(Problem(f"the queue is at work already: {holder}", str(self._queue.folder)))
        self._queue.forget_stop()
        try:
            while not self._queue.is_asked_to_stop:
                entry = self._next()
                if entry is not None:
                    self._work(entry)
                elif watch:
                    time.sleep(LOOK_S)
                else:
                    break
        finally:
            self._queue.forget_stop()
            lock.release()

    def _next(self) -> Entry | None:
        """The entry to take; those whose runs are complete leave the queue."""
        left: list[Entry] = []
        for entry in self._queue.entries():
            if entry.is_complete:
                self._queue.drop(entry.id)
            elif entry.id not in self._tried:
                left.append(entry)
        interrupted = [entry for entry in left if entry.is_interrupted]
        waiting = [entry for entry in left if entry.status == "waiting"]
        return next(iter([*interrupted, *waiting]), None)

    def _work(self, entry: Entry) -> None:
        self._tried.add(entry.id)
        self._begin(entry)
        note = _EntryObserver(self._queue, replace(entry, status="running", owner=Owner.current(), error=""))
        note.write()
        try:
            self._take(lambda observer: _open(entry, note.beside(observer)))
        except StopRequested as stop:
            if stop.after_shot or stop.signal_number == signal.SIGINT:
                note.end("stopped", str(stop))
            if not stop.after_shot:  # by SIGTERM it is interrupted, and is gone on with
                raise
        except KeyboardInterrupt:
            note.end("stopped", "stopped by Ctrl-C")
            raise
        except LabseqError as error:
            note.end("failed", str(error))
            self.first_error = self.first_error or error
            if not self._keep_going:
                raise
            self._fail(error)
        else:
            self._queue.drop(entry.id)


class _EntryObserver:
    """What is known of an entry that is being taken; implements ``RunObserver``."""

    def __init__(self, queue: Queue, entry: Entry) -> None:
        self._queue = queue
        self._entry = entry
        self._observer: RunObserver | None = None

    def beside(self, observer: RunObserver | None) -> _EntryObserver:
        """Pass everything on to an observer."""
        self._observer = observer
        return self

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Note the run's folder as soon as there is one."""
        if name == "run_starting":
            self._entry = replace(self._entry, run_dir=Path(values["run_dir"]))
            with suppress(RecordingError):  # the run will tell of a full disk itself
                self.write()
        if self._observer is not None:
            self._observer.event(name, values)

    def write(self) -> None:
        """Put it down."""
        self._queue.write(self._entry)

    def end(self, status: Any, error: str) -> None:
        """Put down how it ended; what was never begun goes on waiting."""
        if self._entry.run_dir is None:
            status = "waiting"
        self._entry = replace(self._entry, status=status, error=error, owner=None)
        with suppress(RecordingError):
            self.write()


def _open(entry: Entry, observer: RunObserver) -> Session:
    """The session of an entry: that of its run if that was interrupted, else a new one.

    Raises:
        LabseqError: It cannot be opened.
    """
    options = entry.options
    if entry.run_dir is not None and entry.run_dir.is_dir():
        return Session.resume(entry.run_dir, realtime=options.realtime, observer=observer)
    assembly = assemble(
        entry.sequence,
        profile=options.profile,
        overrides=options.overrides,
        given=options.own(),
        dry_run=options.dry_run,
        kept=entry.kept,
    )
    return Session(assembly, options, observer)
