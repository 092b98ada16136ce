"""``labseq doctor``: what crashes and faulty disks did to recorded data."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from labseq.cli.output import columns, say
from labseq.cli.show import as_line
from labseq.cli.words import plural
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.recording import data_root
from labseq.recording.doctor import Report, examine as look_for_damage

MAX_ROWS: Final = 200
"""Findings that are told; of more only how many there are."""


def examine(data: Path | None, *, dry_run: bool, as_json: bool) -> int:
    """Look for damage, repair what can be repaired, and print what was found.

    Args:
        data: A data folder or a run's; None for LABSEQ_DATA or ./data.
        dry_run: Whether to change nothing.
        as_json: Whether to print one line of JSON instead of a table.

    Returns:
        The exit code: 0 if nothing is left that is wrong, else 1.

    Raises:
        ConfigError: There is no such folder.
        RecordingError: It cannot be read.
    """
    root = data_root() if data is None else data.expanduser()
    if not root.is_dir():
        hint = "give a data folder or a run's folder, or set LABSEQ_DATA"
        raise ConfigError(Problem("there is no such folder", visible(str(root)), hint=hint))
    report = look_for_damage(root, dry_run=dry_run)
    if as_json:
        say(as_line(_as_values(report)))
    else:
        say(*table(report, root, dry_run=dry_run), *summary(report, dry_run=dry_run))
    return RecordingError.exit_code if any(one.left for one in report.findings) else 0


def table(report: Report, root: Path, *, dry_run: bool) -> list[str]:
    """A row per finding, and an empty line; nothing if all is well."""
    if not report.findings:
        return []
    shown = report.findings[:MAX_ROWS]
    rows = [
        ("what", "where", "to do" if dry_run else "done"),
        *((visible(one.what), visible(_shown(one.where, root)), visible(one.done)) for one in shown),
    ]
    n_more = len(report.findings) - MAX_ROWS
    return [*columns(rows), *([f"and {n_more} more"] if n_more > 0 else []), ""]


def summary(report: Report, *, dry_run: bool) -> list[str]:
    """What was looked at, and what came of it."""
    lines = [f"{plural(report.n_runs, 'run')} looked at, {plural(report.n_shots, 'shot')} whole"]
    if report.in_progress:
        lines.append(f"{plural(len(report.in_progress), 'run')} in progress left alone")
    n_left = sum(one.left for one in report.findings)
    if not report.findings:
        lines.append("nothing is wrong")
    elif dry_run:
        lines.append(f"{plural(len(report.findings), 'thing')} wrong; nothing was changed")
    else:
        n_done = len(report.findings) - n_left
        lines.append(f"{plural(len(report.findings), 'thing')} wrong: {n_done} put right, {n_left} left")
    return lines


def _shown(path: Path, root: Path) -> str:
    try:
        return str(path.relative_to(root.absolute())) if path != root.absolute() else path.name
    except ValueError:
        return str(path)


def _as_values(report: Report) -> dict[str, Any]:
    findings = [
        {"what": one.what, "where": str(one.where), "done": one.done, "left": one.left}
        for one in report.findings
    ]
    return {
        "runs": report.n_runs,
        "shots": report.n_shots,
        "in_progress": [str(path) for path in report.in_progress],
        "findings": findings,
    }
