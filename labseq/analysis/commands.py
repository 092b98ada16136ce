"""`labseq replay`, `labseq analyse` and `labseq plot`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labseq.console.options import Json, RunFolder

REPLAY_EXAMPLES = """\b
Examples:
  labseq replay data/2026-01-02/0001_compact-225
  labseq replay data/2026-01-02/0001_compact-225 --planner tetris
  labseq replay data/2026-01-02/0001_compact-225 --dop 3 --shots 1,5-9
  labseq replay data/2026-01-02/0001_compact-225 --set profile.detector.threshold=1500
"""
ANALYSE_EXAMPLES = """\b
Examples:
  labseq analyse data/2026-01-02/0001_compact-225
  labseq analyse data/2026-01-02/0001_compact-225 --use survival --set atoms=moved
"""


def replay(
    run: RunFolder = None,
    planner: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Another planner, with its default settings but for --dop and --set."
        ),
    ] = None,
    dop: Annotated[
        int | None, typer.Option(metavar="N", help="Another degree of parallelism of the planner.")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Another detector, with its default settings but for --set."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="ADDRESS=VALUE",
            help="Change planner.KEY or profile.detector.KEY; may be given several times.",
        ),
    ] = None,
    shots: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="These shots only, counted from 1 as in `labseq show`: 3,5-9."),
    ] = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write everything as JSON, image by image."),
    ] = None,
) -> None:
    """Let a run's images go through another planner or detector, and compare with what was done.

    Without either, the run's own must give what was recorded: exits with 1 if not.
    """
    from labseq.analysis.replay import ReplayRequest
    from labseq.analysis.terminal import replay_run

    request = ReplayRequest(planner, dop, detector, tuple(overrides or ()), shots)
    raise typer.Exit(replay_run(run, request, output, as_json=as_json))


def analyse(
    run: RunFolder = None,
    use: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="One analysis; all those of the run's sequence by default."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a setting of the analysis that --use names; may be given several times.",
        ),
    ] = None,
    anew: Annotated[
        bool, typer.Option("--anew", help="Analyse all shots again, also those that have a result.")
    ] = False,
) -> None:
    """Analyse the shots of a run that have no result yet.

    With other settings than those of the results that are there, all shots are analysed again.
    """
    from labseq.analysis.terminal import analyse_run

    raise typer.Exit(analyse_run(run, use, overrides or (), anew=anew))
