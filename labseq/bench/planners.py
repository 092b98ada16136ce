"""Compares planners on the same random loadings, in several processes or on a cluster."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any, Final

from labseq.bench.comparison import Comparison
from labseq.bench.report import Report, make_rows
from labseq.bench.work import Job, JobResults, prepare, set_up, warm
from labseq.cluster import ClusterWorkers
from labseq.errors import LabseqError, StopRequested
from labseq.kernels.kernel import announcing, n_cores
from labseq.workers import POLL_S, QUEUED, ProcessWorkers, Workers


@contextmanager
def _signals(handler: Any, *numbers: int) -> Generator[None]:
    """Handle signals with ``handler`` inside the block. Has no effect in threads other than the main one."""
    # Python sets handlers only in the main thread
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if is_main}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


ALONE_S: Final = 2.0
"""Minimum work for a second process, in seconds: about the time to start one."""


@dataclass(frozen=True, slots=True)
class Resources:
    """The processes in which planners plan.

    Attributes:
        n_workers: Number of processes on this computer. None for one per core, if there is enough work.
        scheduler: Address of the scheduler of a dask cluster that does the work instead.
        keys: Folder of the cluster's certificates.
    """

    n_workers: int | None = None
    scheduler: str | None = None
    keys: Path | None = None


def compare(
    comparison: Comparison,
    resources: Resources = Resources(),
    *,
    announce: Callable[[float], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda _done, _wanted: None,
) -> Report:
    """Run all planners on all loadings, check every plan, and summarise the results.

    The same comparison gives the same report, except for times, with any number of
    workers. Ctrl-C or SIGTERM ends it early with the results so far.

    Args:
        comparison: Planners, conditions and loadings.
        resources: The processes in which the planners plan.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.
        progress: Called with the numbers of finished and requested loadings.

    Raises:
        ConfigError: The comparison has an error, or there is no such cluster.
        PluginLoadError: A named plugin failed to load.
    """
    start_s = time.perf_counter()
    cluster = (
        None if resources.scheduler is None else ClusterWorkers(resources.scheduler, resources.keys, "part")
    )
    prepared = set_up(comparison)
    all_results: list[JobResults] = []
    n_done = 0
    n_wanted = comparison.n_loadings * len(prepared)
    ended_by: LabseqError | None = None
    received: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        received.append(number)  # KeyboardInterrupt does not carry the number
        raise KeyboardInterrupt

    try:
        with _signals(interrupt, signal.SIGINT, signal.SIGTERM):
            with announcing(announce):
                warm(prepared)
            progress(0, n_wanted)
            with closing(_results(comparison, resources, cluster)) as results:
                for job_results in results:
                    all_results.append(job_results)
                    n_done += len(job_results.loadings)
                    progress(n_done, n_wanted)
    except KeyboardInterrupt:
        ended_by = StopRequested(received[0] if received else signal.SIGINT)
    except LabseqError as error:
        ended_by = error
    duration_s = time.perf_counter() - start_s
    rows = make_rows(comparison, prepared, all_results)
    return Report(comparison, rows, n_done, duration_s, ended_by)


def _results(comparison: Comparison, resources: Resources, cluster: Workers | None) -> Generator[JobResults]:
    """The results of all loadings, in any order. If closed early, it ends its processes at once."""
    n_workers = resources.n_workers or n_cores()
    jobs = _jobs(comparison, n_workers)
    if cluster is None and n_workers > 1 and resources.n_workers is None:
        jobs = yield from _begun(comparison, jobs)
        n_workers = min(n_workers, len(jobs))
    if cluster is None and n_workers <= 1:
        yield from map(prepare(comparison), jobs) if jobs else ()
        return
    remaining = iter(enumerate(jobs))
    workers = cluster or ProcessWorkers(n_workers, "part")
    with closing(workers):
        workers.prepare(prepare, comparison)
        n_out = 0
        while True:
            for number, job in islice(remaining, max(0, QUEUED * workers.n_workers - n_out)):
                workers.submit(number, job)
                n_out += 1
            if not n_out:
                return
            for _, job_results in workers.finished(POLL_S):
                n_out -= 1
                yield job_results


def _begun(comparison: Comparison, jobs: list[Job]) -> Generator[JobResults, None, list[Job]]:
    """Do jobs in this process until a second process is worth starting. Returns the remaining jobs."""
    start_s, n_done = time.perf_counter(), 0
    for job_results in map(prepare(comparison), jobs):
        yield job_results
        n_done += 1
        if time.perf_counter() - start_s > ALONE_S:
            break
    return jobs[n_done:]


def _jobs(comparison: Comparison, n_workers: int) -> list[Job]:
    """Divide the work into jobs, several for every process.

    The first loadings of all conditions come first, so that about the same share
    of each condition is done at any time.
    """
    n_loadings, n_conditions = comparison.n_loadings, len(comparison.conditions)
    # at most 50: workers lose their current jobs when a comparison is stopped
    size = min(50, n_loadings, -(-n_loadings * n_conditions // (4 * n_workers)))
    return [
        Job(condition, start, min(start + size, n_loadings))
        for start in range(0, n_loadings, size)
        for condition in range(n_conditions)
    ]
