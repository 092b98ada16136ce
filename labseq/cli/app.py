"""The commands and their options; each body is imported only when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labseq import __version__
from labseq.cli import plan_options, plot_options, waveform_options
from labseq.cli.bench_app import bench
from labseq.cli.calibration_app import CALIBRATE_EXAMPLES, calibrate, calibration
from labseq.cli.shared_options import DryRun, Json, Overrides, Profile

app = typer.Typer(
    name="labseq",
    help="Lab control for neutral-atom tweezer arrays: YAML sequences in, one HDF5 file per shot out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(bench)
app.add_typer(calibration)
app.command(epilog=CALIBRATE_EXAMPLES, short_help="Calibrate sites, thresholds, tones or overlay.")(calibrate)

RUN_EXAMPLES = """\b
Examples:
  labseq run sequences/compact_225.yaml
  labseq run sequences/compact_225.yaml --shots 5 --seed 1 --json
  labseq run sequences/compact_225.yaml --profile lab --dry-run
  labseq run sequences/compact_225.yaml --set planner.degree_of_parallelism=2 --set shot.2.rearrange.window="200 ms"
"""  # noqa: E501 - a command line that is to be copied


SequenceFile = Annotated[
    Path, typer.Argument(metavar="SEQUENCE", help="The sequence file.", show_default=False)
]
RunFolder = Annotated[
    Path | None,
    typer.Argument(metavar="RUN", help="A run's folder; the newest run by default.", show_default=False),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"labseq {__version__}")
        raise typer.Exit


@app.callback()
def common(
    _version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
    _debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error, too; also after the command.")
    ] = False,
) -> None:
    """Take the options that come before the command; ``main`` looks at ``--debug`` itself."""


@app.command(epilog=RUN_EXAMPLES)
def run(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    shots: Annotated[
        int | None, typer.Option(metavar="N", help="Number of shots, instead of the sequence's own.")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(metavar="N", help="Seed of all random numbers: the same seed, the same run."),
    ] = None,
    overrides: Overrides = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the data, instead of LABSEQ_DATA or ./data."),
    ] = None,
    as_json: Json = False,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Let a simulated run take as long as a real one.")
    ] = False,
) -> None:
    """Run a sequence and record every shot."""
    from labseq.cli.run import run_sequence
    from labseq.session import Options

    options = Options(
        profile=profile,
        shots=shots,
        seed=seed,
        overrides=tuple(overrides or ()),
        output=output,
        dry_run="off" if dry_run is None else dry_run.value,
        realtime=realtime,
    )
    run_sequence(sequence, options, as_json=as_json)


@app.command(short_help="Check a sequence; print its timeline and limits.")
def check(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Check a sequence: every error, warnings, timeline, limits; opens no device."""
    from labseq.cli.check import check_sequence

    mode = "off" if dry_run is None else dry_run.value
    check_sequence(sequence, profile, overrides or (), mode, as_json=as_json)


@app.command(epilog=plan_options.EXAMPLES, short_help="Plan the moves for one occupancy; print or draw them.")
def plan(
    occupancy: plan_options.Occupancy,
    target: plan_options.Target = None,
    planner: plan_options.Planner = "psca",
    dop: plan_options.Dop = None,
    seed: plan_options.Seed = None,
    origin: plan_options.Origin = None,
    profile: plan_options.Profile = None,
    overrides: plan_options.Overrides = None,
    step: plan_options.Step = False,
    json: plan_options.Json = None,
    png: plan_options.Png = None,
) -> None:
    """Plan the moves for one occupancy, check the plan as a run does, and print or draw it."""
    from labseq.cli.plan import PlanOutput, plan_once
    from labseq.session import PlanRequest

    request = PlanRequest(
        occupancy=occupancy,
        target=target,
        planner=planner,
        degree_of_parallelism=dop,
        overrides=tuple(overrides or ()),
        seed=seed,
        origin=origin,
        profile=profile,
    )
    plan_once(request, PlanOutput(step=step, json=json, png=png))


@app.command(epilog=waveform_options.EXAMPLES, short_help="Show what the AWG would play for a plan.")
def waveform(
    plan: waveform_options.Plan,
    target: plan_options.Target = None,
    planner: plan_options.Planner = "psca",
    dop: plan_options.Dop = None,
    seed: plan_options.Seed = None,
    origin: plan_options.Origin = None,
    profile: plan_options.Profile = None,
    overrides: plan_options.Overrides = None,
    batches: waveform_options.Batches = None,
    sample_rate: waveform_options.SampleRate = None,
    json: waveform_options.Json = None,
    png: waveform_options.Png = None,
    npz: waveform_options.Npz = None,
) -> None:
    """Show what the AWG would play for a plan: voltages, powers, spectrogram, samples."""
    from labseq.cli.waveform import WaveformOutput, show_waveform
    from labseq.session import PlanRequest
    from labseq.session.waveform import WaveformRequest

    request = PlanRequest(
        occupancy=plan,
        target=target,
        planner=planner,
        degree_of_parallelism=dop,
        overrides=tuple(overrides or ()),
        seed=seed,
        origin=origin,
        profile=profile,
    )
    output = WaveformOutput(json=json, png=png, npz=npz)
    show_waveform(WaveformRequest(request, batches, sample_rate), output)


@app.command()
def show(
    run: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Show what a run has recorded, finished or not."""
    from labseq.cli.show import show_run

    show_run(run, as_json=as_json)


@app.command(epilog=plot_options.EXAMPLES, short_help="Draw a run as a figure of the paper.")
def plot(
    figure: plot_options.Figure,
    run: RunFolder = None,
    output: plot_options.Output = None,
    compare: plot_options.Compare = None,
) -> None:
    """Draw a run as a figure of the paper, beside the paper's own points."""
    from labseq.cli.plot import plot_run

    plot_run(run, figure, output, compare)


@app.command(short_help="List the plugins and what they offer.")
def plugins(
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", "-p", metavar="NAME|FILE", help="Also look in this profile's plugin folders."
        ),
    ] = None,
) -> None:
    """List the plugins: what each offers, where it comes from, and why it failed to load."""
    from labseq.cli.plugins import list_plugins

    list_plugins(profile)


@app.command(short_help="Bring every device of a profile to its safe state.")
def safe(
    profile: Annotated[
        str,
        typer.Argument(metavar="PROFILE", help="Name or file of the hardware profile.", show_default=False),
    ],
    overrides: Overrides = None,
) -> None:
    """Open every device of a profile, bring it to its safe state, and close it."""
    from labseq.cli.safe import secure_profile

    raise typer.Exit(secure_profile(profile, overrides or ()))


@app.command(short_help="Test every device of a profile: the first command of the day.")
def devices(
    profile: Annotated[
        str,
        typer.Argument(metavar="PROFILE", help="Name or file of the hardware profile.", show_default=False),
    ],
    dry_run: DryRun = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Open each device of a profile in turn, identify and test it, make it safe and close it."""
    from labseq.cli.devices import show_devices

    mode = "off" if dry_run is None else dry_run.value
    raise typer.Exit(show_devices(profile, overrides or (), mode, as_json=as_json))
