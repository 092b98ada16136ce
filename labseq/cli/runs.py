"""`labseq runs`: the runs in a data folder, from run.json, STATE and the index of each."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.console.output import as_line, say
from labseq.console.text import columns, plural, size_text
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import visible
from labseq.recording import data_root
from labseq.recording.folders import runs_in
from labseq.recording.index import read_index
from labseq.recording.run_file import read_run, read_state

_HEADER: Final = ("run", "started", "profile", "shots", "status", "hardware", "seed", "size")


def list_runs(data: Path | None, name: str, limit: int, *, as_json: bool) -> None:
    """Print a row for each of the newest runs, the newest last.

    Raises:
        ConfigError: There is no such folder.
    """
    root = data_root() if data is None else data.expanduser()
    if data is not None and not root.is_dir():
        raise ConfigError(Problem("there is no such folder", visible(str(root)), hint="give a data folder"))
    folders = [folder for folder in runs_in(root) if name.lower() in _id(folder).lower()]
    found = [_about(folder) for folder in folders[-limit:]]
    if as_json:
        say(as_line({"folder": str(root), "n_runs": len(folders), "runs": found}))
    elif not found:
        say(f"no runs{f' with {visible(name)!r} in their name' if name else ''} in {visible(str(root))}")
    else:
        say(*columns([_HEADER, *map(_row, found)], right=(3, 6, 7)))
        n_damaged = sum(about["status"] == "damaged" for about in found)
        if n_damaged:
            say("", f"{plural(n_damaged, 'run')} cannot be read: `labseq doctor` says why")
        if len(folders) > len(found):
            say("", f"the newest of {plural(len(folders), 'run')}; --limit {len(folders)} lists all")


def _id(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _about(folder: Path) -> dict[str, Any]:
    """What is known of a run; the reason, if its files cannot be read."""
    about: dict[str, Any] = {"run": _id(folder), "run_dir": str(folder)}
    try:
        record, (status, error) = read_run(folder), read_state(folder)
        rows = read_index(folder)[0]
    except (RecordingError, OSError) as failure:
        keys = ("t_start_utc", "sequence", "profile", "shots", "n_shots", "simulated", "seed", "bytes")
        return about | dict.fromkeys(keys) | {"status": "damaged", "error": str(failure)}
    resolved: Any = record.get("resolved")
    profile = resolved.get("profile") if isinstance(resolved, dict) else None
    return about | {
        "t_start_utc": record.get("t_start_utc"),
        "sequence": record["name"],
        "profile": profile.get("name") if isinstance(profile, dict) else None,
        "shots": len({row.shot for row in rows if row.counts}),
        "n_shots": record["n_shots"],
        "status": status,
        "error": error,
        "simulated": record["simulated"],
        "seed": record["seed"],
        "bytes": sum(row.bytes for row in rows),
    }


def _row(about: dict[str, Any]) -> tuple[str, ...]:
    if about["n_shots"] is None:
        return visible(about["run"]), "-", "-", "-", about["status"], "-", "-", "-"
    return (
        visible(about["run"]),
        _local_time(about["t_start_utc"]),
        visible(str(about["profile"] or "-")),
        f"{about['shots']} of {about['n_shots']}",
        about["status"],
        "simulated" if about["simulated"] else "real",
        str(about["seed"]),
        size_text(about["bytes"]),
    )


def _local_time(t_utc: Any) -> str:
    """The time of day on this computer; the run's folder has the date."""
    try:
        return f"{datetime.fromisoformat(t_utc).astimezone():%H:%M}"
    except (TypeError, ValueError, OverflowError):
        return "-"
