"""The runs in a data folder: what each was and what it measured, found without opening its shots."""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any, Final

from labseq import __version__
from labseq.data.conditions import Condition
from labseq.data.fits import Parameter
from labseq.data.reader import Run, open_run
from labseq.data.results import Result, results_of
from labseq.data.scanned import scanned
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.files import cache_root, data_root
from labseq.messages import clean
from labseq.recording.folders import INDEX_FILE, NOTES_FILE, RESULTS_FOLDER, RUN_FILE, STATE_FILE
from labseq.recording.listing import counter_of, newest_first
from labseq.recording.notes import read_notes


@dataclass(frozen=True, slots=True)
class RunEntry:
    """A run in a data folder; of a damaged one only its folder, its notes and the error are known.

    Attributes:
        path: The run's folder.
        t_start_utc: When it began, ISO 8601, UTC; "" if unknown.
        name: Name of the sequence.
        sequence: Name of the sequence's file, without folder and ending.
        profile: Name of the hardware profile.
        target: Name of the target.
        status: "running", "complete", "stopped", "failed" or "damaged".
        error: Why it failed or cannot be read.
        simulated: Whether all hardware was simulated.
        seed: Its seed.
        shots: Number of shots that count.
        n_shots: Number of shots that were asked for.
        bytes: Size of the shots' files.
        scanned: Scanned address -> its values in words: "1 ms to 20 ms, 8 values".
        changes: Settings changed by ``--set`` and other options: address -> value, as it was typed.
        settings: The same in SI units.
        calibrations: Kind -> id of the calibrations in use.
        results: What it measured, the most important first.
        note: The note about it.
        tags: Its tags.
    """

    path: Path
    t_start_utc: str = ""
    name: str = ""
    sequence: str = ""
    profile: str = ""
    target: str = ""
    status: str = "damaged"
    error: str = ""
    simulated: bool | None = None
    seed: int | None = None
    shots: int | None = None
    n_shots: int | None = None
    bytes: int | None = None
    scanned: Mapping[str, str] = field(default_factory=dict[str, str])
    changes: Mapping[str, str] = field(default_factory=dict[str, str])
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    calibrations: Mapping[str, str] = field(default_factory=dict[str, str])
    results: Sequence[Result] = ()
    note: str = ""
    tags: Sequence[str] = ()

    @property
    def id(self) -> str:
        """Its whole name: "2026-11-20/0075_lifetime"."""
        return f"{self.path.parent.name}/{self.path.name}"

    @property
    def number(self) -> str:
        """The shortest name that is its own: "2026-11-20/75"."""
        return f"{self.path.parent.name}/{counter_of(self.path.name)}"

    @property
    def values(self) -> dict[str, Any]:
        """Every value that a condition can name: results, settings, "shots", "n_shots"; SI."""
        results = {result.name: result.value.value for result in reversed(self.results)}
        counts = {"shots": self.shots, "n_shots": self.n_shots}
        return {
            name: one for name, one in (counts | dict(self.settings) | results).items() if one is not None
        }

    @property
    def text(self) -> str:
        """What a search looks through: names, notes, settings and results, in lower case."""
        settings = (f"{address}={value}" for address, value in self.changes.items())
        words = (
            self.id,
            self.name,
            self.sequence,
            self.profile,
            self.target,
            self.status,
            self.error,
            self.note,
        )
        results = map(str, self.results)
        return " ".join([*words, *self.tags, *self.scanned, *settings, *results]).lower()

    def open(self) -> Run:
        """Open the run.

        Raises:
            RecordingError: It is damaged.
        """
        return open_run(self.path)


def read_entry(folder: Path) -> RunEntry:
    """Read a run's files."""
    notes = read_notes(folder)
    entry = RunEntry(folder, note=notes.comment, tags=notes.tags)
    try:
        return _described(entry)
    except (RecordingError, OSError) as failure:
        return replace(entry, error=str(failure))


