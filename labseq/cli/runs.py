"""`labseq runs`: the runs in a data folder, from run.json, STATE and the index of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.console.output import say
from labseq.console.report import Column, aligned, print_report, table
from labseq.console.runs import folder_of_run
from labseq.console.text import plural
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean, visible
from labseq.recording import data_root
from labseq.recording.index import read_index
from labseq.recording.listing import runs_in
from labseq.recording.notes import Notes, read_notes, write_notes
from labseq.recording.run_file import read_run, read_state
from labseq.units import size_text


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run in a data folder; of a damaged one only its name and the error are known."""

    run: str
    run_dir: Path
    t_start_utc: str | None = None
    sequence: str | None = None
    profile: str | None = None
    shots: int | None = None
    n_shots: int | None = None
    status: str = "damaged"
    error: str | None = None
    simulated: bool | None = None
    seed: int | None = None
    bytes: int | None = None

    @classmethod
    def of(cls, folder: Path) -> RunRow:
        """What the files of a run say."""
        row = cls(_id(folder), folder)
        try:
            record, (status, error) = read_run(folder), read_state(folder)
            index = read_index(folder)[0]
        except (RecordingError, OSError) as failure:
            return replace(row, error=str(failure))
        resolved: Any = record.get("resolved")
        profile = resolved.get("profile") if isinstance(resolved, dict) else None
        return replace(
            row,
            t_start_utc=record.get("t_start_utc"),
            sequence=record["name"],
            profile=profile.get("name") if isinstance(profile, dict) else None,
            shots=len({shot.shot for shot in index if shot.counts}),
            n_shots=record["n_shots"],
            status=status,
            error=error,
            simulated=record["simulated"],
            seed=record["seed"],
            bytes=sum(shot.bytes for shot in index),
        )


COLUMNS: Final[Sequence[Column[RunRow]]] = (
    Column("run", lambda run: visible(run.run)),
    Column("started", lambda run: _local_time(run.t_start_utc)),
    Column("profile", lambda run: visible(str(run.profile or "-"))),
    Column("shots", lambda run: "-" if run.shots is None else f"{run.shots} of {run.n_shots}", right=True),
    Column("status", lambda run: run.status),
    Column("hardware", lambda run: {None: "-", True: "simulated", False: "real"}[run.simulated]),
    Column("seed", lambda run: "-" if run.seed is None else run.seed, right=True),
    Column("size", lambda run: "-" if run.bytes is None else size_text(run.bytes), right=True),
)


@dataclass(frozen=True, slots=True)
class RunList:
    """The newest runs in a data folder, the newest last.

    Attributes:
        folder: The data folder.
        name: Part of the names that was asked for; "" for all runs.
        n_runs: Number of all of these runs.
        runs: The newest of them.
    """

    folder: Path
    name: str
    n_runs: int
    runs: tuple[RunRow, ...]

    def as_text(self) -> list[str]:
        """A row per run, and how many are damaged or not listed."""
        if not self.runs:
            named = f" with {visible(self.name)!r} in their name" if self.name else ""
            return [f"no runs{named} in {visible(str(self.folder))}"]
        lines = table(self.runs, COLUMNS)
        if n_damaged := sum(run.status == "damaged" for run in self.runs):
            lines += ["", f"{plural(n_damaged, 'run')} cannot be read: `labseq doctor` says why"]
        if self.n_runs > len(self.runs):
            lines += ["", f"the newest of {plural(self.n_runs, 'run')}; --limit {self.n_runs} lists all"]
        return lines


def list_runs(data: Path | None, name: str, limit: int, *, as_json: bool) -> None:
    """Print a row for each of the newest runs, the newest last.

    Raises:
        ConfigError: There is no such folder.
    """
    root = data_root() if data is None else data.expanduser()
    if data is not None and not root.is_dir():
        raise ConfigError(Problem("there is no such folder", visible(str(root)), hint="give a data folder"))
    folders = [folder for folder in runs_in(root) if name.lower() in _id(folder).lower()]
    runs = RunList(root, name, len(folders), tuple(map(RunRow.of, folders[-limit:])))
    print_report(runs, as_json=as_json)


def _id(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _local_time(t_utc: Any) -> str:
    """The time of day on this computer; the run's folder has the date."""
    try:
        return f"{datetime.fromisoformat(t_utc).astimezone():%H:%M}"
    except (TypeError, ValueError, OverflowError):
        return "-"


def write_note(path: Path, text: str | None, tags: Sequence[str], untag: Sequence[str]) -> None:
    """Replace the note of a run unless it is None, add and remove tags, and print what it then has.

    Raises:
        ConfigError: There is no such run, it has no such tag, or a text is too long.
        RecordingError: The run's folder cannot be written to.
    """
    folder = folder_of_run(path)
    before = read_notes(folder)
    if unknown := [tag for tag in untag if tag not in before.tags]:
        expected = (
            f"one of {', '.join(map(clean, before.tags))}" if before.tags else "none, as it has no tags"
        )
        raise ConfigError(Problem(f"the run has no tag '{clean(unknown[0])}'", "--untag", expected=expected))
    kept = (tag for tag in before.tags if tag not in untag)
    notes = Notes.of(before.comment if text is None else text, (*kept, *tags))
    if notes != before:
        write_notes(folder, notes)
    tag_text = ", ".join(map(clean, notes.tags)) or "none"
    say(*aligned([("run", clean(str(folder))), ("note", clean(notes.comment) or "none"), ("tags", tag_text)]))
