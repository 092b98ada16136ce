"""The commands that run, go on with, and end a run; each body is imported only when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labseq.cli.completing import profile_names, run_folders
from labseq.cli.shared_options import (
    DryRun,
    Json,
    Output,
    Overrides,
    Profile,
    Realtime,
    Seed,
    SequenceFile,
    Shots,
    run_options,
)

RUN_EXAMPLES = """\b
Examples:
  labseq run sequences/compact_225.yaml
  labseq run sequences/compact_225.yaml --shots 5 --seed 1 --json
  labseq run sequences/compact_225.yaml --profile lab --dry-run
  labseq run sequences/compact_225.yaml --set planner.degree_of_parallelism=2 --set shot.2.rearrange.window="200 ms"
"""  # noqa: E501 - a command line that is to be copied
RESUME_EXAMPLES = """\b
Examples:
  labseq resume data/2026-01-02/0001_compact-225
  labseq resume data/2026-01-02/0001_compact-225 --accept-changes
"""


def run(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    shots: Shots = None,
    seed: Seed = None,
    overrides: Overrides = None,
    output: Output = None,
    as_json: Json = False,
    realtime: Realtime = False,
) -> None:
    """Run a sequence and record every shot."""
    from labseq.cli.run import run_sequence

    options = run_options(
        profile=profile,
        dry_run=dry_run,
        shots=shots,
        seed=seed,
        overrides=overrides,
        output=output,
        realtime=realtime,
    )
    run_sequence(sequence, options, as_json=as_json)


def resume(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="The run's folder, or any file in it.",
            show_default=False,
            autocompletion=run_folders,
        ),
    ],
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Go on although code, plugins or settings have changed since; run.json tells of it.",
        ),
    ] = False,
    as_json: Json = False,
    realtime: Realtime = False,
) -> None:
    """Take the shots that are missing in a run that was stopped, failed or died."""
    from labseq.cli.run import resume_run

    resume_run(run, accept_changes=accept_changes, realtime=realtime, as_json=as_json)


def stop(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN",
            help="The run's folder; the one in progress by default.",
            show_default=False,
            autocompletion=run_folders,
        ),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="NAME|FILE",
            help="The run on this profile's devices.",
            autocompletion=profile_names,
        ),
    ] = None,
    queue: Annotated[
        bool, typer.Option("--queue", help="Let labseq queue run take no further entry, too.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the run has ended.")] = False,
) -> None:
    """Ask a run in progress to end after the shot at hand; its devices are made safe."""
    from labseq.cli.stop import stop_run

    stop_run(run, profile, queue=queue, wait=wait)
