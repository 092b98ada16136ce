"""Options that several commands have."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


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
