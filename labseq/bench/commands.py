"""The commands of `labseq bench`."""

from pathlib import Path
from typing import Annotated

import typer

from labseq.console.options import JsonFile, Plugins, profile_names

bench = typer.Typer(
    name="bench",
    help="Measure and compare parts of labseq.",
    short_help="Compare planners; measure rendering and latency.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

PLANNERS_EXAMPLES = """\b
Examples:
  labseq bench planners --planners psca,lsap --dop 15 --loadings 10000
  labseq bench planners --planners psca,psca:variant=paper --grid 30x30 --target kagome:20x20 --loading "60 %"
  labseq bench planners --planners psca --dop 15 --json - | jq .rows[0].n_batches
  labseq bench planners --planners psca,mta1 --set profile.mobile_tweezers.speed="130 um/ms"
"""

LATENCY_EXAMPLES = """\b
Examples:
  labseq bench latency sequences/compact_225.yaml --profile bench_awg
  labseq bench latency sequences/compact_225.yaml --set planner.degree_of_parallelism=15 --json latency.json
  labseq bench latency sequences/compact_225.yaml --profile bench_awg --set profile.mobile_tweezers.mode=fifo
"""


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
        str, typer.Option(metavar="PATTERN", help="A pattern such as kagome:15x15.")
    ] = "compact:15x15",
    loading: Annotated[str, typer.Option(metavar="P", help="Probability that a site is loaded.")] = "75 %",
    dop: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Degree of parallelism of all planners that have one. Default: each planner's own.",
        ),
    ] = None,
    loadings: Annotated[
        int,
        typer.Option(metavar="N", min=1, help="Number of random loadings."),
    ] = 1000,
    seed: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Seed of all loadings; the same seed gives the same result."),
    ] = 1,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="ADDRESS=VALUE",
            help="planner.KEY=VALUE changes every planner, profile.mobile_tweezers.KEY=VALUE the motion "
            "of the tweezers; may be given several times.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Number of processes. Default: one per core."),
    ] = None,
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
    """Let planners plan the same random loadings, check every plan, and compare the results."""
    from labseq.bench.comparison import BenchRequest
    from labseq.bench.terminal import bench_planners

    request = BenchRequest(planners, grid, target, loading, dop, loadings, seed, tuple(overrides or ()))
    bench_planners(request, workers, json=json, csv=csv, png=png)


@bench.command(epilog=LATENCY_EXAMPLES, short_help="Measure the time from a frame to the first light.")
def latency(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            help="The sequence; its target, its planner and its first image are used.",
            show_default=False,
        ),
    ],
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="NAME|FILE",
            help="Hardware profile, instead of the one that the sequence names.",
            autocompletion=profile_names,
        ),
    ] = None,
    loadings: Annotated[int, typer.Option(metavar="N", min=1, help="Random loadings.")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of all loadings.")] = 1,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="ADDRESS=VALUE", help="As for labseq run; may be given several times."),
    ] = None,
    json: JsonFile = None,
    _plugins: Plugins = None,
) -> None:
    """Measure the time from the end of an exposure to the first light of the mobile tweezers.

    Shots are taken in a dry run up to the first image, and continued to the start of the moves.
    """
    from labseq.bench.latency import LatencyRequest
    from labseq.bench.terminal import bench_latency

    bench_latency(LatencyRequest(sequence, profile, tuple(overrides or ()), loadings, seed), json)


@bench.command(short_help="Measure the speed of rendering.")
def waveform(
    repeats: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of repetitions; the fastest one counts.")
    ] = 15,
    json: JsonFile = None,
) -> None:
    """Measure rendering: by kind of segment, for a plan, and compared with stored waveforms and numpy."""
    from labseq.bench.terminal import bench_rendering

    bench_rendering(repeats, json)
