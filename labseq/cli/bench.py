"""``labseq bench planners``: a table, and files for those who want more."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from labseq.cli.bench_table import notes, table
from labseq.cli.output import divert_stdout, say
from labseq.cli.show import as_line
from labseq.config.wording import visible
from labseq.drawing import check_picture, save_comparison
from labseq.errors import ConfigError, PlanError, Problem
from labseq.session.bench import BenchRequest, compare, read_request
from labseq.session.bench_curves import figure_drawing, fits_as_dicts, histogram_drawing, points_of
from labseq.session.bench_figures import Figure
from labseq.session.bench_report import Report

STDOUT: Final = "-"
_STEPS: Final = 10
"""How often progress is told where there is no terminal."""


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
    answer = divert_stdout() if output.json == STDOUT else None
    comparison, figure = read_request(request)
    files = _files(output, figure)
    for kind, path in files.items():
        if kind == "png":
            check_picture(path, (1, 1))
        _prove_writable(path)
    with _progress() as progress:
        report = compare(comparison, request.workers, announce=_tell_compiling, progress=progress)
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


def _prove_writable(path: Path) -> None:
    """Find out that a file cannot be written before hours are spent."""
    is_new = not path.exists()
    try:
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except (OSError, ValueError) as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: Exception) -> ConfigError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return ConfigError(Problem(f"it cannot be written: {reason}", visible(str(path))))


def _write_files(files: dict[str, Path], report: Report, figure: Figure | None) -> None:
    for kind, path in files.items():
        if kind == "png":
            save_comparison(path, figure_drawing(report, figure) if figure else histogram_drawing(report))
            continue
        text = report.as_csv() if kind == "csv" else f"{as_line(_as_dict(report, figure))}\n"
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise _unwritten(path, error) from error
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
        names = ", ".join(dict.fromkeys(f"'{row.entrant.planner}'" for row in failed))
        raise PlanError(f"{n} of {of} plans of {names} are wrong; they do not count in the table")


def _tell_compiling(module: str) -> None:
    say(f"compiling {module}; later runs find it in the cache", stream=sys.stderr)


@contextmanager
def _progress() -> Generator[Callable[[int, int], None]]:
    """A bar on stderr if that is a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        told = 0

        def tell(done: int, wanted: int) -> None:
            nonlocal told
            if done * _STEPS // wanted > told:
                told = done * _STEPS // wanted
                say(f"{done} of {wanted} loadings", stream=sys.stderr)

        yield tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn("loadings"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("loadings", total=None)
        yield lambda done, wanted: bar.update(task, completed=done, total=wanted)
