"""The options of `labseq plan` and `labseq waveform`."""

from pathlib import Path
from typing import Annotated, Final

import typer

from labseq.console.options import JsonFile, Plugins, profile_option

PLAN_EXAMPLES: Final = """\b
Examples:
  labseq plan random:20x20@0.75 --seed 1 --target "{pattern: kagome, rows: 15, cols: 15}" --dop 7
  labseq plan random:20x20@0.75 --seed 1 --target "{pattern: sierpinski, rows: 16, cols: 16}" --step
  labseq plan data/2026-11-20/0001_compact-225/shots/shot_000003.h5#1 --png second_cycle.png
  labseq plan random:20x20@0.75 --target "{pattern: compact, rows: 15, cols: 15}" --animate plan.html
  labseq plan occupancy.npy --target "{pattern: ring, radius: 4}" --origin 2,3 --json - | jq .n_batches
"""
WAVEFORM_EXAMPLES: Final = """\b
Examples:
  labseq waveform random:20x20@0.75 --target "{pattern: kagome, rows: 15, cols: 15}" --png waveform.png
  labseq waveform plan.json --profile lab --batches 1-3 --png begin.png --npz begin.npz
  labseq plan occupancy.npy --target kagome --json - | labseq waveform - --json - | jq .row.peak_v
"""

Target = Annotated[
    str | None,
    typer.Option(
        metavar="PATTERN|SEQUENCE",
        help="The target as in a sequence file, '{pattern: kagome, rows: 15, cols: 15}', or the "
        "file or name of a sequence whose target is used. Default: the target that the shot was taken with.",
    ),
]
Planner = Annotated[str, typer.Option(metavar="NAME", help="The planner.")]
Dop = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Degree of parallelism (most mobile tweezers on at once). Default: the planner's.",
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(metavar="N", min=0, help="Seed of 'random:'. Default: a new one, which is printed."),
]
Origin = Annotated[
    str | None,
    typer.Option(metavar="R,C", help="Row and column of the target's top left site, from 0, as in 2,3."),
]
Profile = Annotated[
    str | None,
    profile_option(
        "Hardware profile with the grid, the motion and the plugin folders. Default: the shot file's, "
        "else the paper's spacing and motion."
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a setting of the planner, or with profile.mobile_tweezers.speed=... a value of the "
        "profile. May be given several times.",
    ),
]


def plan(
    occupancy: Annotated[
        str,
        typer.Argument(
            metavar="OCCUPANCY",
            help="A text file of 0 and 1, or '-' for text on standard input. Or a .npy file, or an array "
            "of a .npz or HDF5 file, such as loadings.h5:loaded#3 (occupancy 3 of several, counted from 0). "
            "Or a shot file such as run/shots/shot_000003.h5#2 (the image that cycle 2 was planned on, "
            "counted from 0, default 0). Or random:20x20@0.75 (each site filled with this probability).",
            show_default=False,
        ),
    ],
    target: Target = None,
    planner: Planner = "psca",
    dop: Dop = None,
    seed: Seed = None,
    origin: Origin = None,
    profile: Profile = None,
    overrides: Overrides = None,
    step: Annotated[
        bool, typer.Option("--step", help="Show batch by batch. In a terminal, wait for Enter after each.")
    ] = False,
    json: JsonFile = None,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the plan, with an arrow for each atom move.")
    ] = None,
    animate: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Show the motion of tweezers and atoms in time, as a GIF or a page (.html) for a browser.",
        ),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Plan the moves for one occupancy, check the plan as a run does, and print or draw it.

    Batches, cycles, rows and columns are counted from 0.
    """
    from labseq.assembly.planning import PlanRequest
    from labseq.plans.plan import PlanOutput, plan_once

    request = PlanRequest(occupancy, target, planner, dop, tuple(overrides or ()), seed, origin, profile)
    plan_once(request, PlanOutput(step=step, json=json, png=png, animate=animate))


def waveform(
    plan: Annotated[
        str,
        typer.Argument(
            metavar="PLAN|OCCUPANCY",
            help="The output of 'labseq plan --json', as a .json file, or '-' for standard input. Or "
            "any OCCUPANCY of 'labseq plan', which is then planned.",
            show_default=False,
        ),
    ],
    target: Target = None,
    planner: Planner = "psca",
    dop: Dop = None,
    seed: Seed = None,
    origin: Origin = None,
    profile: Profile = None,
    overrides: Overrides = None,
    batches: Annotated[
        str | None, typer.Option(metavar="N|M-N", help="Only these batches, counted from 0. Default: all.")
    ] = None,
    sample_rate: Annotated[
        str | None,
        typer.Option(
            metavar="FREQUENCY",
            help='Samples per second, as in "625 MHz". Default: the setting sample_rate of the mobile '
            "tweezers in the profile, else 625 MHz.",
        ),
    ] = None,
    json: JsonFile = None,
    png: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Draw spectrogram and envelope of the samples with the intended tones on top.",
        ),
    ] = None,
    npz: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the samples and the starts of the batches for numpy."),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Show voltages, powers, spectrogram and samples that the AWG would play for a plan."""
    from labseq.assembly.planning import PlanRequest
    from labseq.plans.waveform import WaveformRequest
    from labseq.plans.waveform_report import WaveformOutput, show_waveform

    request = PlanRequest(plan, target, planner, dop, tuple(overrides or ()), seed, origin, profile)
    output = WaveformOutput(json=json, png=png, npz=npz)
    show_waveform(WaveformRequest(request, batches, sample_rate), output)
