"""``labseq show``: what a run has recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.cli.failures import lines_of
from labseq.cli.output import columns, say
from labseq.cli.show_skipped import json_skipped, skipped_rows
from labseq.cli.show_tables import (
    devices_table,
    json_devices,
    json_shots,
    json_timing,
    shot_time_s,
    shots_table,
    timing_table,
)
from labseq.cli.statistics import counted_text, cycle_table, share_text, statistics_rows
from labseq.cli.telling import outcome
from labseq.cli.words import percent, plural
from labseq.config.wording import clean
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.recording import Run, Shot, data_root, open_run
from labseq.recording.folders import find_run
from labseq.recording.plain import to_plain
from labseq.recording.points import scan_points
from labseq.recording.statistics import statistics_of
from labseq.units import format_quantity

MAX_ROWS: Final = 40
"""Rows of a table; of a longer one the first and the last are shown."""


@dataclass(frozen=True, slots=True)
class Tables:
    """Which tables are wanted; the summary if none is."""

    shots: bool = False
    timing: bool = False
    scan: bool = False
    devices: bool = False

    @property
    def any(self) -> bool:
        """Whether one is."""
        return self.shots or self.timing or self.scan or self.devices


def show_run(path: Path | None, *, as_json: bool, tables: Tables | None = None) -> None:
    """Print what a run has recorded.

    Args:
        path: The run's folder or any file in it; None for the newest run.
        as_json: Whether to print one line of JSON instead.
        tables: Which tables to print instead of the summary.

    Raises:
        ConfigError: There is no such run, or it has not what a table is to show.
        RecordingError: It is damaged.
    """
    wanted = tables or Tables()
    try:
        run = chosen_run(path)
        values = (_json_tables(run, wanted) if wanted.any else json_summary(run)) if as_json else {}
    except LabseqError as error:
        if as_json:
            say(as_line(json_summary(None) | {"error": "\n".join(lines_of(error))}))
        raise
    if as_json:
        say(as_line(values))
    elif wanted.any:
        say(*_output_lines(run, wanted))
    else:
        say(*shot_table(run), "", *summary_lines(run))


def _output_lines(run: Run, wanted: Tables) -> list[str]:
    """The tables that are wanted, with an empty line between them."""
    found: list[list[str]] = []
    if wanted.shots:
        found.append(shots_table(run))
    if wanted.timing:
        found.append(timing_table(run))
    if wanted.scan:
        found.append(_points(run))
    if wanted.devices:
        found.append(devices_table(run))
    return [line for table in found for line in ("", *table)][1:]


def _points(run: Run) -> list[str]:
    lines = point_table(run, whole=True)
    if not lines and run.skipped and run.record.get("scan"):
        return [f"no point of the scan has a shot: {len(run.skipped)} of {run.n_shots} were skipped"]
    if not lines:
        what = "the run has no scan" if not run.record.get("scan") else "the scan has no shots yet"
        raise ConfigError(Problem(what, clean(str(run.path)), expected="a run of a sequence with 'scan:'"))
    return lines


def _json_tables(run: Run, wanted: Tables) -> dict[str, Any]:
    values: dict[str, Any] = {"run_dir": str(run.path), "status": run.status}
    if wanted.shots:
        values["shot_list"] = json_shots(run)
    if wanted.timing:
        values["timing"] = json_timing(run)
    if wanted.scan:
        _points(run)
        values["points"] = _json_points(run)
    if wanted.devices:
        values["devices"] = json_devices(run)
    return values


def chosen_run(path: Path | None) -> Run:
    """Open the run that a command is given.

    Args:
        path: The run's folder or any file in it; None for the newest run.

    Raises:
        ConfigError: There is no such run: a mistake of the user, not of the data.
        RecordingError: It is damaged.
    """
    return open_run(newest_run(data_root()) if path is None else existing(path))


def existing(path: Path) -> Path:
    """The folder of the run that a command is given.

    Raises:
        ConfigError: There is no such run: a mistake of the user, not of the data.
    """
    try:
        return find_run(path)
    except RecordingError as error:
        raise ConfigError(str(error)) from error
    except OSError as error:
        reason = str(error.strerror or error).lower()
        raise ConfigError(Problem(f"the folder cannot be read: {reason}", clean(str(path)))) from error


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last: newest day, highest counter.

    Raises:
        ConfigError: There is none.
    """
    folders = [file.parent for file in root.glob("*-*-*/*_*/run.json")]
    if not folders:
        raise ConfigError(f"{root} holds no runs; give a run's folder, or set LABSEQ_DATA")
    return max(folders, key=lambda folder: (folder.parent.name, _counter(folder)))


def _counter(folder: Path) -> int:
    number = folder.name.partition("_")[0]
    return int(number) if number.isdecimal() else -1


