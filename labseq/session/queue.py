"""The runs that are to be taken one after the other: a file for each in ``<data root>/queue/``."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

from labseq.config import StoredText, find_profile
from labseq.config.reading import decode, read_bytes
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.locks import Holder, Lock
from labseq.recording.durable import explained, parse_object, write_file
from labseq.recording.folders import STOP_FILE
from labseq.recording.plain import dumps
from labseq.recording.process import Owner
from labseq.recording.run_file import read_state
from labseq.session.checking import CheckReport, check
from labseq.session.options import Options
from labseq.session.run_record import now_utc
from labseq.session.session import Session

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
    owner: Owner | None = None

    @property
    def kept(self) -> StoredText:
        """The text, to be read in place of the file."""
        return StoredText(self.text, f"{self.sequence} (as queued)")

    @property
    def is_interrupted(self) -> bool:
        """Whether the process that ran it is gone before its end."""
        gone = self.owner is None or not (self.owner.is_here and self.owner.lives)
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
        owner=None if owner is None else Owner.from_plain(owner),
    )
