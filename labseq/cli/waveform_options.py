"""The options of ``labseq waveform`` that ``labseq plan`` has not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = """\b
Examples:
  labseq waveform random:20x20@0.75 --seed 1 --target kagome:15x15 --png waveform.png
  labseq waveform plan.json --profile lab --batches 1-3 --png begin.png --npz begin.npz
  labseq plan occupancy.npy --target ring:radius=4 --json - | labseq waveform - --json - | jq .row.peak_v
"""

Plan = Annotated[
    str,
    typer.Argument(
        metavar="PLAN|OCCUPANCY",
        help="What 'labseq plan --json' wrote: a file that ends in .json, or '-' for standard input; or any "
        "OCCUPANCY of 'labseq plan', which is then planned.",
        show_default=False,
    ),
]
Batches = Annotated[
    str | None, typer.Option(metavar="N|M-N", help="Only these batches, counted from 1; all if left out.")
]
SampleRate = Annotated[
    str | None,
    typer.Option(
        metavar="FREQUENCY",
        help='Samples per second, as in "625 MHz"; by default the setting sample_rate of the mobile tweezers '
        "in the profile, else 625 MHz.",
    ),
]
Png = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Draw the samples' spectrogram and envelope, the intended tones on top."
    ),
]
Npz = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the samples for numpy, and where batches start.")
]
Json = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|-", help="Write the numbers as JSON; with '-' to stdout, and all else to stderr."
    ),
]
