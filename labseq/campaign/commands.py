"""The commands of `labseq campaign`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

campaign = typer.Typer(
    name="campaign",
    help="Clusters, and runs over many values.",
    short_help="Runs over many values; certificates of a cluster.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@campaign.command(short_help="Make the certificates of a cluster.")
def keys(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A folder without certificates.", show_default=False)
    ],
) -> None:
    """Make the certificates with which scheduler, workers and clients of a dask cluster know one another.

    Anyone who has one of the files can have the cluster run any code: copy them only to its machines.
    """
    from labseq.campaign.keys import DAYS, make_keys
    from labseq.console.output import say
    from labseq.console.text import quoted

    ca, scheduler, worker, _ = map(quoted, make_keys(folder))
    say(
        f"The certificates are in {quoted(folder)}, valid for {DAYS} days. Copy the folder to each machine.",
        f"  dask scheduler --protocol tls --tls-ca-file {ca} --tls-cert {scheduler} --tls-key {scheduler}",
        "  dask worker tls://SCHEDULER:8786 --nthreads 1 --nworkers 4 "
        f"--tls-ca-file {ca} --tls-cert {worker} --tls-key {worker}",
        f"  labseq run SEQUENCE --scheduler tls://SCHEDULER:8786 --keys {quoted(folder)}",
    )
