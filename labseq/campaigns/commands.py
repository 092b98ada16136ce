"""Commands for campaigns: run one, and make the certificates of a cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from labseq.campaigns.campaign import Campaign, PlannedRun, Point
    from labseq.data.reader import Run

campaign = typer.Typer(
    name="campaign",
    help="Many runs of a sequence, by this computer or a cluster.",
    short_help="Many runs of a sequence, and certificates of a cluster.",
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

    Anyone who has one of the files can run any code on the cluster, so copy them only to its machines.
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
    results_of: Callable[[Sequence[Run]], Mapping[str, str]],
) -> None:
    """Take the runs of a campaign file, and print a table.

    Args:
        run_session: Runs and shows a session, for runs that are taken one after the other.
        n_workers: Number of simultaneous runs, each in its own process.
        scheduler: Address of a dask cluster that takes the runs instead.
        cluster_keys: Folder of its certificates.
        results_of: Some runs -> their results: name -> mean, as text.

    Raises:
        AlarmError: Alarms ended some of the runs.
    """
    from labseq.campaigns.campaign import Campaign, recorded_runs
    from labseq.campaigns.running import run_at_once, run_in_turn
    from labseq.cluster import ClusterWorkers, check_workers
    from labseq.console.output import say
    from labseq.console.report import aligned
    from labseq.console.text import plural
    from labseq.errors import AlarmError
    from labseq.workers import ProcessWorkers

    check_workers(None if n_workers == 1 else n_workers, scheduler)
    wanted = Campaign.read(file)
    report = _reporter(wanted, results_of)
    if scheduler is not None:
        alarms = run_at_once(wanted, folder, ClusterWorkers(scheduler, cluster_keys, "run"), report)
    elif n_workers > 1:
        alarms = run_at_once(wanted, folder, ProcessWorkers(n_workers, "run"), report)
    else:
        alarms = run_in_turn(run_session, wanted, folder)
    _, runs = recorded_runs(folder)
    n_runs = plural(sum(map(len, runs.values())), "run")
    say("", *aligned(_rows(wanted, runs, results_of)), f"{n_runs} in {folder}")
    if alarms:
        text = f"{alarms[0].text}; alarms ended {len(alarms)} of {n_runs}, and the others continued"
        raise AlarmError(alarms[0].alarm, text, alarms[0].n_shots)


def _rows(
    wanted: Campaign,
    runs: Mapping[Point, Sequence[Run]],
    results_of: Callable[[Sequence[Run]], Mapping[str, str]],
) -> list[tuple[str, ...]]:
    """A row for each point of a campaign, with the results of its runs, below the heads of the columns."""
    results = {point: results_of(runs[point]) for point in wanted.points()}
    names = [*dict.fromkeys(name for means in results.values() for name in means)]
    rows: list[tuple[str, ...]] = [(*wanted.axes, "shots", *names, "runs")]
    for point, means in results.items():
        measured = [means.get(name, "-") for name in names]
        rows.append((*wanted.values(point), _n_shots(runs[point]), *measured, _names(runs[point])))
    return rows


def _reporter(
    wanted: Campaign, results_of: Callable[[Sequence[Run]], Mapping[str, str]]
) -> Callable[[PlannedRun, Run], None]:
    """Make a function that prints a line for each run that is over."""
    from labseq.console.output import say

    def report(planned: PlannedRun, run: Run) -> None:
        at = ", ".join(f"{a} = {v}" for a, v in zip(wanted.axes, wanted.values(planned.point), strict=True))
        means = [f"{name} {mean}" for name, mean in results_of([run]).items()]
        ended = [] if run.status == "complete" else [f"{run.status}: {run.error}"]
        results = ", ".join([f"{_n_shots([run])} shots", *means, *ended])
        say(": ".join(filter(None, [_names([run]), at, results])))

    return report


def _n_shots(runs: Sequence[Run]) -> str:
    return str(sum(len(run.shots) for run in runs))


def _names(runs: Sequence[Run]) -> str:
    """The names of some runs: the first and the last."""
    names = [f"{run.path.parent.name}/{run.path.name}" for run in runs]
    return " to ".join(dict.fromkeys([*names[:1], *names[-1:]]))
