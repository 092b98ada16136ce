"""The command line: all commands and their options. A command's code is imported when it runs."""

from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from labseq import __version__
from labseq.analysis.commands import (
    ANALYSE_EXAMPLES,
    COMPARE_EXAMPLES,
    PLOT_EXAMPLES,
    REPLAY_EXAMPLES,
    TREND_EXAMPLES,
    analyse,
    compare,
    plot,
    replay,
    trend,
)
from labseq.bench.commands import bench
from labseq.calibration.commands import CALIBRATE_EXAMPLES, calibrate, calibration
from labseq.campaigns.commands import campaign
from labseq.console.options import (
    Along,
    DataFolder,
    DryRun,
    FitName,
    FitSettings,
    Json,
    Keys,
    Note,
    OfSequence,
    Output,
    Overrides,
    Plugins,
    Profile,
    ProfileArgument,
    Realtime,
    RunFolder,
    ScanQuantities,
    Scheduler,
    Search,
    Seed,
    SequenceFile,
    Shots,
    Since,
    Tags,
    Until,
    Where,
    WhereRuns,
    WithStatus,
    WithTag,
    Workers,
    dry_run_mode,
    profile_option,
    run_argument,
    whole_number_option,
)
from labseq.plans.commands import PLAN_EXAMPLES, WAVEFORM_EXAMPLES, plan, waveform
from labseq.queue.commands import queue
from labseq.remote.commands import SERVE_EXAMPLES, keys, serve_devices
from labseq.scaffold.commands import (
    EXPLAIN_EXAMPLES,
    NEW_EXAMPLES,
    SCHEMA_EXAMPLES,
    explain,
    new,
    schema,
)
from labseq.web.commands import WEB_EXAMPLES, web as show_web

RUN_EXAMPLES: Final = """\b
Examples:
  labseq run sequences/compact_225.yaml
  labseq run sequences/compact_225.yaml --shots 5 --seed 1 --json
  labseq run sequences/compact_225.yaml --profile lab --dry-run
  labseq run sequences/compact_225.yaml --set planner.degree_of_parallelism=2 --set shot.2.rearrange.window="200 ms"
"""  # noqa: E501 - a command line to copy
RESUME_EXAMPLES: Final = """\b
Examples:
  labseq resume data/2026-01-02/0001_compact-225
  labseq resume data/2026-01-02/0001_compact-225 --accept-changes
  labseq resume 75 --shots 400
"""
RERUN_EXAMPLES: Final = """\b
Examples:
  labseq rerun 75
  labseq rerun 2026-11-20/75 --same-seed --note "with the new camera"
"""
RUNS_EXAMPLES: Final = """\b
Examples:
  labseq runs
  labseq runs --sequence lifetime --since 2026-11-01 --where "decay > 20 s"
  labseq runs --search "new lens" --sort decay
  labseq show kagome
"""
NOTE_EXAMPLES: Final = """\b
Examples:
  labseq note 75 "new objective"
  labseq note 75 --tag lifetime --tag good
"""
EXPORT_EXAMPLES: Final = """\b
Examples:
  labseq export --to csv
  labseq export data/2026-11-20/0001_compact-225 --to netcdf -o compact.nc
  labseq export data/2026-11-20/0001_compact-225 --to archive --frames
"""
CONTACT_EXAMPLES: Final = """\b
Examples:
  labseq first-contact mylab mobile_tweezers
  labseq first-contact mylab mobile_tweezers --with scope --step overwrite
  labseq first-contact bench_awg --yes
"""
LEADER_EXAMPLES: Final = """\b
Examples:
  labseq leader-test
  labseq leader-test 192.168.1.20 --token leader.token --shots 100
"""
DOCTOR_EXAMPLES: Final = """\b
Examples:
  labseq doctor --dry-run
  labseq doctor data/2026-11-20/0001_compact-225
"""

app = typer.Typer(
    name="labseq",
    help="Lab control for neutral-atom tweezer arrays: YAML sequences in, one HDF5 file per shot out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
        bool, typer.Option("--debug", help="Print the traceback of an error. Also allowed after the command.")
    ] = False,
) -> None:
    """Declare the options before the command. ``main`` reads ``--debug`` itself."""


