"""`labseq queue list`: the entries, when each is expected to end, and completed ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from labseq.assembly.options import Options
from labseq.console.report import Column, print_report, table
from labseq.console.text import age_text, plural
from labseq.files import data_root
from labseq.messages import MAX_ERROR, clean, visible
from labseq.plain import now
from labseq.queue.queue import Entry, Queue, Rules

NIGHT: Final = timedelta(hours=24)
"""Entries whose runs became complete within this time are listed."""


def local_time(time_utc: str) -> str:
    """A time by this computer's clock, with its date unless that is today."""
    local = datetime.fromisoformat(time_utc).astimezone()
    return f"{local:%H:%M}" if local.date() == now().astimezone().date() else f"{local:%Y-%m-%d %H:%M}"


def expected_ends(entries: Iterable[Entry]) -> dict[int, str]:
    """Number of each entry that runs or waits -> when its run is expected to end, ISO 8601, UTC.

    Neither an entry of unknown duration nor the entries after it have an expected end.
    """
    ends: dict[int, str] = {}
    at = now()
    ahead = [entry for entry in entries if entry.state in {"running", "interrupted", "waiting"}]
    for entry in sorted(ahead, key=lambda entry: entry.state == "waiting"):
        if entry.expected_s is None:
            break
        begun = datetime.fromisoformat(entry.begun_utc) if entry.state == "running" else at
        at = max(at, begun + timedelta(seconds=entry.expected_s))
        ends[entry.id] = at.isoformat(timespec="seconds")
    return ends


@dataclass(frozen=True, slots=True)
class EntryRow:
    """An entry of the queue.

    Attributes:
        changed: Whether its sequence has been changed or removed. The queued text will run anyway.
        begun_utc: When its run began. None before.
        ends_utc: When its run ended or is expected to end. None if this is unknown.
    """

    id: int
    state: str
    sequence: Path
    changed: bool
    added_utc: str
    options: Options
    rules: Rules
    run_dir: Path | None
    error: str | None
    expected_s: float | None
    begun_utc: str | None
    ends_utc: str | None

    @classmethod
    def of(cls, entry: Entry, expected: Mapping[int, str]) -> EntryRow:
        """Make the row of an entry. ``expected`` is the result of :func:`expected_ends`."""
        return cls(
            id=entry.id,
            state=entry.state,
            sequence=entry.sequence,
            changed=entry.state != "complete" and entry.has_changed,
            added_utc=entry.added_utc,
            options=entry.options,
            rules=entry.rules,
            run_dir=entry.run_dir,
            error=entry.error or None,
            expected_s=entry.expected_s,
            begun_utc=entry.begun_utc or None,
            ends_utc=expected.get(entry.id) or entry.ended_utc or None,
        )

    @property
    def begun_text(self) -> str:
        """When its run began."""
        return "-" if self.begun_utc is None else local_time(self.begun_utc)

    @property
    def ends_text(self) -> str:
        """When its run ended, or about when it will."""
        if self.ends_utc is None:
            return "-"
        about = "about " if self.state in {"running", "interrupted", "waiting"} else ""
        return about + local_time(self.ends_utc)

    @property
    def changes(self) -> dict[str, str]:
        """The options that differ from their defaults. A profile is given by name, not by path."""
        changes = self.options.changes()
        return changes | ({"profile": Path(changes["profile"]).stem} if "profile" in changes else {})

    @property
    def options_text(self) -> str:
        """The options and rules that differ from their defaults."""
        values = [f"{address}={value}" for address, value in self.changes.items()]
        return clean(", ".join([*values, *rule_texts(self.rules)]))

    @property
    def notes(self) -> list[str]:
        """Notes for the user, for example why its run ended."""
        notes: list[str] = []
        if self.changed:
            name = clean(_short(self.sequence))
            notes.append(f"{name} has been changed or removed; the queued text will run")
        if self.error:
            notes.append(visible(self.error.splitlines()[0][:MAX_ERROR]))
        if self.state in {"stopped", "failed", "skipped"}:
            again = f"'labseq queue resume {self.id}' puts it back into the queue"
            now = f"'labseq resume {visible(str(self.run_dir))}' resumes its run now, "
            notes.append(again if self.run_dir is None else now + again)
        return [f"{self.id}: {note}" for note in notes]


def rule_texts(rules: Rules) -> list[str]:
    """The rules of an entry that differ from their defaults."""
    texts = [] if rules.if_fails == "stop" else [f"if-fails={rules.if_fails}"]
    texts += [f"until={local_time(rules.until_utc)}"] if rules.until_utc else []
    needs = [f"needs {kind}, at most {age_text(age_s, ' old')}" for kind, age_s in rules.needs.items()]
    return [*texts, *needs]


ENTRIES: Final[Sequence[Column[EntryRow]]] = (
    Column("id", lambda entry: entry.id, right=True),
    Column("state", lambda entry: entry.state),
    Column("sequence", lambda entry: clean(_short(entry.sequence))),
    Column("begun", lambda entry: entry.begun_text),
    Column("ends", lambda entry: entry.ends_text),
    Column("options", lambda entry: entry.options_text),
)


@dataclass(frozen=True, slots=True)
class QueueList:
    """The entries of the queue: completed ones, then the others in order.

    Attributes:
        run_by: The process that runs the queue, or None.
        paused: Whether no further entry is started.
    """

    entries: Sequence[EntryRow]
    run_by: str | None
    paused: bool

    @classmethod
    def of(cls, queue: Queue) -> QueueList:
        """Read the queue from its files.

        Raises:
            RecordingError: An entry is damaged.
        """
        entries, holder = queue.entries(), queue.holder()
        expected = expected_ends(entries)
        rows = [EntryRow.of(entry, expected) for entry in [*queue.done(NIGHT), *entries]]
        return cls(rows, None if holder is None else str(holder), queue.is_paused)

    def as_text(self) -> list[str]:
        """A row per entry, notes on some of them, and the state of the queue."""
        lines = table(self.entries, ENTRIES) if self.entries else ["the queue is empty"]
        notes = [note for entry in self.entries for note in entry.notes]
        state = [] if self.run_by is None else [f"run by: {self.run_by}"]
        state += ["paused: 'labseq queue pause --off' continues it"] if self.paused else []
        return [*lines, *([""] if notes else []), *notes, *([""] if state else []), *state]


def list_entries(*, as_json: bool) -> None:
    """Print the entries of the queue, in order."""
    print_report(QueueList.of(Queue(data_root())), as_json=as_json)


def outcome_lines(queue: Queue, within: timedelta) -> list[str]:
    """What became of the entries in this time while the queue was run, and what still waits."""
    entries = queue.entries()
    lines = [f"queue: {plural(len(queue.done(within)), 'run')} complete"]
    for state in ("failed", "stopped", "interrupted", "skipped", "waiting"):
        some = [entry for entry in entries if entry.state == state]
        if some:
            names = ", ".join(f"{entry.id} {clean(entry.sequence.stem)}" for entry in some)
            lines.append(f"queue: {len(some)} {state}: {names}")
            if state == "waiting":
                lines.append("queue: 'labseq queue run' continues, with --keep-going also after a failure")
    return lines


def _short(path: Path) -> str:
    """The path relative to the current folder if it is below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
