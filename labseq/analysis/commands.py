"""`labseq replay`, `labseq analyse` and `labseq plot`."""

from pathlib import Path
from typing import Annotated

import typer

from labseq.console.options import (
    Along,
    DataFolder,
    FitName,
    FitSettings,
    Json,
    OfSequence,
    Plugins,
    RunFolder,
    ScanQuantities,
    Search,
    Since,
    Until,
    Where,
    WhereRuns,
    WithStatus,
    WithTag,
    run_folders,
)

REPLAY_EXAMPLES = """\b
Examples:
  labseq replay data/2026-01-02/0001_compact-225
  labseq replay data/2026-01-02/0001_compact-225 --planner tetris
  labseq replay data/2026-01-02/0001_compact-225 --dop 3 --shots 0,4-8
  labseq replay data/2026-01-02/0001_compact-225 --set profile.detector.threshold=1500
"""
ANALYSE_EXAMPLES = """\b
Examples:
  labseq analyse data/2026-01-02/0001_compact-225
  labseq analyse data/2026-01-02/0001_compact-225 --use survival --set atoms=moved
  labseq analyse --scan analysis.survival.survival
"""
PLOT_EXAMPLES = """\b
Examples:
  labseq plot
  labseq plot data/2026-11-21/0004_scan-dop --what scan -o scan.pdf
  labseq plot --scan survival:before,after --fit exponential
  labseq plot --map survival:before,after
  labseq plot --shot 3
  labseq plot --shot 3 --cycle 1 -o first_cycle.svg
"""

COMPARE_EXAMPLES = """\b
Examples:
  labseq compare 74 75
  labseq compare 2026-11-20/74 2026-11-27/12 --scan survival:before,after -o lifetimes.png
"""
TREND_EXAMPLES = """\b
Examples:
  labseq trend decay --sequence lifetime
  labseq trend loading --since 2026-11-01 --tag daily -o loading.png
"""
PictureFile = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FILE", help="Also draw a picture: a PNG, SVG or PDF file."),
]


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Folders, names or numbers of the runs.",
            show_default=False,
            autocompletion=run_folders,
        ),
    ],
    scan: Annotated[
        str | None,
        typer.Option(metavar="QUANTITY", help="The quantity. Default: what the first run measures."),
    ] = None,
    output: PictureFile = None,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Compare runs: the measured quantity, its fits, and the settings in which they differ.

    The picture shows their scans one over the other.
    """
    from labseq.analysis.comparison import compare_runs

    compare_runs(runs, scan, output, as_json=as_json)


def trend(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="A fitted parameter, quantity or changed setting, such as decay or survival:before,after.",
            show_default=False,
        ),
    ],
    data: DataFolder = None,
    search: Search = "",
    since: Since = "",
    until: Until = "",
    sequence: OfSequence = "",
    tag: WithTag = "",
    status: WithStatus = "",
    where: WhereRuns = None,
    output: PictureFile = None,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Follow a number over the runs of a data folder, and mark where a calibration has changed."""
    from labseq.analysis.comparison import show_trend

    conditions = {"since": since, "until": until, "sequence": sequence, "tag": tag, "status": status}
    show_trend(name, data, {**conditions, "search": search, "where": where or ()}, output, as_json=as_json)


def replay(
    run: RunFolder = None,
    planner: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Another planner, with default settings except for --dop and --set."
        ),
    ] = None,
    dop: Annotated[
        int | None, typer.Option(metavar="N", help="Another degree of parallelism for the planner.")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Another detector, with default settings except for --set."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="ADDRESS=VALUE",
            help="Change planner.KEY or profile.detector.KEY. May be given several times.",
        ),
    ] = None,
    shots: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Only these shots, counted from 0 as in `labseq show`: 3,5-9."),
    ] = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Also write all results as JSON, image by image."
        ),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Pass a run's images to another planner or detector, and compare the results with the recorded ones.

    Without another planner or detector, the run's own must reproduce the recorded results. The exit code
    is 1 if they do not.
    """
    from labseq.analysis.replay import ReplayRequest
    from labseq.analysis.replay_report import replay_run

    request = ReplayRequest(planner, dop, detector, tuple(overrides or ()), shots)
    raise typer.Exit(replay_run(run, request, output, as_json=as_json))


def analyse(
    run: RunFolder = None,
    use: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="One analysis. Default: all that the run's sequence names."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a setting of the analysis given by --use. May be given several times.",
        ),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Analyse all shots again, including those that have a result.")
    ] = False,
    scan: ScanQuantities = None,
    where: Where = None,
    fit: FitName = None,
    fit_set: FitSettings = None,
    along: Along = None,
    _plugins: Plugins = None,
) -> None:
    """Analyse the shots of a run that have no result yet. With --scan, then print the scan.

    If the settings differ from those of the existing results, all shots are analysed again.
    """
    from labseq.analysis.analysing import analyse_run
    from labseq.analysis.scanned import scan_request

    request = scan_request([] if where and scan is None else scan, fit, fit_set, along)
    raise typer.Exit(analyse_run(run, use, overrides or (), request, where, again=again))


def plot(
    run: RunFolder = None,
    what: Annotated[
        str | None,
        typer.Option(
            metavar="PART",
            help="The average image, the loading of each site or the counts (image, loading, counts), "
            "or one part of the overview: filling, success, survival, defects, timing, scan or losses.",
        ),
    ] = None,
    shot: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Draw one shot, counted from 0: its images, occupancies and the moves after them.",
        ),
    ] = None,
    cycle: Annotated[
        int | None,
        typer.Option(
            metavar="K",
            help="Only one cycle of that shot, counted from 0: the images before and after, or its motion.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="A PNG, SVG or PDF file. With --shot, also a GIF or a page (.html) of the motion in a "
            "cycle. Default: overview.png, shot-3.png, ... in the current folder, with a number if "
            "the file exists.",
        ),
    ] = None,
    scan: ScanQuantities = None,
    sites: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="[QUANTITY]",
            help="A quantity of the images at each site: survival:before,after, loading, filling or "
            "defect_free. Default: what the run measures. May be given several times.",
        ),
    ] = None,
    where: Where = None,
    fit: FitName = None,
    fit_set: FitSettings = None,
    along: Along = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file of --output.")] = False,
    _plugins: Plugins = None,
) -> None:
    """Draw a run, finished or not: an overview, one part of it, the points of a scan, or a shot.

    For a campaign's folder, draw the results at its points.
    """
    from labseq.analysis.plotting import PlotRequest, plot_run
    from labseq.analysis.scanned import scan_request

    scanned = scan_request(scan, fit, fit_set, along)
    request = PlotRequest(what, shot, cycle, scanned, tuple(sites or ()), tuple(where or ()))
    plot_run(run, request, output, replace=force)