app.add_typer(bench)
app.add_typer(calibration)
app.add_typer(keys)
app.add_typer(campaign)
app.add_typer(queue)
app.command(epilog=CALIBRATE_EXAMPLES, short_help="Calibrate sites, tones, timing and more.")(calibrate)


@app.command(short_help="Run an example sequence on simulated hardware.")
def demo(
    shots: Annotated[
        int | None, whole_number_option("Number of shots (default 10).", show_default=False)
    ] = None,
    output: Output = None,
    copy: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Only copy the packaged sequences and profiles to this folder, for you to change.",
        ),
    ] = None,
) -> None:
    """Run a sequence that comes with labseq on simulated hardware: a first look that needs no files."""
    from labseq.cli.run import copy_files, run_demo

    if copy is None:
        run_demo(shots, output)
        return
    if shots is not None or output is not None:
        raise typer.BadParameter("it only copies files; leave out --shots and --output", param_hint="--copy")
    copy_files(copy)


@app.command(epilog=RUN_EXAMPLES, short_help="Run a sequence and record every shot.")
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
    note: Note = "",
    tags: Tags = None,
    web: Annotated[
        bool, typer.Option("--web", help="Also show the run in a browser, as `labseq web` does.")
    ] = False,
    _plugins: Plugins = None,
) -> None:
    """Run a sequence and record every shot."""
    from labseq.assembly.options import Options
    from labseq.cli.run import run_sequence

    changes = tuple(overrides or ())
    dry_run_kind, given_tags = dry_run_mode(dry_run), tuple(tags or ())
    options = Options(profile, shots, seed, changes, output, dry_run_kind, realtime, note, given_tags)
    run_sequence(sequence, options, as_json=as_json, web=web)


@app.command(epilog=RESUME_EXAMPLES, short_help="Resume a run that ended early, or add shots to a run.")
def resume(
    run: Annotated[Path, run_argument("The run's folder, name or number.")],
    shots: Annotated[
        int | None,
        whole_number_option(
            "New total number of shots, also for a complete run. When a scan is through, it starts over."
        ),
    ] = None,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Resume even if code, plugins or settings have changed since. run.json records the changes.",
        ),
    ] = False,
    as_json: Json = False,
    realtime: Realtime = False,
    _plugins: Plugins = None,
) -> None:
    """Take the missing shots of a run that was stopped, failed or crashed, or more shots."""
    from labseq.cli.run import resume_run

    options = {"shots": shots, "accept_changes": accept_changes, "realtime": realtime}
    resume_run(run, options, as_json=as_json)


@app.command(epilog=RERUN_EXAMPLES, short_help="Take a run again.")
def rerun(
    run: Annotated[Path, run_argument("The run's folder, name or number.")],
    same_seed: Annotated[bool, typer.Option("--same-seed", help="Use the same random numbers.")] = False,
    shots: Annotated[
        int | None, whole_number_option("Number of shots, if not the same as in the earlier run.")
    ] = None,
    output: Output = None,
    note: Note = "",
    tags: Tags = None,
    as_json: Json = False,
    realtime: Realtime = False,
    _plugins: Plugins = None,
) -> None:
    """Take a run again as a new run with the same sequence, profile and options.

    The sequence and profile are read as they were when the earlier run began, but plugins and calibrations as
    they are now. Whatever differs from the earlier run is printed before the first shot.
    """
    from labseq.cli.run import rerun_run

    options = {"same_seed": same_seed, "shots": shots, "output": output, "realtime": realtime}
    rerun_run(run, {**options, "note": note, "tags": tuple(tags or ())}, as_json=as_json)


@app.command(short_help="End a run in progress after its current shot.")
def stop(
    run: Annotated[
        Path | None, run_argument("The run's folder, name or number. Default: the run in progress.")
    ] = None,
    profile: Annotated[str | None, profile_option("Stop the run that uses this profile.")] = None,
    queue: Annotated[
        bool, typer.Option("--queue", help="Also keep `labseq queue run` from starting another entry.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the run has ended.")] = False,
) -> None:
    """Ask a run in progress to end after its current shot. Its devices are then made safe."""
    from labseq.cli.run import stop_run

    stop_run(run, profile, queue=queue, wait=wait)


