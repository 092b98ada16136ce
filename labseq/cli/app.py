"""The commands and their options; each body is imported only when its command runs."""

from __future__ import annotations

from typing import Annotated

import typer

from labseq import __version__
from labseq.cli import plan_options, plot_options, show_options, waveform_options
from labseq.cli.bench_app import bench
from labseq.cli.calibration_app import CALIBRATE_EXAMPLES, calibrate, calibration
from labseq.cli.completing import profile_names
from labseq.cli.data_app import DOCTOR_EXAMPLES, EXPORT_EXAMPLES, doctor, export
from labseq.cli.demo_app import demo
from labseq.cli.new_app import NEW_EXAMPLES, SCHEMA_EXAMPLES, new, schema
from labseq.cli.queue_app import queue
from labseq.cli.replay_app import ANALYSE_EXAMPLES, REPLAY_EXAMPLES, analyse, replay
from labseq.cli.run_app import RESUME_EXAMPLES, RUN_EXAMPLES, resume, run, stop
from labseq.cli.shared_options import (
    DryRun,
    Json,
    Overrides,
    Profile,
    RunFolder,
    SequenceFile,
)

app = typer.Typer(
    name="labseq",
    help="Lab control for neutral-atom tweezer arrays: YAML sequences in, one HDF5 file per shot out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(bench)
app.add_typer(calibration)
app.add_typer(queue)
app.command(epilog=CALIBRATE_EXAMPLES, short_help="Calibrate sites, thresholds, tones or overlay.")(calibrate)


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


app.command(short_help="Take a first look, without any file.")(demo)
app.command(epilog=RUN_EXAMPLES, short_help="Run a sequence and record every shot.")(run)
app.command(epilog=RESUME_EXAMPLES, short_help="Go on with a run that ended early.")(resume)
app.command(short_help="End a run in progress after the shot at hand.")(stop)


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


@app.command(short_help="Show what a run has recorded.")
def show(
    run: RunFolder = None,
    shots: show_options.Shots = False,
    timing: show_options.Timing = False,
    scan: show_options.Scan = False,
    devices: show_options.Devices = False,
    as_json: Json = False,
) -> None:
    """Show what a run has recorded, finished or not: its summary, or the tables that are asked for."""
    from labseq.cli.show import Tables, show_run

    show_run(run, as_json=as_json, tables=Tables(shots, timing, scan, devices))


@app.command(short_help="Watch a run that goes on in another process.")
def watch(run: RunFolder = None) -> None:
    """Show a run that goes on in another process, until it ends; Ctrl-C ends only the view."""
    from labseq.cli.watch import watch_run

    watch_run(run)


@app.command(epilog=plot_options.EXAMPLES, short_help="Draw a run, or one of its shots.")
def plot(
    run: RunFolder = None,
    what: plot_options.What = None,
    shot: plot_options.Shot = None,
    cycle: plot_options.Cycle = None,
    figure: plot_options.Figure = None,
    compare: plot_options.Compare = None,
    output: plot_options.Output = None,
) -> None:
    """Draw a run, finished or not: all of it on one sheet, a part of it, a shot, or a figure of the paper."""
    from labseq.cli.plot import PlotRequest, plot_run

    plot_run(run, PlotRequest(what, figure, compare, shot, cycle), output)


app.command(epilog=REPLAY_EXAMPLES, short_help="Try another planner or detector on a run's images.")(replay)
app.command(epilog=ANALYSE_EXAMPLES, short_help="Analyse the shots of a run.")(analyse)


app.command(epilog=EXPORT_EXAMPLES, short_help="Export a run as CSV, Parquet, netCDF or HDF5.")(export)
app.command(epilog=DOCTOR_EXAMPLES, short_help="Find and repair damage in recorded data.")(doctor)


app.command(epilog=NEW_EXAMPLES, short_help="Make a plugin, sequence or profile that runs at once.")(new)
app.command(epilog=SCHEMA_EXAMPLES, short_help="Write the JSON schema of files, for editors.")(schema)


@app.command(short_help="List the plugins and what they offer.")
def plugins(
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="NAME|FILE",
            help="Look in this profile's plugin folders, not in ./plugins.",
            autocompletion=profile_names,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the plugins: what each offers, where it comes from, why it failed to load, what else it did."""
    from labseq.cli.plugins import list_plugins

    list_plugins(profile, as_json=as_json)


@app.command(short_help="Bring every device of a profile to its safe state.")
def safe(
    profile: Annotated[
        str,
        typer.Argument(
            metavar="PROFILE",
            help="Name or file of the hardware profile.",
            show_default=False,
            autocompletion=profile_names,
        ),
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
        typer.Argument(
            metavar="PROFILE",
            help="Name or file of the hardware profile.",
            show_default=False,
            autocompletion=profile_names,
        ),
    ],
    dry_run: DryRun = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Open each device of a profile in turn, identify and test it, make it safe and close it."""
    from labseq.cli.devices import show_devices

    mode = "off" if dry_run is None else dry_run.value
    raise typer.Exit(show_devices(profile, overrides or (), mode, as_json=as_json))