def _described(entry: RunEntry) -> RunEntry:
    run = open_run(entry.path)
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    overrides: Mapping[str, Any] = run.record.get("overrides") or {}
    return replace(
        entry,
        t_start_utc=str(run.record.get("t_start_utc") or ""),
        name=run.name,
        sequence=Path(str(run.record.get("sequence_path") or "")).stem,
        profile=str((resolved.get("profile") or {}).get("name") or ""),
        target="" if run.target.is_none else run.target.name,
        status=run.status,
        error=run.error,
        simulated=run.simulated,
        seed=run.seed,
        shots=len(run.shots),
        n_shots=run.n_shots,
        bytes=sum(shot.row.bytes for shot in (*run.shots, *run.attempts)),
        changes=run.changes,
        settings={address: change.get("value") for address, change in overrides.items()},
        calibrations=run.record.get("calibrations") or {},
        **_measured(run),
    )


def _measured(run: Run) -> dict[str, Any]:
    """What was scanned and measured; a scan or a result that is damaged is left out."""
    values: dict[str, Any] = {}
    with suppress(LabseqError, LookupError, TypeError, ValueError):
        scan = scanned(run)
        axes = () if scan is None else scan.axes
        values["scanned"] = {axis.address: _range_text(axis.labels) for axis in axes}
        values["results"] = tuple(results_of(run))
    return values


def _range_text(labels: Sequence[str]) -> str:
    if len(labels) < 3:
        return " and ".join(labels)
    return f"{labels[0]} to {labels[-1]}, {len(labels)} values"


def runs(
    folder: str | Path | None = None,
    *,
    since: str | date = "",
    until: str | date = "",
    sequence: str = "",
    tag: str = "",
    status: str = "",
    search: str = "",
    where: Sequence[str] = (),
) -> Iterator[RunEntry]:
    """The runs in a data folder that meet all conditions, the newest first.

    A run is looked up when it is its turn: ``next(labseq.runs(sequence="lifetime"))`` reads no older ones.

    Args:
        folder: The data folder; by default LABSEQ_DATA or ``./data``.
        since: First day, "2026-11-20" or a date.
        until: Last day.
        sequence: Name of the sequence, or of its file.
        tag: A tag.
        status: "running", "complete", "stopped", "failed" or "damaged".
        search: Words that names, note, tags, status, scanned addresses, changed settings or results contain.
        where: Conditions on results, changed settings and numbers of shots: "decay > 2 s", "shots >= 100".

    Raises:
        ConfigError: There is no such folder, or a condition cannot be read.

    Example:
        ``pandas.DataFrame(labseq.runs(since="2026-11-01", tag="lifetime"))`` is a table of the runs.
    """
    root = data_root() if folder is None else Path(folder).expanduser()
    if folder is not None and not root.is_dir():
        raise ConfigError(Problem("there is no such folder", clean(str(root)), hint="give a data folder"))
    first, last, words = _day("since", since), _day("until", until), search.lower().split()
    conditions = [_condition(one) for one in where]
    names = ((day, name) for day, name in newest_first(root) if first <= day and (not last or day <= last))
    return (
        entry
        for entry in entries(root, names)
        if sequence.lower() in ("", entry.name.lower(), entry.sequence.lower())
        and (not tag or tag in entry.tags)
        and status in ("", entry.status)
        and all(word in entry.text for word in words)
        and all(meets(entry) for meets in conditions)
    )


def _day(name: str, day: str | date) -> str:
    try:
        return date.fromisoformat(str(day)).isoformat() if day else ""
    except ValueError:
        expected = "a date, for example 2026-11-20"
        raise ConfigError(Problem(f"'{clean(str(day))}' is not a date", name, expected=expected)) from None


def _condition(text: str) -> Callable[[RunEntry], bool]:
    """A condition on a run; a run that has no value of its name does not meet it."""
    condition = Condition.of(text)

    def meets(entry: RunEntry) -> bool:
        value = entry.values.get(condition.name)
        if value is None:
            return False
        is_text = not isinstance(value, int | float)
        return condition.of_texts()(str(value)) if is_text else condition.of_numbers()(value)

    return meets