@queue.command("run", short_help="Run the queued entries one after the other.")
def run_queue(
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Continue with the next entry if one fails.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Wait for new entries when the queue is empty, until stopped.")
    ] = False,
    _plugins: Plugins = None,
) -> None:
    """Run the queued entries one after the other. An interrupted run is resumed first."""
    from labseq.cli.run import calibrate_for_queue, run_session
    from labseq.queue.running import run_entries

    run = partial(run_session, as_json=False)
    raise typer.Exit(run_entries(run, calibrate_for_queue, keep_going=keep_going, watch=watch))


@campaign.command("run", short_help="Take the runs of a campaign file.")
def run_campaign(
    file: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="The file.", show_default=False)],
    output: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the campaign.", show_default=False)],
    netcdf: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the results of all points here, like labseq export."),
    ] = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
    keys: Keys = None,
    _plugins: Plugins = None,
) -> None:
    """Run a sequence at each point of a grid of values, with one or more runs per point.

    The same command continues a stopped campaign.
    """
    from labseq.analysis.campaigns import export_campaign, results_of
    from labseq.campaigns.commands import run_file
    from labseq.cli.run import run_session
    from labseq.console.output import check_writable
    from labseq.data.tables import check_installed

    folder = output.expanduser()
    if netcdf is not None:  # before the first run
        check_installed("xarray", "h5netcdf")
        check_writable(netcdf)
    run_file(partial(run_session, as_json=False), file, folder, workers, scheduler, keys, results_of)
    if netcdf is not None:
        export_campaign(folder, netcdf)


@app.command(short_help="Check a sequence and print its timeline and limits.")
def check(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    overrides: Overrides = None,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Print every error and warning of a sequence, its timeline and its limits. No device is opened."""
    from labseq.cli.check import check_sequence

    check_sequence(sequence, profile, overrides or (), dry_run_mode(dry_run), as_json=as_json)


@app.command(epilog=RUNS_EXAMPLES, short_help="List the runs in a data folder.")
def runs(
    data: DataFolder = None,
    search: Search = "",
    since: Since = "",
    until: Until = "",
    sequence: OfSequence = "",
    tag: WithTag = "",
    status: WithStatus = "",
    where: WhereRuns = None,
    sort: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Sort by a result, a changed setting or the number of shots, the greatest last. With -NAME "
            "the least comes last. Default: by time, the newest last.",
        ),
    ] = "",
    limit: Annotated[int, typer.Option(metavar="N", min=1, help="At most N runs, the last ones.")] = 20,
    as_json: Json = False,
) -> None:
    """List the runs in a data folder, the newest last, with scans, results and notes.

    Every command accepts the name in the first column. A run's number or the name of its sequence also
    works and means the newest such run.
    """
    from labseq.cli.runs import RunQuery, list_runs

    conditions = {"since": since, "until": until, "sequence": sequence, "tag": tag, "status": status}
    query = RunQuery({**conditions, "search": search, "where": where or ()}, sort, limit)
    list_runs(data, query, as_json=as_json)


@app.command(epilog=NOTE_EXAMPLES, short_help="Write a note about a run, or tag it.")
def note(
    run: Annotated[Path, run_argument("The run's folder, name or number.")],
    text: Annotated[
        str | None,
        typer.Argument(metavar="TEXT", help="The new note. '' removes the present note.", show_default=False),
    ] = None,
    tags: Tags = None,
    untag: Annotated[
        list[str] | None,
        typer.Option(metavar="TAG", help="Remove a tag. May be given several times."),
    ] = None,
) -> None:
    """Write a note about a run or tag it, finished or not. Its note and tags are then printed.

    labseq runs and the web page show notes and tags, and search them.
    """
    from labseq.cli.runs import write_note

    write_note(run, text, tags or (), untag or ())


app.command(epilog=SERVE_EXAMPLES, short_help="Serve devices to a labseq on another computer.")(serve_devices)
app.command(epilog=WEB_EXAMPLES, name="web", short_help="Show runs, queue and calibrations in a browser.")(
    show_web
)
app.command(epilog=PLAN_EXAMPLES, short_help="Plan the moves for one occupancy. Print or draw them.")(plan)
app.command(epilog=WAVEFORM_EXAMPLES, short_help="Show what the AWG would play for a plan.")(waveform)


@app.command(short_help="Show what a run has recorded.")
def show(
    run: RunFolder = None,
    shots: Annotated[bool, typer.Option("--shots", help="Print a row for every shot.")] = False,
    timing: Annotated[
        bool, typer.Option("--timing", help="Print a row with budget and duration for each stage of a shot.")
    ] = False,
    scan: ScanQuantities = None,
    where: Where = None,
    fit: FitName = None,
    fit_set: FitSettings = None,
    along: Along = None,
    devices: Annotated[bool, typer.Option("--devices", help="Print the description of each device.")] = False,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Show what a run has recorded, finished or not, as a summary or as the tables that you choose.

    Shots, attempts, cycles and scan points are counted from 0.
    """
    from labseq.analysis.scanned import scan_request
    from labseq.cli.show import Tables, show_run

    wanted = scan_request(scan, fit, fit_set, along)
    show_run(run, as_json=as_json, tables=Tables(shots, timing, wanted, devices), where=where)


@app.command(short_help="Watch a run that another process takes.")
def watch(
    run: RunFolder = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Then wait for the next run and watch it, until Ctrl-C.")
    ] = False,
) -> None:
    """Watch a run that another process takes, until it ends. Ctrl-C ends only the view."""
    from labseq.cli.watch import watch_run

    watch_run(run, follow=follow)


