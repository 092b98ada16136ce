"""The queue: runs taken one after the other, a file for each."""

from __future__ import annotations

import json
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

from labseq.config import StoredText, find_profile
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.files import Holder, Lock, Process, explained, write_file
from labseq.messages import visible
from labseq.plain import dumps, parse_object
from labseq.recording.folders import STOP_FILE
from labseq.recording.run_file import read_state
from labseq.roles import RunObserver
from labseq.session.assembly import assemble
from labseq.session.check import CheckReport, check
from labseq.session.options import Options
from labseq.session.provenance import now_utc
from labseq.session.session import Session
from labseq.text_files import decode, read_bytes

FOLDER: Final = "queue"
FORMAT: Final = 1
EntryStatus = Literal["waiting", "running", "stopped", "failed"]

_NUMBER: Final = re.compile(r"(\d{4,})\.(?:json|id)")


@dataclass(frozen=True, slots=True)
class Entry:
    """A run that is to be taken.

    Attributes:
        id: Its number; no later entry gets it again.
        position: Entries are taken in this order.
        added_utc: When it was added, ISO 8601, UTC.
        sequence: The sequence's file, absolute.
        text: What that said when it was added; this is what will be run.
        options: What the user changed.
        status: "waiting", "running", or how its run ended early.
        run_dir: The folder of its run, once there is one.
        error: Why it was not begun, or ended early; or "".
        owner: The process that runs it, or did.
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

    @property
    def kept(self) -> StoredText:
        """The text, to be read in place of the file."""
        return StoredText(self.text, f"{self.sequence} (as queued)")

    @property
    def is_interrupted(self) -> bool:
        """Whether the process that ran it is gone before its end."""
        gone = self.owner is None or not (self.owner.is_here and self.owner.is_running)
        return self.status == "running" and gone

    @property
    def is_complete(self) -> bool:
        """Whether its run is complete, by whomever it was taken to its end."""
        return self.run_dir is not None and read_state(self.run_dir)[0] == "complete"

    @property
    def state(self) -> str:
        """How it stands, in a word."""
        if self.is_complete:
            return "complete"
        return "interrupted" if self.is_interrupted else self.status

    @property
    def has_changed(self) -> bool:
        """Whether the sequence's file says something else today."""
        try:
            return decode(read_bytes(self.sequence), visible(str(self.sequence))) != self.text
        except ConfigError:
            return True


