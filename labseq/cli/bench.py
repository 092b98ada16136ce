"""``labseq bench planners``: a table, and files for those who want more."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labseq.cli.bench_output import progress_of
from labseq.cli.bench_table import notes, table
from labseq.cli.files import STDOUT, check_different, check_writable, write_text
from labseq.cli.output import stdout_to_stderr, say, report_compiling
from labseq.cli.show import as_line
from labseq.drawing import check_picture, save_comparison
from labseq.errors import PlanError
from labseq.session.bench import BenchRequest, compare, read_request
from labseq.session.bench_curves import figure_drawing, fits_as_dicts, histogram_drawing, points_of
from labseq.session.bench_figures import Figure
from labseq.session.bench_report import Report


@dataclass(frozen=True, slots=True)
class BenchOutput:
    """What is written besides the table.

    Attributes:
        json: Name of the file for everything as JSON; "-" for stdout, which then holds nothing else.
        csv: The file for the table as CSV.
        png: The file for the picture.
    """

    json: str | None = None
    csv: Path | None = None
    png: Path | None = None


def bench_planners(request: BenchRequest, output: BenchOutput) -> None:
    """Compare planners and tell what came of it, also when it was stopped.

    Args:
        request: What is to be compared.
        output: What is written besides the table.

    Raises:
        ConfigError: Something in the request is wrong, or a file cannot be written.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: A planner failed, or a plan breaks a rule, for some loadings.
        StopRequested: It was stopped; what was done until then has been told.
    """
    answer = stdout_to_stderr() if output.json == STDOUT else None
    comparison, figure = read_request(request)
    files = _files(output, figure)
    check_different(*files.values())
    for kind, path in files.items():
        if kind == "png":
            check_picture(path, (1, 1))
        check_writable(path)
    with progress_of("loadings") as progress:
        report = compare(comparison, request.workers, announce=report_compiling, progress=progress)
    say(*table(report), *notes(report, figure))
    if report.rows:
        _write_files(files, report, figure)
    if answer is not None:
        answer(as_line(_as_dict(report, figure)))
    if report.ended_by is not None:
        raise report.ended_by
    _raise_failures(report)


def _files(output: BenchOutput, figure: Figure | None) -> dict[str, Path]:
    """The files that are to be written, by kind."""
    named = {"csv": output.csv, "png": output.png}
    if output.json not in (None, STDOUT):
        named["json"] = Path(output.json)
    if figure is not None:
        named = {kind: path or Path(f"figure-{figure.name}.{kind}") for kind, path in named.items()}
    return {kind: path for kind, path in named.items() if path is not None}


def _write_files(files: dict[str, Path], report: Report, figure: Figure | None) -> None:
    for kind, path in files.items():
        if kind == "png":
            save_comparison(path, figure_drawing(report, figure) if figure else histogram_drawing(report))
            continue
        write_text(path, report.as_csv() if kind == "csv" else f"{as_line(_as_dict(report, figure))}\n")
    if files:
        say(f"written: {', '.join(map(str, files.values()))}")


def _as_dict(report: Report, figure: Figure | None) -> dict[str, Any]:
    values = report.as_dict()
    if figure is not None:
        values |= {"figure": figure.name, "fits": fits_as_dicts(points_of(report, figure))}
    return values


def _raise_failures(report: Report) -> None:
    failed = [row for row in report.rows if row.n_failed]
    if failed:
        n, of = sum(row.n_failed for row in failed), sum(row.n_loadings for row in failed)
        names = ", ".join(dict.fromkeys(f"'{row.planner_entry.planner}'" for row in failed))
        raise PlanError(f"{n} of {of} plans of {names} are wrong; they do not count in the table")
