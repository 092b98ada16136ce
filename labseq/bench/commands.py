"""The commands of `labseq bench`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labseq.console.options import JsonFile, Keys, Plugins, Scheduler, profile_names

if TYPE_CHECKING:
    from labseq.bench.report import Report

bench = typer.Typer(
    name="bench",
    help="Measure and compare parts of labseq.",
    short_help="Compare planners, and measure rendering and latency.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

PLANNERS_EXAMPLES = """\b
Examples:
  labseq bench planners --planners psca,lsap --dop 15 --loadings 10000
  labseq bench planners --grid 30x30 --target "{pattern: kagome, rows: 20, cols: 20}" --loading "60 %"
  labseq bench planners --planners psca,psca:variant=paper --dop 15
  labseq bench planners --planners psca --dop 15 --json - | jq .rows[0].n_batches
  labseq bench planners --planners psca,grid --dop 7,15,20
  labseq bench planners --planners psca,mta1 --set profile.mobile_tweezers.speed="130 um/ms"
"""

LATENCY_EXAMPLES = """\b
Examples:
  labseq bench latency sequences/compact_225.yaml --profile bench_awg
  labseq bench latency sequences/compact_225.yaml --set planner.degree_of_parallelism=15 --json latency.json
  labseq bench latency sequences/compact_225.yaml --profile bench_awg --set profile.mobile_tweezers.mode=fifo
"""


@contextmanager
def progress_of(unit: str) -> Generator[Callable[[int, int], None]]:
    """A progress bar on stderr if stderr is a terminal, else a line for every tenth of the work.

    Args:
        unit: Name of the counted things, in the plural.
    """
    from labseq.console.output import say

    if not sys.stderr.isatty():
        reported = 0

        def report_progress(done: int, total: int) -> None:
            nonlocal reported
            if done * 10 // total > reported:
                reported = done * 10 // total
                say(f"{done} of {total} {unit}", stream=sys.stderr)

        yield report_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(unit), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(unit, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@bench.command(epilog=PLANNERS_EXAMPLES, short_help="Compare planners on the same random loadings.")
def planners(
    planners: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Planners, optionally with their own settings: psca,psca:variant=paper.",
        ),
    ] = "psca",
    grid: Annotated[str, typer.Option(metavar="ROWSxCOLS", help="Sites of the grid.")] = "20x20",
    target: Annotated[
        str, typer.Option(metavar="PATTERN|SEQUENCE", help="The target, as in labseq plan.")
    ] = "{pattern: compact, rows: 15, cols: 15}",
    loading: Annotated[str, typer.Option(metavar="P", help="Probability that a site is loaded.")] = "75 %",
    dop: Annotated[
        str | None,
        typer.Option(
            metavar="N,...",
            help="Degrees of parallelism of all planners that have one. Default: each planner's own.",
        ),
    ] = None,
    loadings: Annotated[
        int,
        typer.Option(metavar="N", min=1, help="Number of random loadings."),
    ] = 1000,
    seed: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Seed of all loadings. The same seed gives the same result."),
    ] = 1,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="ADDRESS=VALUE",
            help="planner.KEY=VALUE changes every planner, and profile.mobile_tweezers.KEY=VALUE the motion "
            "of the tweezers. May be given several times.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Number of processes. Default: one per core."),
    ] = None,
    scheduler: Scheduler = None,
    keys: Keys = None,
    json: JsonFile = None,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as CSV, in SI units.")
    ] = None,
    png: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw a histogram of the number of batches."),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Let planners plan for the same random loadings, check every plan, and compare the results."""
    from labseq.bench.comparison import read_comparison
    from labseq.bench.planners import Resources, compare
    from labseq.cluster import check_workers
    from labseq.console import output
    from labseq.pictures.plans import check_picture

    check_workers(workers, scheduler)
    comparison = read_comparison(planners, grid, target, loading, dop, loadings, seed, overrides or ())
    output.check_different(json, csv, png)
    if png is not None:
        check_picture(png, (1, 1))
    for path in filter(None, (csv, png)):
        output.check_writable(path)
    write = output.json_writer(json)
    with progress_of("loadings") as progress:
        resources = Resources(workers, scheduler, keys)
        report = compare(comparison, resources, announce=output.report_compiling, progress=progress)
    output.say(*report.as_text())
    if report.rows:
        _write_files(report, csv, png, json)
    write(report)
    _raise_failures(report)


def _write_files(report: Report, csv: Path | None, png: Path | None, json: str | None) -> None:
    """Write table and picture, and print the names of all files."""
    from labseq.bench.report import save_histogram
    from labseq.console.output import STDOUT, say, write_text

    if csv is not None:
        write_text(csv, report.as_csv())
    if png is not None:
        save_histogram(png, report)
    if files := [str(name) for name in (csv, png, json) if name not in (None, STDOUT)]:
        say(f"written: {', '.join(files)}")


def _raise_failures(report: Report) -> None:
    """Raise the error that ended the comparison, or a ``PlanError`` if plans are wrong."""
    from labseq.errors import PlanError

    if report.ended_by is not None:
        raise report.ended_by
    if failed := [row for row in report.rows if row["n_failed"]]:
        n, n_plans = sum(row["n_failed"] for row in failed), sum(row["n_loadings"] for row in failed)
        names = ", ".join(dict.fromkeys(f"'{row['planner']}'" for row in failed))
        raise PlanError(f"{n} of {n_plans} plans of {names} are wrong, and not counted in the table")


@bench.command(epilog=LATENCY_EXAMPLES, short_help="Measure the time from a frame to the first light.")
def latency(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            help="The sequence whose target, planner and first image are used.",
            show_default=False,
        ),
    ],
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="NAME|FILE",
            help="Hardware profile, instead of the sequence's own.",
            autocompletion=profile_names,
        ),
    ] = None,
    loadings: Annotated[int, typer.Option(metavar="N", min=1, help="Random loadings.")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of all loadings.")] = 1,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="ADDRESS=VALUE", help="As in labseq run. May be given several times."),
    ] = None,
    json: JsonFile = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw a histogram of the times, as .png, .svg or .pdf."),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Measure the time from a frame in memory to the first light of the mobile tweezers.

    Shots are taken in a dry run up to the first image. Then the atoms are rearranged once, as in a run.
    """
    from labseq.bench.latency import LatencyRequest, draw_report, measure_latency
    from labseq.console.output import json_writer, report_compiling, say
    from labseq.pictures.figures import check_place

    if picture is not None:
        check_place(picture)

    write = json_writer(json)
    request = LatencyRequest(sequence, profile, tuple(overrides or ()), loadings, seed)
    with progress_of("loadings") as progress:
        report = measure_latency(request, announce=report_compiling, progress=progress)
    say(*report.as_text())
    say(*(f"warning: {text}" for text in report.warnings), stream=sys.stderr)
    if picture is not None:
        draw_report(report, picture)
        say(f"written: {picture}")
    write(report)


@bench.command(short_help="Measure the speed of rendering.")
def waveform(
    repeats: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of repetitions. The fastest one counts.")
    ] = 15,
    json: JsonFile = None,
) -> None:
    """Measure rendering on this computer, for each kind of segment and for a plan."""
    from labseq.bench.rendering import bench_waveform
    from labseq.console.output import json_writer, report_compiling, say

    write = json_writer(json)
    report = bench_waveform(repeats, announce=report_compiling)
    say(*report.as_text())
    write(report)
