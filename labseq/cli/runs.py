"""`labseq runs` and `labseq note`: list the runs in a data folder, and write notes about them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeGuard

from labseq.console.output import say
from labseq.console.report import Column, aligned, print_report, table
from labseq.console.runs import folder_of_run
from labseq.console.text import plural
from labseq.data.catalogue import runs
from labseq.data.entry import RunEntry
from labseq.errors import ConfigError, Problem, one_of
from labseq.messages import clean, visible
from labseq.recording import data_root
from labseq.recording.notes import Notes, read_notes, write_notes


@dataclass(frozen=True, slots=True)
class RunQuery:
    """The conditions for a list of runs, see :func:`labseq.data.catalogue.runs`.

    Attributes:
        conditions: Arguments of that function.
        sort: Name of the result or other value to sort by, with "-" before it from the
            greatest to the least. "" sorts by time.
        limit: Maximum number of runs.
    """

    conditions: Mapping[str, Any]
    sort: str = ""
    limit: int = 20


COLUMNS: Final[Sequence[Column[RunEntry]]] = (
    Column("run", lambda run: visible(run.number)),
    Column("began", lambda run: _local_time(run.t_start_utc)),
    Column("name", lambda run: visible(run.name or run.path.name)),
    Column("scanned", lambda run: clean(run.scanned_text) or "-"),
    Column("measured", lambda run: clean(str(run.results[0])) if run.results else "-"),
    Column("shots", lambda run: "-" if run.shots is None else _shots(run), right=True),
    Column("state", lambda run: run.status),
    Column("note", lambda run: clean(_note(run))),
)


def _note(run: RunEntry) -> str:
    """Tags and note. For a failed run also the reason, without the name of the error."""
    why = "(" + re.sub(r"^[A-Z]\w*: ", "", run.error) + ")" if run.status == "failed" else ""
    return " ".join(text for text in (*(f"[{tag}]" for tag in run.tags), run.note, why) if text)


def _shots(run: RunEntry) -> str:
    return f"{run.shots} of {run.n_shots}"


@dataclass(frozen=True, slots=True)
class RunList:
    """The requested runs of a data folder, in the order in which they are printed.

    Attributes:
        folder: The data folder.
        runs: The runs.
        has_more: Whether the limit has left out other runs.
    """

    folder: Path
    runs: Sequence[RunEntry]
    has_more: bool

    def as_json(self) -> dict[str, Any]:
        """The runs with their names."""
        listed = [
            {
                "run": run.id,
                "number": run.number,
                **asdict(run),
                "results": [_plain(one) for one in run.results],
            }
            for run in self.runs
        ]
        return {"folder": self.folder, "has_more": self.has_more, "runs": listed}

    def as_text(self) -> list[str]:
        """A row per run, and how many are damaged or not listed."""
        if not self.runs:
            return [f"no such runs in {visible(str(self.folder))}"]
        lines = table(self.runs, COLUMNS)
        if n_damaged := sum(run.status == "damaged" for run in self.runs):
            lines += ["", f"{plural(n_damaged, 'run')} cannot be read; `labseq doctor` says why"]
        return [*lines, *(["", "there are more runs; give --limit N to list N"] if self.has_more else [])]


def _plain(result: Any) -> dict[str, Any]:
    return {"name": result.name, **result.value.as_json(), "at": result.at}


def list_runs(data: Path | None, query: RunQuery, *, as_json: bool) -> None:
    """Print a row for each of the newest runs that meet the conditions, the newest last or sorted.

    Raises:
        ConfigError: There is no such folder, a condition cannot be read, or no run has the value to sort by.
    """
    matching = runs(data, **query.conditions)
    listed = sorted_by(query.sort, [*matching]) if query.sort else matching
    newest = [*islice(listed, query.limit + 1)]
    shown = newest[: query.limit][::-1]
    print_report(RunList(data or data_root(), shown, len(newest) > query.limit), as_json=as_json)


def sorted_by(name: str, found: Sequence[RunEntry]) -> list[RunEntry]:
    """The runs that have a value, the greatest first, or the least first if its name begins with "-".

    Raises:
        ConfigError: None has it.
    """
    key, is_reversed = name.removeprefix("-"), name.startswith("-")
    with_value = [(value, run) for run in found if _is_number(value := run.values.get(key))]
    if found and not with_value:
        known = sorted({name for run in found for name, value in run.values.items() if _is_number(value)})
        raise ConfigError(
            Problem(f"none of the runs has a value '{clean(key)}'", "--sort", expected=one_of(known))
        )
    return [run for _, run in sorted(with_value, key=lambda pair: pair[0], reverse=not is_reversed)]


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not math.isnan(value)


def _local_time(t_utc: str) -> str:
    """The time of day on this computer. The run's name has the date."""
    try:
        return f"{datetime.fromisoformat(t_utc).astimezone():%H:%M}"
    except (ValueError, OverflowError):
        return "-"


def write_note(path: Path, text: str | None, tags: Sequence[str], untag: Sequence[str]) -> None:
    """Replace the note of a run unless it is None, add and remove tags, and print the new note and tags.

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