class Queue:
    """The queue of a data root.

    Args:
        root: The data root.
    """

    def __init__(self, root: Path) -> None:
        self.folder = root.absolute() / FOLDER

    def lock(self) -> Lock:
        """What whoever runs the queue holds."""
        return Lock(self.folder / ".lock", "labseq queue run")

    def entries(self) -> list[Entry]:
        """All entries, in the order in which they are taken.

        Raises:
            RecordingError: One is damaged, or cannot be read.
        """
        files = sorted(self.folder.glob("*.json")) if self.folder.is_dir() else []
        read = [_read(file) for file in files if _NUMBER.fullmatch(file.name)]
        return sorted((one for one in read if one is not None), key=lambda one: (one.position, one.id))

    def add(self, sequence: Path, options: Options) -> tuple[Entry, CheckReport]:
        """Check a sequence as ``labseq check`` does, and add it at the end.

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
        last = max((one.position for one in self.entries()), default=Fraction(0))
        entry = Entry(self._new_id(), last + 1, now_utc(), path, text, options)
        self.write(entry)
        return entry, report

    def write(self, entry: Entry) -> None:
        """Put an entry down as it stands.

        Raises:
            RecordingError: The disk is full, or the queue cannot be written to.
        """
        values = {"format": FORMAT, **asdict(entry)}
        values |= {"position": str(entry.position), "sequence": str(entry.sequence)}
        write_file(self._file(entry.id), dumps(_texts(values), indent=1).encode() + b"\n")

    def remove(self, ids: Sequence[int]) -> None:
        """Take entries out of the queue; their runs stay.

        Raises:
            ConfigError: There is no such entry, or it is running; nothing is removed.
        """
        for one in [self._find(number) for number in ids]:
            if one.status == "running" and not one.is_interrupted and not one.is_complete:
                hint = f"'labseq stop {one.run_dir or ''}' ends it first".replace(" '", "'")
                raise ConfigError(Problem(f"entry {one.id} is running", hint=hint))
        for number in ids:
            self.drop(number)

    def drop(self, number: int) -> None:
        """Take an entry out; legal if it is not there.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        with explained(self._file(number)):
            self._file(number).unlink(missing_ok=True)

    def move(self, number: int, before: int) -> None:
        """Put an entry before another one.

        Raises:
            ConfigError: There is no such entry.
        """
        entry, other = self._find(number), self._find(before)
        if entry.id == other.id:
            return
        below = [one.position for one in self.entries() if one.position < other.position and one is not entry]
        lower = max(below, default=other.position - 2)
        self.write(replace(entry, position=(lower + other.position) / 2))

    def ask_to_stop(self) -> bool:
        """Ask whoever runs the queue to take no further entry; False if nobody does.

        Raises:
            RecordingError: The queue cannot be written to.
        """
        if self.holder() is None:
            return False
        write_file(self.folder / STOP_FILE, b"")
        return True

    @property
    def is_asked_to_stop(self) -> bool:
        """Whether no further entry is to be taken."""
        return (self.folder / STOP_FILE).exists()

    def forget_stop(self) -> None:
        """Take back what was asked for before."""
        with suppress(OSError):
            (self.folder / STOP_FILE).unlink(missing_ok=True)

    def holder(self) -> Holder | None:
        """Who runs the queue; None for nobody."""
        if not self.folder.is_dir():
            return None
        lock = self.lock()
        with suppress(OSError):
            if (holder := lock.take()) is not None:
                return holder
            lock.release()
        return None

    def _find(self, number: int) -> Entry:
        entries = self.entries()
        for one in entries:
            if one.id == number:
                return one
        known = ", ".join(str(one.id) for one in entries) or "nothing: the queue is empty"
        raise ConfigError(Problem(f"the queue has no entry {number}", expected=known))

    def _file(self, number: int) -> Path:
        return self.folder / f"{number:04d}.json"

    def _new_id(self) -> int:
        """A number that no entry has or had; the file ``<number>.id`` stands for its having been given."""
        with explained(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            while True:
                given = [int(m[1]) for p in self.folder.iterdir() if (m := _NUMBER.fullmatch(p.name))]
                number = max(given, default=0) + 1
                try:
                    (self.folder / f"{number:04d}.id").touch(exist_ok=False)
                except FileExistsError:
                    continue
                for older in given:
                    (self.folder / f"{older:04d}.id").unlink(missing_ok=True)
                return number


def _texts(values: dict[str, Any]) -> dict[str, Any]:
    """Paths as text."""
    options = {k: str(v) if isinstance(v, Path) else v for k, v in values["options"].items()}
    run_dir = values["run_dir"]
    return {**values, "options": options, "run_dir": None if run_dir is None else str(run_dir)}


def _read(file: Path) -> Entry | None:
    """Read an entry; None if it has just been removed.

    Raises:
        RecordingError: It is damaged, or cannot be read.
    """
    try:
        values = parse_object(file.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordingError(file, f"cannot be read: {error.strerror}; check the disk") from error
    try:
        return _entry(values or {})
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(file, f"is no entry of a queue: {error!r}; move it away") from error


def _entry(values: dict[str, Any]) -> Entry:
    if values["format"] != FORMAT or values["status"] not in get_args(EntryStatus):
        raise ValueError(json.dumps(values["format"]))
    options, run_dir, owner = values["options"], values["run_dir"], values["owner"]
    output = None if options["output"] is None else Path(options["output"])
    given: dict[str, Any] = {**options, "output": output, "overrides": tuple(options["overrides"])}
    return Entry(
        id=int(values["id"]),
        position=Fraction(values["position"]),
        added_utc=str(values["added_utc"]),
        sequence=Path(values["sequence"]),
        text=str(values["text"]),
        options=Options(**given),
        status=cast("EntryStatus", values["status"]),
        run_dir=None if run_dir is None else Path(run_dir),
        error=str(values["error"]),
        owner=None if owner is None else Process.from_plain(owner),
    )


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
        note = _EntryObserver(
            self._queue, replace(entry, status="running", owner=Process.current(), error="")
        )
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