@app.command(short_help="Send a notice, to try notify.yaml.")
def notify(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="The text.")] = "a test of notify.yaml",
) -> None:
    """Send a notice in every way that notify.yaml in the data folder names, and print what failed."""
    from labseq.cli.run import try_notice

    try_notice(text)


app.command(epilog=PLOT_EXAMPLES, short_help="Draw a run, or one of its shots.")(plot)
app.command(epilog=COMPARE_EXAMPLES, short_help="Compare what several runs have measured.")(compare)
app.command(epilog=TREND_EXAMPLES, short_help="Follow a number over the runs of days or weeks.")(trend)
app.command(epilog=REPLAY_EXAMPLES, short_help="Try another planner or detector on a run's images.")(replay)
app.command(epilog=ANALYSE_EXAMPLES, short_help="Analyse the shots of a run.")(analyse)


@app.command(epilog=EXPORT_EXAMPLES, short_help="Export a run as CSV, Parquet, netCDF or HDF5.")
def export(
    run: RunFolder = None,
    to: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="csv|parquet|netcdf|archive",
            help="Kind of file. A table of the shots (csv, parquet), a table with occupancies on the axes "
            "of the scan (netcdf), or everything in one HDF5 file (archive). Default: csv, or netcdf for "
            "a campaign.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Name of the file. Default: named after the run, in the current folder.",
        ),
    ] = None,
    frames: Annotated[bool, typer.Option("--frames", help="Include the frames. Only for archive.")] = False,
    scan: ScanQuantities = None,
    where: Where = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
) -> None:
    """Export a run, or all runs of a campaign's folder, to one file that other programs can read.

    With --scan (only csv): a row per point of the scan, with scanned values, shots, means and intervals.
    """
    from labseq.analysis.scanned import scan_request
    from labseq.cli.data import export_points, export_to

    wanted = scan_request(scan)
    if wanted is not None:
        export_points(run, to or "csv", output, wanted, where, replace=force)
        return
    raise typer.Exit(export_to(run, to, output, where, frames=frames, replace=force))


@app.command(epilog=DOCTOR_EXAMPLES, short_help="Find and repair damage in recorded data.")
def doctor(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATA",
            help="A data folder or one run. Default: LABSEQ_DATA or ./data.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Report without changing anything.")] = False,
    as_json: Json = False,
) -> None:
    """Find damage to recorded data from crashes and faulty disks, and repair it where possible."""
    from labseq.cli.data import examine

    raise typer.Exit(examine(data, dry_run=dry_run, as_json=as_json))


app.command(epilog=NEW_EXAMPLES, short_help="Make a plugin, sequence or profile that runs at once.")(new)
app.command(epilog=SCHEMA_EXAMPLES, short_help="Write the JSON schema of files, for editors.")(schema)
app.command(epilog=EXPLAIN_EXAMPLES, short_help="Explain a key, a step, a plugin, a command, an error.")(
    explain
)


