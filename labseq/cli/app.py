"""The command line: which commands there are; their code is imported when they run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from labseq import __version__
from labseq.analysis.commands import ANALYSE_EXAMPLES, REPLAY_EXAMPLES, analyse, replay
from labseq.bench.commands import bench
from labseq.calibration.commands import CALIBRATE_EXAMPLES, calibrate, calibration
from labseq.cli import plan_options, plot_options, show_options, waveform_options
from labseq.console.options import (
    DryRun,
    Json,
    Output,
    Overrides,
    Profile,
    Realtime,
    RunFolder,
    Seed,
    SequenceFile,
    Shots,
    profile_names,
    run_folders,
    run_options,
)
from labseq.queue.commands import queue
from labseq.scaffold.commands import NEW_EXAMPLES, SCHEMA_EXAMPLES, new, schema

EXPORT_EXAMPLES: Final = """\b
Examples:
  labseq export --to csv
  labseq export data/2026-11-20/0001_compact-225 --to netcdf -o compact.nc
  labseq export data/2026-11-20/0001_compact-225 --to archive --frames
"""

DOCTOR_EXAMPLES: Final = """\b
Examples:
  labseq doctor --dry-run
  labseq doctor data/2026-11-20/0001_compact-225
"""


def export(
    run: RunFolder = None,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="csv|parquet|netcdf|archive",
            help="Kind of file: a table of the shots (csv, parquet), a table with occupancies on the axes of "
            "the scan (netcdf), or everything in one HDF5 file (archive).",
        ),
    ] = "csv",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The file; by default one named after the run, here."
        ),
    ] = None,
    frames: Annotated[bool, typer.Option("--frames", help="Keep the frames, too; archive only.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
) -> None:
    """Export a run to one file that other programs read."""
    from labseq.cli.data import export_to

    raise typer.Exit(export_to(run, to, output, frames=frames, replace=force))


def doctor(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATA",
            help="A data folder or one run; LABSEQ_DATA or ./data by default.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell; change nothing.")] = False,
    as_json: Json = False,
) -> None:
    """Find what crashes and faulty disks did to recorded data, and repair what can be repaired."""
    from labseq.cli.data import examine

    raise typer.Exit(examine(data, dry_run=dry_run, as_json=as_json))


def demo(
    shots: Annotated[
        int | None, typer.Option(metavar="N", help="Number of shots; 10 by default.", show_default=False)
    ] = None,
    output: Output = None,
    copy: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Run nothing; copy the sequences and profiles that come with labseq there, to be changed.",
        ),
    ] = None,
) -> None:
    """Run a sequence that comes with labseq on its virtual lab: a first look, without any file."""
    if copy is None:
        from labseq.cli.run import run_demo

        run_demo(shots, output)
        return
    if shots is not None or output is not None:
        raise typer.BadParameter("it runs nothing; leave out --shots and --output", param_hint="--copy")
    from labseq.cli.run import copy_files

    copy_files(copy)


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
    from labseq.cli.run import stop_run

    stop_run(run, profile, queue=queue, wait=wait)


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
    from labseq.bench.waveform import WaveformRequest
    from labseq.cli.waveform import WaveformOutput, show_waveform
    from labseq.session import PlanRequest

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
    from labseq.cli.live import watch_run

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
    from labseq.analysis.terminal import PlotRequest, plot_run

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
    from labseq.cli.devices import list_plugins

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
    from labseq.cli.devices import secure_profile

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
