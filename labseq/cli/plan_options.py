"""The options of ``labseq plan``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = """\b
Examples:
  labseq plan random:20x20@0.75 --seed 1 --target kagome:15x15 --dop 7
  labseq plan random:20x20@0.75 --seed 1 --target sierpinski:16x16 --step
  labseq plan data/2026-11-20/0001_compact-225/shots/shot_000003.h5#2 --png second_cycle.png
  labseq plan occupancy.npy --target ring:radius=4 --origin 2,3 --json - | jq .n_batches
"""

Occupancy = Annotated[
    str,
    typer.Argument(
        metavar="OCCUPANCY",
        help="A .npy file, a text file of 0 and 1, '-' for such a text on standard input, the shot file "
        "run/shots/shot_000003.h5#2 (the image that cycle 2 was planned on; 1 if left out), or "
        "random:20x20@0.75 (each site filled with that probability).",
        show_default=False,
    ),
]
Target = Annotated[
    str | None,
    typer.Option(
        metavar="PATTERN:ROWSxCOLS",
        help="The target, for example kagome:15x15 or ring:radius=4,width=2, or a sequence file, whose "
        "target is taken; by default the one that the shot was taken with.",
    ),
]
Planner = Annotated[str, typer.Option(metavar="NAME", help="The planner.")]
Dop = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Degree of parallelism: most mobile tweezers on at once; the planner's default if left out.",
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(metavar="N", min=0, help="Seed of 'random:'; a fresh one, which is told, if left out."),
]
Origin = Annotated[
    str | None,
    typer.Option(metavar="R,C", help="The target's top left site: row and column, from 0, as in 2,3."),
]
Profile = Annotated[
    str | None,
    typer.Option(
        "--profile",
        "-p",
        metavar="NAME|FILE",
        help="Hardware profile with the grid, the motion and the plugin folders; by default those of the "
        "shot file, else the paper's spacing and motion.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a setting of the planner, or with profile.mobile_tweezers.speed=... a value of the "
        "profile; may be given several times.",
    ),
]
Step = Annotated[
    bool, typer.Option("--step", help="Show batch by batch; in a terminal, wait for Enter after each.")
]
Json = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|-", help="Write the plan as JSON; with '-' to stdout, and all else to stderr."
    ),
]
Png = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Draw the plan, with an arrow for each atom move.")
]