def json_summary(run: Run | None) -> dict[str, Any]:
    """What ``--json`` prints; for None, what is true of a run that never came to be."""
    if run is None:
        nothing = {"defect_free": None, "filling_fraction": None}
        return {"run_dir": None, "shots": 0, **nothing, "status": "failed"}
    values = run.summary() | {"statistics": statistics_of(run.shots, run.target).as_dict()}
    if points := _json_points(run):
        values["points"] = points
    if run.skipped:
        values["skipped_shots"] = json_skipped(run)
    return values | ({"error": run.error} if run.error else {})


def _json_points(run: Run) -> list[dict[str, Any]]:
    points = [(point, statistics_of(point.shots, run.target)) for point in scan_points(run)]
    return [
        {
            "parameters": dict(point.parameters),
            "shots": len(point.shots),
            "defect_free": to_plain(statistics.defect_free.value),
            "filling_fraction": to_plain(statistics.filling.value),
            "statistics": statistics.as_dict(),
        }
        for point, statistics in points
    ]


def as_line(values: Mapping[str, Any]) -> str:
    """JSON on one line, in ASCII, whatever the terminal can show."""
    return json.dumps(values)


def point_table(run: Run, *, whole: bool = False) -> list[str]:
    """A table of the scan's points; nothing without a scan.

    Where no shot is judged, the images that ended the last cycles are.

    Args:
        run: The run.
        whole: Whether a long table is shown in full.
    """
    points = [(point, statistics_of(point.shots, run.target)) for point in scan_points(run)]
    if not points:
        return []
    judged = any(statistics.defect_free.n_trials for _, statistics in points)
    rows: list[tuple[str, ...]] = []
    for point, statistics in points:
        shown = statistics if judged or not statistics.cycles else statistics.cycles[-1]
        written = map(clean, point.written.values())
        n_shots = str(len(point.shots))
        rows.append((*written, n_shots, share_text(shown.filling), counted_text(shown.defect_free)))
    names = ("filling", "defect-free")
    last = names if judged else tuple(f"{name}, last cycle" for name in names)
    header = (*map(clean, points[0][0].written), "shots", *last)
    lines = columns([header, *rows], right=tuple(range(len(header) - 1)))
    return lines if whole else _shortened(lines)


def _shortened(lines: list[str]) -> list[str]:
    """The first and the last rows of a long table."""
    if len(lines) - 1 <= MAX_ROWS:
        return lines
    half = MAX_ROWS // 2
    return [*lines[: half + 1], "...", *lines[-half:]]


def shot_table(run: Run) -> list[str]:
    """A table of the shots that count."""
    n_atoms = run.target.n_atoms
    rows = [_shot_row(shot, n_atoms) for shot in run.shots]
    header = ("shot", "outcome", "filling", "cycles", "atom moves", "shot time")
    return _shortened(columns([header, *rows], right=(0, 2, 3, 4, 5)))


def _shot_row(shot: Shot, n_atoms: int) -> tuple[str, ...]:
    row, duration_s = shot.row, shot_time_s(shot)
    return (
        str(shot.index + 1),
        outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, n_atoms),
        percent(shot.filling_fraction),
        str(row.get("n_cycles", "-")),
        str(row.get("n_atom_moves", "-")),
        format_quantity(duration_s, "time") if duration_s else "-",
    )


def summary_lines(run: Run) -> list[str]:
    """What came of the run: a table of its points or cycles, and the whole of it in a few lines."""
    statistics = statistics_of(run.shots, run.target)
    table = point_table(run) or cycle_table(statistics)
    rows = [
        ("run", str(run.path)),
        ("status", f"{run.status}: {run.error}" if run.status == "failed" else run.status),
        ("shots", f"{len(run.shots)} of {run.n_shots}" + _skipped(run) + _repeated(run)),
        *skipped_rows(run),
        *statistics_rows(statistics),
        ("duration", _duration(run)),
    ]
    if run.n_damaged_lines:
        rows.append(("warning", f"{plural(run.n_damaged_lines, 'line')} of the index cannot be read"))
    return [*table, *([""] if table else []), *columns(rows)]


def _repeated(run: Run) -> str:
    return f", {plural(len(run.attempts), 'attempt')} kept that did not complete" if run.attempts else ""


def _skipped(run: Run) -> str:
    return f", {len(run.skipped)} skipped" if run.skipped else ""


def _duration(run: Run) -> str:
    """From the start of the run to the end of its last shot, on the clock on the wall."""
    ends = [str(shot.row.get("t_end_utc") or "") for shot in (*run.shots, *run.attempts)]
    try:
        start = datetime.fromisoformat(str(run.record["t_start_utc"]))
        duration = max(datetime.fromisoformat(text) for text in ends if text) - start
    except (KeyError, ValueError, TypeError):  # no shots, or a damaged index
        return "-"
    return format_quantity(duration.total_seconds(), "time")
