"""`labseq queue`: change the queue, run it, and print it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from labseq.console.errors import exit_code_of, report, warning_lines
from labseq.console.output import say
from labseq.console.text import columns, plural
from labseq.messages import MAX_ERROR, clean, visible
from labseq.plain import dumps
from labseq.queue.queue import Entry, Queue
from labseq.queue.running import Opening, QueueRun, add_checked
from labseq.recording import data_root
from labseq.session.options import Options

_HEADER = ("id", "state", "sequence", "added", "options")


def add_entry(sequence: Path, options: Options) -> None:
    """Check a sequence and add it to the queue."""
    entry, checked = add_checked(Queue(data_root()), sequence, options)
    for warning in checked.warnings:
        say(*warning_lines(warning), stream=sys.stderr)
    say(f"{entry.id}: {clean(str(sequence))}, {plural(checked.n_shots, 'shot')}, with its present text")


def list_entries(*, as_json: bool) -> None:
    """Print the entries of the queue, in order."""
    queue = Queue(data_root())
    entries = queue.entries()
    if as_json:
        say(dumps({"entries": [_as_values(entry) for entry in entries]}))
        return
    holder = queue.holder()
    notes = [note for entry in entries for note in _notes(entry)]
    table = columns([_HEADER, *map(_row, entries)], right=(0,)) if entries else ["the queue is empty"]
    state = [] if holder is None else [f"run by: {holder}"]
    state += ["paused: 'labseq queue pause --off' continues it"] if queue.is_paused else []
    say(*table, *([""] if notes else []), *notes, *([""] if state else []), *state)


def pause_queue(is_paused: bool) -> None:
    """Pause the queue, or continue it, and print that."""
    Queue(data_root()).pause(is_paused)
    paused = "the queue is paused: 'labseq queue pause --off' continues it"
    say(paused if is_paused else "the queue continues")


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
    again = f", resuming {entry.run_dir}" if entry.run_dir is not None else ""
    say(f"queue: {entry.id} {clean(str(entry.sequence))}{again}")


def _row(entry: Entry) -> tuple[str, ...]:
    added = f"{datetime.fromisoformat(entry.added_utc).astimezone():%Y-%m-%d %H:%M}"
    return (
        str(entry.id),
        entry.state,
        clean(_short(entry.sequence)),
        added,
        clean(", ".join(f"{address}={value}" for address, value in entry.options.changes().items())),
    )


def _short(path: Path) -> str:
    """The path relative to the current folder if it is below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _notes(entry: Entry) -> list[str]:
    notes: list[str] = []
    if entry.has_changed and not entry.is_complete:
        what = "was changed or removed since; the queued text will run"
        notes.append(f"{entry.id}: {clean(_short(entry.sequence))} {what}")
    if entry.error:
        notes.append(f"{entry.id}: {visible(entry.error.splitlines()[0][:MAX_ERROR])}")
    if entry.state in {"stopped", "failed"} and entry.run_dir is not None:
        notes.append(f"{entry.id}: labseq resume {visible(str(entry.run_dir))}")
    return notes


def _as_values(entry: Entry) -> dict[str, Any]:
    return {
        "id": entry.id,
        "state": entry.state,
        "sequence": str(entry.sequence),
        "changed": entry.has_changed,
        "added_utc": entry.added_utc,
        "options": {key: str(v) if isinstance(v, Path) else v for key, v in asdict(entry.options).items()},
        "run_dir": None if entry.run_dir is None else str(entry.run_dir),
        "error": entry.error or None,
    }
