"""The runs in a data folder: settings and results of each, found without opening its shots."""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any, Final, NamedTuple

from labseq import __version__
from labseq.data.entry import RunEntry
from labseq.data.numbers import Parameter, Result
from labseq.errors import ConfigError, Problem
from labseq.files import cache_root, data_root
from labseq.messages import clean
from labseq.recording.folders import INDEX_FILE, RESULTS_FOLDER
from labseq.recording.listing import newest_first

SETTLED_S: Final = 2.0
"""A run whose files changed within this time is not cached: another change could get the same time."""


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

    Runs are read one at a time: ``next(labseq.runs(sequence="lifetime"))`` reads no older ones.

    Args:
        folder: The data folder. Default LABSEQ_DATA or ``./data``.
        since: First day, "2026-11-20" or a date.
        until: Last day.
        sequence: Name of the sequence, or of its file.
        tag: A tag.
        status: "running", "complete", "stopped", "failed" or "damaged".
        search: Words to look for in names, note, tags, status, scanned addresses, changes and results.
        where: Conditions on results, changed settings and numbers of shots: "decay > 2 s", "shots >= 100".

    Raises:
        ConfigError: There is no such folder, or a condition cannot be read.

    Example:
        ``pandas.DataFrame(labseq.runs(since="2026-11-01", tag="lifetime"))`` is a table of the runs.
    """
    root = data_root() if folder is None else Path(folder).expanduser()
    if folder is not None and not root.is_dir():
        raise ConfigError(Problem("there is no such folder", clean(str(root)), hint="give a data folder"))
    first, last = _day("since", since), _day("until", until)
    conditions = [_condition(one) for one in where]
    names = ((day, name) for day, name in newest_first(root) if first <= day and (not last or day <= last))
    return (
        entry
        for entry in entries(root, names, search.lower().split())
        if sequence.lower() in ("", entry.name.lower(), entry.sequence.lower())
        and (not tag or tag in entry.tags)
        and status in ("", entry.status)
        and all(meets(entry) for meets in conditions)
    )


def _day(name: str, day: str | date) -> str:
    try:
        return date.fromisoformat(str(day)).isoformat() if day else ""
    except ValueError:
        expected = "a date, for example 2026-11-20"
        raise ConfigError(Problem(f"'{clean(str(day))}' is not a date", name, expected=expected)) from None


def _condition(text: str) -> Callable[[RunEntry], bool]:
    """A condition on a run. A run without the named value does not meet it."""
    from labseq.data.conditions import Condition  # with numpy, which a list without conditions does not load

    condition = Condition.of(text)

    def meets(entry: RunEntry) -> bool:
        value = entry.values.get(condition.name)
        if value is None:
            return False
        is_text = not isinstance(value, int | float)
        return condition.of_texts()(str(value)) if is_text else condition.of_numbers()(value)

    return meets


class Kept(NamedTuple):
    """What the cache holds for a run: state of its files, the text to search, and its entry as JSON."""

    stamp: str
    text: str
    entry: str


def entries(root: Path, names: Iterable[tuple[str, str]], words: Sequence[str] = ()) -> Generator[RunEntry]:
    """The entries of runs in a data folder. They are cached until the runs' files change.

    The cache is a file in the user's cache folder, which may be deleted at any time. Count up the number in
    the name of its table when the meaning of a cached value changes.

    Args:
        names: Day and name of each run.
        words: Only entries whose text contains all of these words, in lower case.
    """
    connection, new = _connected(root), dict[str, Kept]()
    kept_day, kept = "", dict[str, Kept]()
    try:
        for day, name in names:
            if day != kept_day:
                kept_day, kept = day, _kept(connection, day)
            folder, key = f"{root}/{day}/{name}", f"{day}/{name}"
            stamp, before, entry = _stamp(folder), kept.get(key), None
            if before is not None and before.stamp == stamp:
                if not _contains(before.text, words):
                    continue
                entry = _decoded(folder, before.entry)
            if entry is None:
                from labseq.data.described import read_entry  # with numpy, which kept entries do without

                entry = read_entry(Path(folder))
                # a run in progress may die, which changes none of its files
                if stamp and entry.status != "running":
                    new[key] = Kept(stamp, entry.text, json.dumps({**asdict(entry), "path": ""}))
            if _contains(entry.text, words):
                yield entry
    finally:
        _keep(connection, new)


def _contains(text: str, words: Sequence[str]) -> bool:
    return all(word in text for word in words)


def _stamp(folder: str) -> str:
    """The times of files that can change in a run that has ended. "" if a change is too recent.

    Whole files, such as STATE and the notes, are replaced, which changes the time of the folder. Lines are
    added to the index when a run is resumed, and to results when it is analysed again.
    """
    results = f"{folder}/{RESULTS_FOLDER}"
    states = [_changed(folder), _changed(f"{folder}/{INDEX_FILE}"), _changed(results)]
    if states[2]:
        with suppress(OSError):
            states += sorted(_changed(entry.path) for entry in os.scandir(results))
    newest = max(states)
    is_settled = newest and time.time() - newest[0] / 1e9 >= SETTLED_S
    return f"{__version__} {states}" if is_settled else ""


def _changed(path: str) -> tuple[int, ...]:
    """When a file or folder was changed, in ns, and its size. Empty if it does not exist."""
    try:
        about = os.stat(path)  # noqa: PTH116 - making paths would take most of the time
    except OSError:
        return ()
    return about.st_mtime_ns, about.st_size


def _decoded(folder: str, text: str) -> RunEntry | None:
    """A cached entry. None if it cannot be read."""
    try:
        values: dict[str, Any] = json.loads(text)
        results = [Result(one["name"], Parameter(**one["value"]), one["at"]) for one in values["results"]]
        values |= {"path": Path(folder), "results": tuple(results), "tags": tuple(values["tags"])}
        return RunEntry(**values)
    except (ValueError, TypeError, LookupError):
        return None


def _connected(root: Path) -> sqlite3.Connection | None:
    """The cache of a data folder. None without a home folder, space or permission."""
    digest = hashlib.sha256(str(root.resolve()).encode("utf-8", "surrogateescape")).hexdigest()
    columns = "name text primary key, stamp text, text text, entry text"
    with suppress(RuntimeError, OSError, sqlite3.OperationalError):
        file = cache_root() / "runs" / f"{digest[:16]}.sqlite"
        file.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(file, isolation_level=None)
        try:
            connection.execute("pragma synchronous = off")  # after a power cut the runs are read again
            connection.execute(f"create table if not exists runs_3 ({columns})")
            return connection
        except sqlite3.DatabaseError as error:
            connection.close()
            if not isinstance(error, sqlite3.OperationalError):  # it is damaged, the next list makes it again
                file.unlink()
    return None


def _kept(connection: sqlite3.Connection | None, day: str) -> dict[str, Kept]:
    """The cached entries of the runs of a day, by day and name."""
    with suppress(sqlite3.Error):
        if connection is not None:
            of_day = "select * from runs_3 where name >= ? and name < ?"  # "0" is the character after "/"
            rows = connection.execute(of_day, (f"{day}/", f"{day}0")).fetchall()
            return {name: Kept(*columns) for name, *columns in rows}
    return {}


def _keep(connection: sqlite3.Connection | None, new: Mapping[str, Kept]) -> None:
    """Store new entries and close the cache. Entries that cannot be stored are read again next time."""
    if connection is None:
        return
    with suppress(sqlite3.Error), closing(connection):
        if new:
            connection.execute("begin")
            rows = [(name, *kept) for name, kept in new.items()]
            connection.executemany("insert or replace into runs_3 values (?, ?, ?, ?)", rows)
            connection.execute("commit")