FORMAT: Final = 1
"""Counted up when what is kept of a run has another meaning; what is kept in another format is not used."""
SETTLED_S: Final = 2.0
"""A run whose files changed within this time is not kept: another change could leave the same time."""

Kept = dict[str, tuple[str, str]]
"""Name of a run's folder -> stamp and entry."""


def entries(root: Path, names: Iterable[tuple[str, str]]) -> Generator[RunEntry]:
    """The entries of runs in a data folder: kept ones, as far as the runs' files have not changed since.

    They are kept in a file in the user's cache, which may be deleted at any time. A run that has ended
    changes only when it is resumed, repaired or analysed, or its notes are written; all of that shows in
    the times of its files.

    Args:
        root: The data folder.
        names: Day and name of each run.
    """
    cache = _cache_file(root)
    kept, new = _read_kept(cache), Kept()
    try:
        for day, name in names:
            folder = f"{root}/{day}/{name}"
            stamp, before = _stamp(folder), kept.get(f"{day}/{name}")
            entry = _decoded(folder, before[1]) if stamp and before and before[0] == stamp else None
            if entry is None:
                entry = read_entry(Path(folder))
                if stamp and entry.status != "running":
                    new[f"{day}/{name}"] = stamp, _encoded(entry)
            yield entry
    finally:
        _keep(cache, new)


def _stamp(folder: str) -> str:
    """The times and sizes of what can change in a run that has ended; "" if a change is too recent."""
    paths = [folder, *(f"{folder}/{name}" for name in (RUN_FILE, STATE_FILE, INDEX_FILE, NOTES_FILE))]
    states = list[tuple[int, int]]()
    with suppress(OSError):  # most runs have no results of analyses
        paths += [entry.path for entry in os.scandir(f"{folder}/{RESULTS_FOLDER}")]
    for path in paths:
        with suppress(OSError):
            about = os.stat(path)  # noqa: PTH116 - making paths would take most of the time
            states.append((about.st_mtime_ns, about.st_size))
    is_recent = time.time() - max(states, default=(0, 0))[0] / 1e9 < SETTLED_S
    return "" if is_recent else f"{FORMAT} {__version__} {states}"


def _encoded(entry: RunEntry) -> str:
    return json.dumps({**asdict(entry), "path": ""})


def _decoded(folder: str, text: str) -> RunEntry | None:
    """A kept entry; None if it cannot be read."""
    try:
        values: dict[str, Any] = json.loads(text)
        results = [Result(one["name"], Parameter(**one["value"]), one["at"]) for one in values["results"]]
        values |= {"path": Path(folder), "results": tuple(results), "tags": tuple(values["tags"])}
        return RunEntry(**values)
    except (ValueError, TypeError, LookupError):
        return None


def _cache_file(root: Path) -> Path | None:
    """The file for a data folder; None for a user without a home."""
    digest = hashlib.sha256(str(root.resolve()).encode("utf-8", "surrogateescape")).hexdigest()
    try:
        return cache_root() / "runs" / f"{digest[:16]}.sqlite"
    except RuntimeError:
        return None


def _read_kept(cache: Path | None) -> Kept:
    if cache is None or not cache.is_file():
        return {}
    try:
        with closing(sqlite3.connect(cache)) as connection:
            return {name: (stamp, entry) for name, stamp, entry in connection.execute("select * from runs")}
    except sqlite3.OperationalError:  # another process writes, or has made the file and not yet the table
        return {}
    except sqlite3.DatabaseError:  # it is damaged
        with suppress(OSError):
            cache.unlink()
        return {}


def _keep(cache: Path | None, new: Kept) -> None:
    """Keep new entries; without a folder, room or permission for them they are read again next time."""
    if cache is None or not new:
        return
    with suppress(OSError, sqlite3.Error):
        cache.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(cache)) as connection, connection:
            connection.execute(
                "create table if not exists runs (name text primary key, stamp text, entry text)"
            )
            rows = [(name, stamp, entry) for name, (stamp, entry) in new.items()]
            connection.executemany("insert or replace into runs values (?, ?, ?)", rows)
