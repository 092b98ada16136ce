"""`labseq queue`: adds sequences, runs the entries one after the other, and prints them."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from labseq.assembly.assemble import assemble
from labseq.assembly.calibrations import open_store
from labseq.assembly.options import DryRun, Options
from labseq.calibration_store import age_s
from labseq.config.document import Document
from labseq.config.find import find_profile
from labseq.console.errors import exit_code_of, report, warning_lines
from labseq.console.output import say
from labseq.console.text import clock_time, plural
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.files import data_root, explained, free_bytes
from labseq.messages import clean, did_you_mean, listing, visible
from labseq.model import CALIBRATION_KINDS
from labseq.plain import now, now_utc
from labseq.processes import Process
from labseq.queue.listing import local_time, outcome_lines
from labseq.queue.queue import Entry, EntryStatus, IfFails, Queue, Rules
from labseq.roles import RunObserver
from labseq.session.check import CheckReport, check
from labseq.session.notices import Notices
from labseq.session.session import Session
from labseq.session.stopping import ask_to_stop
from labseq.units import parse_quantity, size_text

POLL_S: Final = 0.5
"""Interval in seconds at which a waiting queue looks for new entries, or for room on the disk."""
ROOM_BYTES: Final = 100_000_000
"""Free space of the disk below which no entry begins, because it would fail at its first shots."""

Opening = Callable[[RunObserver | None], Session]
"""Opens a session whose events go to an observer."""


def add_checked(
    queue: Queue,
    sequence: Path,
    options: Options,
    rules: Rules = Rules(),  # noqa: B008 - it is immutable
) -> tuple[Entry, CheckReport]:
    """Check a sequence as ``labseq check`` does, and add it at the end of the queue.

    Raises:
        LabseqError: The sequence, the profile or an option is wrong. Nothing is added.
        RecordingError: The queue cannot be written to.
    """
    with Session.open(sequence, **asdict(options)) as session:
        document = session.assembly.document
        report, text, path = check(session), document.text, document.path.absolute()
        # virtual time passes as fast as the computer can
        is_timed = options.realtime or not session.assembly.virtual_time
    # absolute, as `labseq queue run` may be started in another folder
    profile = None if options.profile is None else str(find_profile(options.profile, Path()).absolute())
    output = None if options.output is None else options.output.absolute()
    options = replace(options, profile=profile, output=output, overrides=tuple(options.overrides))
    return queue.add(path, text, options, rules, sum(report.run_s) / 2 if is_timed else None), report


def rules_from(if_fails: IfFails, until: str | None, needs: Sequence[str]) -> Rules:
    """Parse the rules of an entry as they were typed.

    Args:
        if_fails: See :class:`Rules`.
        until: A time of day by this computer's clock, or a date and a time.
        needs: "KIND=AGE" for each calibration, such as "thresholds=2h".

    Raises:
        ConfigError: A rule cannot be read.
    """
    return Rules(if_fails, "" if until is None else _time_utc(until), dict(map(_need, needs)))


def _time_utc(until: str) -> str:
    expected = "a time such as 06:00, or a date and a time such as '2026-11-30 06:00'"
    here = now().astimezone()
    try:
        if len(until) <= len("06:00"):
            at = datetime.combine(here, datetime.strptime(until, "%H:%M").time()).astimezone()
            at += timedelta(days=at <= here)
        else:
            at = datetime.fromisoformat(until).astimezone()
    except ValueError:
        raise ConfigError(Problem(f"--until is '{clean(until)}'", expected=expected)) from None
    if at <= here:
        raise ConfigError(Problem(f"--until is '{clean(until)}', which is in the past", expected=expected))
    return at.astimezone(UTC).isoformat(timespec="seconds")


def _need(text: str) -> tuple[str, float]:
    kind, equals, age = text.partition("=")
    if kind not in CALIBRATION_KINDS or not equals:
        hint = did_you_mean(kind, CALIBRATION_KINDS)
        expected = f"KIND=AGE with one of {listing(CALIBRATION_KINDS)}, such as thresholds=2h"
        raise ConfigError(Problem(f"--needs is '{clean(text)}'", expected=expected, hint=hint))
    try:
        return kind, parse_quantity(age, "time")
    except ValueError:
        expected = "an age with its unit, such as 2h or 30min"
        raise ConfigError(Problem(f"--needs {kind} is '{clean(age)}'", expected=expected)) from None


@dataclass(slots=True)
class QueueRun:
    """Takes the entries of a queue: first an interrupted one, then those that wait, in order.

    Attributes:
        queue: The queue.
        take: Runs the session that its argument opens, and shows it.
        begin: Called with each entry that is taken.
        fail: Called with each error after which the queue continues.
        calibrate: Takes a calibration. Gets its kind, the profile, and the kind of dry run.
        keep_going: Whether the queue continues after a failed entry, whatever the entry's own rule.
        first_error: The error of the first entry that failed.
        doubted: Kinds of calibration that an alarm of an earlier run contradicts.
    """

    queue: Queue
    take: Callable[[Opening], None]
    begin: Callable[[Entry], None]
    fail: Callable[[LabseqError], object]
    calibrate: Callable[[str, str, DryRun], None]
    keep_going: bool = False
    first_error: LabseqError | None = None
    doubted: set[str] = field(default_factory=set[str])
    _tried: set[int] = field(default_factory=set[int])

    def run(self, *, watch: bool = False) -> None:
        """Take entries until none waits, or the queue is asked to stop. While it is paused, wait.

        Args:
            watch: Whether to wait for new entries when none waits.

        Raises:
            ConfigError: Another process runs the queue.
            LabseqError: The error that ended a run, unless the queue keeps going.
            StopRequested: Ctrl-C or SIGTERM.
        """
        lock = self.queue.lock()
        with explained(self.queue.folder):
            holder = lock.take(lambda text: say(f"warning: {text}", stream=sys.stderr))
        if holder is not None:
            raise ConfigError(Problem(f"the queue is already being run: {holder}", str(self.queue.folder)))
        self.queue.clear_stop()
        try:
            # read each time, because other commands change the queue meanwhile
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
        """The entry to take next. Entries with a complete run or a passed time limit are not taken."""
        open_entries: list[Entry] = []
        for entry in self.queue.entries():
            if entry.is_complete:
                self.queue.complete(entry)
            elif entry.status == "waiting" and entry.rules.is_too_late:
                late = f"not begun by {local_time(entry.rules.until_utc)}"
                self.queue.write(replace(entry, status="skipped", error=late, ended_utc=now_utc()))
            elif entry.id not in self._tried:
                open_entries.append(entry)
        interrupted = [entry for entry in open_entries if entry.is_interrupted]
        waiting = [entry for entry in open_entries if entry.status == "waiting"]
        # an interrupted run holds shots already, so its entry comes before all others
        return next(iter([*interrupted, *waiting]), None)

    def _await_room(self, entry: Entry) -> None:
        """Wait while the disk is full, because space may be freed and the other entries can then be taken."""
        folder = entry.options.output or self.queue.folder.parent
        is_said = False
        while (n_free := free_bytes(folder)) < ROOM_BYTES and not self.queue.is_asked_to_stop:
            if not is_said:
                what = f"waits: the disk of {visible(str(folder))} has {size_text(n_free)} free"
                say(f"queue: {what}, and continues at {size_text(ROOM_BYTES)}", stream=sys.stderr)
            is_said = True
            time.sleep(POLL_S)

    def _work(self, entry: Entry) -> None:
        self._await_room(entry)
        if self.queue.is_asked_to_stop:
            return
        # this process does not take a failed entry again unless the entry's rule asks for it
        self._tried.add(entry.id)
        self.begin(entry)
        owner, begun_utc = Process.current(), now_utc()
        begun = replace(entry, status="running", owner=owner, error="", begun_utc=begun_utc, ended_utc="")
        recorder = _EntryRecorder(self.queue, begun, self.doubted)
        recorder.write()
        try:
            self._take_calibrations(entry)
            self.take(lambda observer: _open(entry, recorder.passing_to(observer)))
        except StopRequested as stop:
            if stop.after_shot or stop.signal_number == signal.SIGINT:
                recorder.end("stopped", recorder.why_stopped or str(stop))
            if not stop.after_shot:  # after SIGTERM the entry is interrupted, and will be resumed
                raise
        except KeyboardInterrupt:
            recorder.end("stopped", "stopped by Ctrl-C")
            raise
        except LabseqError as error:
            self._failed(entry, recorder, error)
        else:
            self.queue.complete(recorder.entry)

    def _failed(self, entry: Entry, recorder: _EntryRecorder, error: LabseqError) -> None:
        """Do what the entry says for a run that has failed."""
        self.first_error = self.first_error or error
        # a mistake in a file will still be there the second time
        is_tried_again = entry.rules.if_fails == "retry" and entry.n_failures == 0
        if is_tried_again and not isinstance(error, ConfigError):
            self._tried.discard(entry.id)
            recorder.end("waiting", str(error))
        else:
            recorder.end("failed", str(error))
            if entry.rules.if_fails == "stop" and not self.keep_going:
                raise error
        self.fail(error)
        self._await_room(entry)
        with suppress(RecordingError):  # a full disk could not take it before
            recorder.write()

    def _take_calibrations(self, entry: Entry) -> None:
        """Take the calibrations again that the entry needs and that are missing, too old or doubted."""
        if not entry.rules.needs or entry.run_dir is not None:  # a resumed run keeps its calibrations
            return
        named = entry.options.profile or Document.read(entry.sequence, entry.stored_text).get(("profile",))
        profile = str(find_profile(str(named), entry.sequence.parent))
        for kind, max_age_s in entry.rules.needs.items():
            stored = open_store(profile, entry.options.dry_run)[0].entry_in_use(kind)
            # the age is unknown if this computer's clock is behind, so such an entry counts as new
            if stored is None or (age_s(stored.entry) or 0.0) > max_age_s or kind in self.doubted:
                self.calibrate(kind, profile, entry.options.dry_run)
                self.doubted.discard(kind)


class _EntryRecorder:
    """A ``RunObserver`` that keeps the file of the entry in progress up to date.

    Attributes:
        entry: The entry as it is in its file.
        why_stopped: Why this class asked its run to end. "" if it did not.
    """

    def __init__(self, queue: Queue, entry: Entry, doubted: set[str]) -> None:
        self._queue = queue
        self.entry = entry
        self.why_stopped = ""
        self._doubted = doubted
        self._observer: RunObserver | None = None

    def passing_to(self, observer: RunObserver | None) -> _EntryRecorder:
        """Also pass all events to an observer."""
        self._observer = observer
        return self

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Record the run's folder as soon as it exists, and end a run whose time limit has passed."""
        if name == "run_starting":
            self.entry = replace(self.entry, run_dir=Path(values["run_dir"]))
            with suppress(RecordingError):  # the run itself reports a full disk
                self.write()
        elif name == "warning" and values.get("alarm") == "confidence":
            self._doubted.add("thresholds")
        elif name == "shot_finished" and self.entry.rules.is_too_late and self.entry.run_dir is not None:
            self.why_stopped = f"ended at {local_time(self.entry.rules.until_utc)}"
            ask_to_stop(self.entry.run_dir)
        if self._observer is not None:
            self._observer.event(name, values)

    def write(self) -> None:
        """Write the entry."""
        self._queue.write(self.entry)

    def end(self, status: EntryStatus, error: str) -> None:
        """Record how it ended. An entry without a run keeps waiting."""
        status = "waiting" if self.entry.run_dir is None else status
        n_failures = self.entry.n_failures + (status != "stopped")
        self.entry = replace(
            self.entry, status=status, error=error, owner=None, n_failures=n_failures, ended_utc=now_utc()
        )
        with suppress(RecordingError):
            self.write()


