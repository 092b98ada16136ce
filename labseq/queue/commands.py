"""The commands of `labseq queue`, except `labseq queue run`, which is in `labseq.cli.app`."""

from typing import Annotated, Literal

import typer

from labseq.console.options import (
    DryRun,
    Json,
    Note,
    Output,
    Overrides,
    Plugins,
    Profile,
    Realtime,
    Seed,
    SequenceFile,
    Shots,
    Tags,
    dry_run_mode,
)
from labseq.files import data_root

queue = typer.Typer(
    name="queue",
    help="Queue runs, to be taken one after the other.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

ADD_EXAMPLES = """\b
Examples:
  labseq queue add sequences/compact_225.yaml
  labseq queue add sequences/scan_dop.yaml --shots 8 --profile lab
  labseq queue add lifetime --if-fails skip --until 06:00 --needs thresholds=2h
  labseq queue run
"""

Id = Annotated[
    int,
    typer.Argument(
        metavar="ID", help="Number of the entry, as `labseq queue list` prints it.", show_default=False
    ),
]


@queue.command(epilog=ADD_EXAMPLES, short_help="Check a sequence and add it to the queue.")
def add(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    shots: Shots = None,
    seed: Seed = None,
    overrides: Overrides = None,
    output: Output = None,
    realtime: Realtime = False,
    if_fails: Annotated[
        Literal["stop", "skip", "retry"],
        typer.Option(
            "--if-fails", help="If this run fails, end the queue, skip it, or resume it once and go on."
        ),
    ] = "stop",
    until: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Begin no shot after this time, such as 06:00 or '2026-11-30 06:00'.",
            show_default=False,
        ),
    ] = None,
    needs: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=AGE",
            help="Calibrate first unless the calibration in use is younger than this, such as thresholds=2h.",
            show_default=False,
        ),
    ] = None,
    note: Note = "",
    tags: Tags = None,
    _plugins: Plugins = None,
) -> None:
    """Check a sequence and add it at the end of the queue.

    The entry keeps the present text of the sequence. Later changes of the file do not affect it.
    """
    from labseq.assembly.options import Options
    from labseq.queue.running import add_entry, rules_from

    changes, dry_run_kind, given_tags = tuple(overrides or ()), dry_run_mode(dry_run), tuple(tags or ())
    options = Options(profile, shots, seed, changes, output, dry_run_kind, realtime, note, given_tags)
    add_entry(sequence, options, rules_from(if_fails, until, needs or ()))


@queue.command(name="list", short_help="List the entries in order.")
def list_(as_json: Json = False) -> None:
    """List in order the entries that were completed since yesterday, that ended early, and that wait."""
    from labseq.queue.listing import list_entries

    list_entries(as_json=as_json)


@queue.command(short_help="Remove entries from the queue.")
def remove(
    ids: Annotated[
        list[int], typer.Argument(metavar="ID...", help="Numbers of the entries.", show_default=False)
    ],
) -> None:
    """Remove entries from the queue. The data of their runs stay."""
    from labseq.queue.queue import Queue

    Queue(data_root()).remove(ids)


@queue.command(short_help="Put a stopped, failed or skipped entry back into the queue.")
def resume(entry: Id) -> None:
    """Put a stopped, failed or skipped entry back into the queue, which then resumes its run."""
    from labseq.queue.queue import Queue

    Queue(data_root()).wait_again(entry)


@queue.command(short_help="Move an entry before another one.")
def move(
    entry: Id,
    before: Annotated[int, typer.Option("--before", metavar="ID", help="The entry that will follow it.")],
) -> None:
    """Move an entry before another one."""
    from labseq.queue.queue import Queue

    Queue(data_root()).move(entry, before)


@queue.command(short_help="Start no further entry until the queue is continued.")
def pause(
    off: Annotated[bool, typer.Option("--off", help="Continue with the next entry.")] = False,
) -> None:
    """Let `labseq queue run` wait before its next entry. A run in progress continues to its end."""
    from labseq.queue.running import pause_queue

    pause_queue(not off)
