"""`labseq doctor` and `labseq export`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from labseq.analysis.campaigns import campaign_in, export_campaign
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.console.output import say
from labseq.console.report import Column, print_report, table
from labseq.console.runs import chosen_run, folder_of_run
from labseq.console.text import plural
from labseq.data.export import ENDINGS, check_export, export_run, files_of, write_columns
from labseq.data.reader import Run
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import explained
from labseq.messages import visible
from labseq.recording import data_root
from labseq.recording.doctor import Finding, examine as find_damage

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
        root = folder_of_run(data)
    report = find_damage(root, dry_run=dry_run)
    examined = Examination(
        root,
        dry_run,
        report.n_runs,
        report.n_shots,
        tuple(report.in_progress),
        report.n_in_use,
        tuple(report.findings),
    )
    print_report(examined, as_json=as_json)
    return RecordingError.exit_code if examined.n_left else 0


@dataclass(frozen=True, slots=True)
class Examination:
    """The damage in a folder.

    Attributes:
        folder: The examined data folder or run.
        dry_run: Whether nothing was changed.
        runs: Number of runs that were checked.
        shots: Number of their intact shots.
        in_progress: Runs in progress, which were not checked.
        in_use: Number of the intact shots that another program has open for writing.
        findings: The defects.
    """

    folder: Path
    dry_run: bool
    runs: int
    shots: int
    in_progress: tuple[Path, ...]
    in_use: int
    findings: tuple[Finding, ...]

    @property
    def n_left(self) -> int:
        """Number of defects that remain."""
        return sum(finding.left for finding in self.findings)

    def as_text(self) -> list[str]:
        """A row per finding, the number of runs and shots checked, and the result."""
        lines = [f"{plural(self.runs, 'run')} checked, {plural(self.shots, 'shot')} intact"]
        if self.in_progress:
            lines.append(f"{plural(len(self.in_progress), 'run')} in progress not checked")
        if self.in_use:
            lines.append(f"{plural(self.in_use, 'shot')} of these open for writing in another program")
        n_findings = len(self.findings)
        if not n_findings:
            return [*lines, "no damage found"]
        result = f"{n_findings - self.n_left} repaired, {self.n_left} left"
        defects = f"{plural(n_findings, 'defect')} found"
        lines.append(f"{defects}; nothing was changed" if self.dry_run else f"{defects}: {result}")
        return [*self._findings(), "", *lines]

    def _findings(self) -> list[str]:
        columns: Sequence[Column[Finding]] = (
            Column("what", lambda finding: visible(finding.what)),
            Column("where", lambda finding: visible(_within(finding.where, self.folder))),
            Column("to do" if self.dry_run else "done", lambda finding: visible(finding.done)),
        )
        n_more = len(self.findings) - MAX_ROWS
        rest = [f"and {n_more} more"] if n_more > 0 else []
        return [*table(self.findings[:MAX_ROWS], columns), *rest]


def _within(path: Path, root: Path) -> str:
    """A path as seen from a folder."""
    if path == root.absolute():
        return path.name
    return str(path.relative_to(root.absolute()) if path.is_relative_to(root.absolute()) else path)


def export_to(
    run: Path | None,
    kind: str | None,
    output: Path | None,
    where: Sequence[str] | None = None,
    *,
    frames: bool,
    replace: bool,
) -> int:
    """Export a run or a campaign, and print the names of the files.

    Returns:
        The exit code: 1 if shots are missing in the file.
    """
    folder = campaign_in(run)
    if folder is not None:
        if kind not in (None, "netcdf"):
            what = f"a campaign cannot be exported as '{visible(kind)}'"
            raise ConfigError(Problem(what, "--to", expected="netcdf"))
        if where:
            what = "a campaign can only be exported with all its shots"
            raise ConfigError(Problem(what, "--where", expected="one of its runs"))
        path = output or Path(f"{folder.resolve().name}.nc")
        check_export("netcdf", path, frames=frames, replace=replace)
        export_campaign(folder, path)
        return 0
    kind = kind or "csv"
    if output is not None:
        check_export(kind, output, frames=frames, replace=replace)
    opened = chosen_run(run, where)
    path = output or Path(f"{opened.path.parent.name}_{opened.path.name}{ENDINGS.get(kind, '')}")
    check_export(kind, path, frames=frames, replace=replace)
    left_out = export_run(opened, kind, path, frames=frames)
    for line in (*state_lines(opened), *(f"left out: {text}" for text in left_out)):
        say(f"warning: {line}", stream=sys.stderr)
    for file in files_of(kind, path):
        say(f"written: {file}")
    return RecordingError.exit_code if left_out else 0


def export_points(
    run: Path | None,
    kind: str,
    output: Path | None,
    request: ScanRequest,
    where: Sequence[str] | None = None,
    *,
    replace: bool,
) -> None:
    """Write a CSV file with a row for each point of a scan, and print its name."""
    if kind != "csv":
        what = f"the points of a scan cannot be exported as '{visible(kind)}'"
        raise ConfigError(Problem(what, "--to", expected="csv"))
    opened = chosen_run(run, where)
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
        return [f"the run is still in progress, so only the {shots} taken so far are exported"]
    lines = [] if run.status == "complete" else [f"the run is {run.status}, so only {shots} are exported"]
    if run.n_damaged_lines:
        damaged = plural(run.n_damaged_lines, "line")
        lines.append(f"{damaged} of the index cannot be read; run labseq doctor")
    return lines
