"""Options that several commands have."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from labseq.cli.completing import profile_names, run_folders

if TYPE_CHECKING:
    from labseq.session import Options


class DryRunKind(StrEnum):
    """What ``--dry-run`` may be followed by."""

    FULL = "full"
    FAST = "fast"


Profile = Annotated[
    str | None,
    typer.Option(
        "--profile",
        "-p",
        metavar="NAME|FILE",
        help="Hardware profile, instead of the one that the sequence names.",
        autocompletion=profile_names,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="ADDRESS=VALUE",
        help="Change one value, for example planner.degree_of_parallelism=2 or profile.mobile_tweezers.speed="
        '"100 um/ms"; may be given several times.',
    ),
]
DryRun = Annotated[
    DryRunKind | None,
    typer.Option(
        "--dry-run",
        metavar="[=fast]",
        help="Open no hardware: every device is replaced by its driver's own simulation where it has one, "
        "else by its virtual twin; with =fast by virtual twins only.",
        show_choices=False,
    ),
]
Json = Annotated[
    bool, typer.Option("--json", help="Print the outcome as one line of JSON on stdout, all else on stderr.")
]
SequenceFile = Annotated[
    Path,
    typer.Argument(
        metavar="SEQUENCE",
        help="The sequence file, or the name of one in ./sequences or of one that comes with labseq.",
        show_default=False,
    ),
]
Shots = Annotated[
    int | None, typer.Option(metavar="N", help="Number of shots, instead of the sequence's own.")
]
Seed = Annotated[
    int | None, typer.Option(metavar="N", help="Seed of all random numbers: the same seed, the same run.")
]
Output = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for the data, instead of LABSEQ_DATA or ./data.")
]
Realtime = Annotated[bool, typer.Option("--realtime", help="Let a simulated run take as long as a real one.")]
RunFolder = Annotated[
    Path | None,
    typer.Argument(
        metavar="RUN",
        help="A run's folder; the newest run by default.",
        show_default=False,
        autocompletion=run_folders,
    ),
]


def run_options(
    *,
    profile: str | None,
    dry_run: DryRunKind | None,
    shots: int | None,
    seed: int | None,
    overrides: list[str] | None,
    output: Path | None,
    realtime: bool,
) -> Options:
    """What was chosen for a run, now or later."""
    from labseq.session import Options

    return Options(
        profile=profile,
        shots=shots,
        seed=seed,
        overrides=tuple(overrides or ()),
        output=output,
        dry_run="off" if dry_run is None else dry_run.value,
        realtime=realtime,
    )