def _open(entry: Entry, observer: RunObserver) -> Session:
    """The session of an entry, which resumes its run if that was interrupted."""
    options = entry.options
    if entry.run_dir is not None and entry.run_dir.is_dir():
        return Session.resume(entry.run_dir, realtime=options.realtime, observer=observer)
    return Session(assemble(entry.sequence, options, kept=entry.stored_text), options, observer)


def add_entry(sequence: Path, options: Options, rules: Rules) -> None:
    """Check a sequence and add it to the queue."""
    entry, report = add_checked(Queue(data_root()), sequence, options, rules)
    for warning in report.warnings:
        say(*warning_lines(warning), stream=sys.stderr)
    takes = "" if entry.expected_s is None else f", about {clock_time(entry.expected_s)}"
    say(f"{entry.id}: {clean(str(sequence))}, {plural(report.n_shots, 'shot')}{takes}, with its present text")


def pause_queue(is_paused: bool) -> None:
    """Pause or continue the queue, and print which."""
    Queue(data_root()).pause(is_paused)
    paused_text = "the queue is paused: 'labseq queue pause --off' continues it"
    say(paused_text if is_paused else "the queue continues")


def run_entries(
    run_session: Callable[[Opening], None],
    calibrate: Callable[[str, str, DryRun], None],
    *,
    keep_going: bool,
    watch: bool,
) -> int:
    """Run the entries of the queue, and print at the end what became of them.

    Args:
        run_session: Runs the session that its argument opens, and prints the result.
        calibrate: Takes a calibration, and prints the result.

    Returns:
        The exit code of the first entry that failed, or 0.
    """
    queue, begun = Queue(data_root()), now()
    notices = Notices.read()
    runs = QueueRun(queue, run_session, _report, report, calibrate, keep_going=keep_going)
    try:
        runs.run(watch=watch)
    finally:
        lines = outcome_lines(queue, now() - begun)
        say(*lines)
        notices.send("queue", "; ".join(lines))
    return 0 if runs.first_error is None else exit_code_of(runs.first_error)


def _report(entry: Entry) -> None:
    resumed_run = f", resuming {entry.run_dir}" if entry.run_dir is not None else ""
    say(f"queue: {entry.id} {clean(str(entry.sequence))}{resumed_run}")