@app.command(short_help="List the plugins and what they offer.")
def plugins(
    profile: Annotated[
        str | None, profile_option("Also load the plugins in this profile's plugin folders.")
    ] = None,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """List the plugins: what each offers, where it comes from, and why it was not loaded."""
    from labseq.cli.plugins import list_plugins

    list_plugins(profile, as_json=as_json)


@app.command(short_help="Bring every device of a profile to its safe state.")
def safe(
    profile: ProfileArgument,
    end: Annotated[
        bool | None,
        typer.Option(
            "--end/--no-end",
            help="First end a process that uses the devices. Default: ask in a terminal, otherwise end it.",
            show_default=False,
        ),
    ] = None,
    wait: Annotated[
        bool,
        typer.Option(
            "--stand-by",
            help="Wait until Ctrl-C, and make a device safe if its process hangs for 5 s or dies before "
            "making it safe.",
        ),
    ] = False,
    overrides: Overrides = None,
    _plugins: Plugins = None,
) -> None:
    """Open every device of a profile, bring it to its safe state, and close it."""
    from labseq.cli.devices import secure_profile, stand_by_for

    if wait and end:
        raise typer.BadParameter("--stand-by never ends a process that still answers; leave out --end")
    if wait:
        stand_by_for(profile, overrides or ())
        return
    raise typer.Exit(secure_profile(profile, overrides or (), end=end))


@app.command(short_help="Test every device of a profile, as first command of the day.")
def devices(
    profile: ProfileArgument,
    dry_run: DryRun = None,
    overrides: Overrides = None,
    as_json: Json = False,
    _plugins: Plugins = None,
) -> None:
    """Open each device of a profile in turn, identify and test it, make it safe and close it."""
    from labseq.cli.devices import show_devices

    raise typer.Exit(show_devices(profile, overrides or (), dry_run_mode(dry_run), as_json=as_json))


@app.command(epilog=CONTACT_EXAMPLES, short_help="Prove on a new device what its driver assumes.")
def first_contact(
    profile: ProfileArgument,
    role: Annotated[
        str,
        typer.Argument(
            metavar="ROLE", help="The device, such as mobile_tweezers. Default: every device in turn."
        ),
    ] = "",
    steps: Annotated[
        list[str] | None,
        typer.Option(
            "--step",
            metavar="NAME",
            help="Take only this step, and keep the earlier results of the others. May be repeated.",
        ),
    ] = None,
    instruments: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="scope|reference",
            help="A connected instrument, which labseq then need not ask about. May be repeated.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before each step. Readings are still asked for.")
    ] = False,
    output: Output = None,
    dry_run: DryRun = None,
    overrides: Overrides = None,
    _plugins: Plugins = None,
) -> None:
    """Measure what the driver of a device assumes, step by step, and write a file with the verdict.

    labseq asks before each step, says what the outputs will do, and makes the device safe after the step.
    Amplifiers must not be connected.
    """
    from labseq.cli.first_contact import Wanted, meet
    from labseq.files import data_root

    wanted, kind = Wanted(role, steps or (), output or data_root()), dry_run_mode(dry_run)
    raise typer.Exit(meet(profile, wanted, overrides or (), kind, instruments=instruments or (), yes=yes))


@app.command(epilog=LEADER_EXAMPLES, short_help="Test a run that another control system leads.")
def leader_test(
    host: Annotated[
        str, typer.Argument(metavar="HOST", help="Computer on which the run waits for `go`.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(metavar="N", min=1, max=65535, help="The `port` of its device tcp_leader.")
    ] = 5750,
    token: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="leader.token from that computer. Default: the one in this computer's state folder.",
        ),
    ] = None,
    shots: Annotated[
        int | None,
        whole_number_option("Take N shots of the run, at least 3. They move atoms and count as shots."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Lead a run in place of the control system, correctly and with errors, and time its answers.

    It tries wrong tokens, garbage, lines that are too long, slow and closed connections, and two leaders. It
    prints a histogram of the response times. Without --shots it takes no shot. The control system must
    not be connected meanwhile.
    """
    from labseq.cli.leader_test import MIN_SHOTS, play_leader

    if shots is not None and shots < MIN_SHOTS:
        raise typer.BadParameter(f"{shots} is too few; expected {MIN_SHOTS} or more", param_hint="--shots")
    raise typer.Exit(play_leader(host, port, token, shots or 0, as_json=as_json))
