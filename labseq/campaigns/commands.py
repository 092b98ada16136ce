"""Commands for campaigns: run one, make the certificates of a cluster."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from labseq.campaigns.campaign import Campaign, PlannedRun
    from labseq.data import Run

campaign = typer.Typer(
    name="campaign",
    help="Many runs of a sequence, by this computer or a cluster.",
    short_help="Many runs of a sequence; certificates of a cluster.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@campaign.command("keys", short_help="Make the certificates of a cluster.")
def keys(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A folder without certificates.", show_default=False)
    ],
) -> None:
    """Make the certificates by which scheduler, workers and clients of a dask cluster recognise each other.

    Anyone who has one of the files can run any code on the cluster: copy them only to its machines.
    """
    from labseq.campaigns.certificates import DAYS, make_certificates
    from labseq.console.output import say
    from labseq.console.text import quoted

    ca, scheduler, worker, _ = map(quoted, make_certificates(folder))
    say(
        f"The certificates are in {quoted(folder)}, valid for {DAYS} days. Copy the folder to each machine.",
        f"  dask scheduler --protocol tls --tls-ca-file {ca} --tls-cert {scheduler} --tls-key {scheduler}",
        "  dask worker tls://SCHEDULER:8786 --nthreads 1 --nworkers 4 "
        f"--tls-ca-file {ca} --tls-cert {worker} --tls-key {worker}",
        "  labseq campaign run CAMPAIGN --output FOLDER --scheduler tls://SCHEDULER:8786 "
        f"--keys {quoted(folder)}",
    )


def run_file(
    run_session: Callable[..., None],
    file: Path,
    folder: Path,
    n_workers: int,
    scheduler: str | None,
    cluster_keys: Path | None,
) -> None:
    """Take the runs of a campaign file, and print a table.

    Args:
        run_session: Runs a session and shows it; for runs that are taken one after the other.
        file: The file.
        folder: The campaign's folder.
        n_workers: Number of runs at a time, each by a process of its own.
        scheduler: Address of a dask cluster that takes them instead.
        cluster_keys: Folder of its certificates.
    """
    from labseq.campaigns.campaign import Campaign, recorded_runs
    from labseq.campaigns.running import run_at_once, run_in_turn
    from labseq.cluster import ClusterWorkers, check_workers
    from labseq.console.output import say
    from labseq.console.report import aligned
    from labseq.console.text import plural
    from labseq.workers import ProcessWorkers

    check_workers(None if n_workers == 1 else n_workers, scheduler)
    wanted = Campaign.read(file)
    if scheduler is not None:
        run_at_once(wanted, folder, ClusterWorkers(scheduler, cluster_keys, "run"), _reporter(wanted))
    elif n_workers > 1:
        run_at_once(wanted, folder, ProcessWorkers(n_workers, "run"), _reporter(wanted))
    else:
        run_in_turn(run_session, wanted, folder)
    _, runs = recorded_runs(folder)
    rows: list[tuple[Any, ...]] = [(*wanted.axes, "shots", "filling", "runs")]
    rows += [(*wanted.values(point), *_result(runs[point])) for point in wanted.points()]
    say("", *aligned(rows), f"{plural(sum(map(len, runs.values())), 'run')} in {folder}")


def _reporter(wanted: Campaign) -> Callable[[PlannedRun, Run], None]:
    """Prints a line for each run that is complete."""
    from labseq.console.output import say

    def report(planned: PlannedRun, run: Run) -> None:
        at = ", ".join(f"{a} = {v}" for a, v in zip(wanted.axes, wanted.values(planned.point), strict=True))
        n_shots, filling, name = _result([run])
        say(": ".join(filter(None, [name, at, f"{n_shots} shots, filling {filling}"])))

    return report


def _result(runs: list[Run]) -> tuple[str, str, str]:
    """Number of shots, mean filling, and names of some runs."""
    shots = [shot for run in runs for shot in run.shots]
    fillings = [filling for shot in shots if not math.isnan(filling := shot.filling_fraction)]
    mean = f"{100 * sum(fillings) / len(fillings):.2f} %" if fillings else "-"
    first, *others = (f"{run.path.parent.name}/{run.path.name}" for run in runs)
    return str(len(shots)), mean, f"{first} to {others[-1]}" if others else first
