"""`labseq doctor` and `labseq export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

from labseq.analysis.campaigns import campaign_in, export_campaign
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.console.output import as_line, say
from labseq.console.runs import chosen_run, existing_run
from labseq.console.text import columns, plural
from labseq.data import Run
from labseq.data.export import ENDINGS, check_export, export_run, files_of, write_columns
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import explained
from labseq.messages import visible
from labseq.recording import data_root
from labseq.recording.doctor import Report, examine as find_damage

MAX_ROWS: Final = 200
"""Maximum number of findings that are printed."""


def examine(data: Path | None, *, dry_run: bool, as_json: bool) -> int:
    """Find damage, repair it where possible, and print the findings.

    Returns:
        The exit code: 1 if damage is left, else 0.
    """
    root = data_root() if data is None else data.expanduser()
    if not root.is_dir():
        if data is None:
            hint = "give a data folder or a run, or set LABSEQ_DATA"
            raise ConfigError(Problem("there is no such folder", visible(str(root)), hint=hint))
        root = existing_run(data)
    report = find_damage(root, dry_run=dry_run)
    if as_json:
        say(as_line(_as_values(report)))
    else:
        say(*table(report, root, dry_run=dry_run), *summary(report, dry_run=dry_run))
    return RecordingError.exit_code if any(one.left for one in report.findings) else 0


def table(report: Report, root: Path, *, dry_run: bool) -> list[str]:
    """A row per finding, and an empty line; nothing without findings."""
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
    """The number of runs and shots checked, and the result."""
    lines = [f"{plural(report.n_runs, 'run')} checked, {plural(report.n_shots, 'shot')} intact"]
    if report.in_progress:
        lines.append(f"{plural(len(report.in_progress), 'run')} in progress not checked")
    n_left = sum(one.left for one in report.findings)
    if not report.findings:
        lines.append("no damage found")
    elif dry_run:
        lines.append(f"{plural(len(report.findings), 'defect')} found; nothing was changed")
    else:
        n_done = len(report.findings) - n_left
        lines.append(f"{plural(len(report.findings), 'defect')} found: {n_done} repaired, {n_left} left")
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


def export_to(run: Path | None, kind: str | None, output: Path | None, *, frames: bool, replace: bool) -> int:
    """Export a run or a campaign, and print the names of the files.

    Returns:
        The exit code: 1 if shots are missing in the file.
    """
    folder = campaign_in(run)
    if folder is not None:
        if kind not in (None, "netcdf"):
            what = f"a campaign cannot be exported as '{visible(kind)}'"
            raise ConfigError(Problem(what, "--to", expected="netcdf"))
        path = output or Path(f"{folder.resolve().name}.nc")
        check_export("netcdf", path, frames=frames, replace=replace)
        export_campaign(folder, path)
        return 0
    kind = kind or "csv"
    if output is not None:
        check_export(kind, output, frames=frames, replace=replace)
    opened = chosen_run(run)
    path = output or Path(f"{opened.path.parent.name}_{opened.path.name}{ENDINGS.get(kind, '')}")
    check_export(kind, path, frames=frames, replace=replace)
    left_out = export_run(opened, kind, path, frames=frames)
    for line in (*state_lines(opened), *(f"left out: {text}" for text in left_out)):
        say(f"warning: {line}", stream=sys.stderr)
    for file in files_of(kind, path):
        say(f"written: {file}")
    return RecordingError.exit_code if left_out else 0


def export_points(
    run: Path | None, kind: str, output: Path | None, request: ScanRequest, *, replace: bool
) -> None:
    """Write a CSV file with a row for each point of a scan, and print its name."""
    if kind != "csv":
        what = f"the points of a scan cannot be exported as '{visible(kind)}'"
        raise ConfigError(Problem(what, "--to", expected="csv"))
    opened = chosen_run(run)
    path = output or Path(f"{opened.path.parent.name}_{opened.path.name}.points.csv")
    check_export(kind, path, replace=replace)
    report = scan_report(opened, request)
    with explained(path):
        write_columns(path, report.columns(opened.units))
    for file in files_of(kind, path):
        say(f"written: {file}")


def state_lines(run: Run) -> list[str]:
    """Notes for the user about a run that did not complete."""
    shots = f"{plural(len(run.shots), 'shot')} of {run.n_shots}"
    if run.status == "running":
        return [f"the run is still in progress; exported are the {shots} taken so far"]
    lines = (
        [] if run.status == "complete" else [f"the run did not complete ({run.status}); exported are {shots}"]
    )
    if run.n_damaged_lines:
        damaged = plural(run.n_damaged_lines, "line")
        lines.append(f"{damaged} of the index cannot be read; see labseq doctor")
    return lines
