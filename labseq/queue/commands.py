"""`labseq queue`."""

from __future__ import annotations

from typing import Annotated

import typer

from labseq.console.options import (
    DryRun,
    Json,
    Output,
    Overrides,
    Profile,
    Realtime,
    Seed,
    SequenceFile,
    Shots,
    run_options,
)

queue = typer.Typer(
    name="queue",
    help="Take runs one after the other.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

ADD_EXAMPLES = """\b
Examples:
  labseq queue add sequences/compact_225.yaml
  labseq queue add sequences/scan_dop.yaml --shots 8 --profile lab
  labseq queue run
"""

Id = Annotated[int, typer.Argument(metavar="ID", help="Number of the entry.", show_default=False)]


@queue.command(epilog=ADD_EXAMPLES, short_help="Check a sequence and add it at the end.")
def add(
    sequence: SequenceFile,
    profile: Profile = None,
    dry_run: DryRun = None,
    shots: Shots = None,
    seed: Seed = None,
    overrides: Overrides = None,
    output: Output = None,
    realtime: Realtime = False,
) -> None:
    """Check a sequence as labseq check does, and add it at the end; it will run as it is written now."""
    from labseq.queue.terminal import add_entry

    options = run_options(
        profile=profile,
        dry_run=dry_run,
        shots=shots,
        seed=seed,
        overrides=overrides,
        output=output,
        realtime=realtime,
    )
    add_entry(sequence, options)


@queue.command(name="list", short_help="List what is queued, in order.")
def list_(as_json: Json = False) -> None:
    """List what is queued in the order in which it will be taken, and what ended early."""
    from labseq.queue.terminal import list_entries

    list_entries(as_json=as_json)


@queue.command(short_help="Take entries out of the queue.")
def remove(
    ids: Annotated[
        list[int], typer.Argument(metavar="ID...", help="Numbers of the entries.", show_default=False)
    ],
) -> None:
    """Take entries out of the queue; what their runs have recorded stays."""
    from labseq.queue.terminal import remove_entries

    remove_entries(ids)


@queue.command(short_help="Put an entry before another one.")
def move(
    entry: Id,
    before: Annotated[int, typer.Option("--before", metavar="ID", help="The entry that it is put before.")],
) -> None:
    """Put an entry before another one."""
    from labseq.queue.terminal import move_entry

    move_entry(entry, before)


@queue.command(short_help="Run what is queued, one after the other.")
def run(
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Go on with the next entry after one that failed.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Wait for new entries when none is left, until stopped.")
    ] = False,
) -> None:
    """Run what is queued, one after the other; a run that was interrupted is resumed first."""
    from labseq.queue.terminal import run_entries

    raise typer.Exit(run_entries(keep_going=keep_going, watch=watch))
