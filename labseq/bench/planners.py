"""Compares planners on the same random loadings, in several processes."""

from __future__ import annotations

import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any, Final, cast

from labseq.bench.comparison import Comparison
from labseq.bench.report import Report, make_rows
from labseq.bench.work import Done, Job, prepare, set_up, warm
from labseq.errors import LabseqError, StopRequested
from labseq.kernel import announcing, n_cores

_LOOK_S: Final = 0.1
"""Interval at which waiting for results is interrupted, in seconds: on Windows, Ctrl-C does not end it."""
_FAREWELL_S: Final = 1.0


def run_jobs(comparison: Comparison, jobs: Iterable[Job], n_workers: int) -> Generator[Done]:
    """Run all jobs; one worker runs them in this process.

    Yields:
        The results of each job, as soon as it is done. A generator that is closed early
        ends its processes at once.

    Raises:
        LabseqError: A process died.
    """
    if n_workers == 1:
        yield from map(prepare(comparison), jobs)
        return
    workers: dict[Connection, BaseProcess] = {}
    try:
        with _signals(signal.SIG_IGN, signal.SIGINT):  # which the processes then ignore, too
            for _ in range(n_workers):
                connection, process = _start(comparison)
                workers[connection] = process
        yield from _hand_out(workers, iter(jobs))
    finally:
        _stop_workers(workers)


def _start(comparison: Comparison) -> tuple[Connection, BaseProcess]:
    context: Any = multiprocessing.get_context("spawn")  # the same everywhere, and no locks are inherited
    ours, theirs = context.Pipe()
    process: BaseProcess = context.Process(target=_serve, args=(theirs, comparison), daemon=True)
    process.start()
    theirs.close()
    return ours, process


def _hand_out(workers: dict[Connection, BaseProcess], jobs: Iterator[Job]) -> Generator[Done]:
    """Give every process one job at a time until all are done."""
    idle = list(workers)
    busy: list[Connection] = []
    connection = idle[0]
    try:
        while True:
            for connection, job in zip(idle, jobs, strict=False):
                connection.send(job)
                busy.append(connection)
            if not busy:
                return
            idle = [cast("Connection", ready) for ready in wait(busy, _LOOK_S)]
            for connection in idle:
                busy.remove(connection)
                yield connection.recv()
    except (EOFError, OSError) as error:
        raise _death(workers[connection]) from error


def _death(process: BaseProcess) -> LabseqError:
    process.join(_FAREWELL_S)
    return LabseqError(
        f"a process of the comparison died (exit code {process.exitcode}); perhaps the memory was used up: "
        "try again with fewer --workers"
    )


def _stop_workers(workers: dict[Connection, BaseProcess]) -> None:
    for process in workers.values():
        process.terminate()
    for connection, process in workers.items():
        connection.close()
        process.join(_FAREWELL_S)
        if process.is_alive():
            process.kill()


def _serve(connection: Connection, comparison: Comparison) -> None:
    """Run jobs in a worker process until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the first one decides
    do: Callable[[Job], Done] = prepare(comparison)
    with suppress(EOFError, OSError):  # the first process has ended
        while True:
            connection.send(do(connection.recv()))


@contextmanager
def _signals(handler: Any, *numbers: int) -> Generator[None]:
    """Handle signals in another way for a while; other threads than the main one get none."""
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if is_main}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


MAX_AT_ONCE: Final = 50
"""Maximum number of loadings of a job; each process loses its current job when a comparison is stopped."""
ALONE_S: Final = 2.0
"""Minimum work for a second process, in seconds: about the time to start one."""


def compare(
    comparison: Comparison,
    n_workers: int | None = None,
    *,
    announce: Callable[[float], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda _done, _wanted: None,
) -> Report:
    """Run all planners on all loadings, check every plan, and summarise the results.

    The same comparison gives the same report, except for times, with any number of
    processes. Ctrl-C or SIGTERM ends it early with the results so far.

    Args:
        comparison: Planners, conditions and loadings.
        n_workers: Number of processes; None for one per core, if there is enough work.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.
        progress: Called with the numbers of loadings that are done and wanted.

    Raises:
        ConfigError: The comparison has an error; says what was expected.
        PluginLoadError: A named plugin failed to load.
    """
    start_s = time.perf_counter()
    prepared = set_up(comparison)
    all_done: list[Done] = []
    n_done = 0
    wanted = comparison.n_loadings * len(prepared)
    ended_by: LabseqError | None = None
    received: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    try:
        with _signals(interrupt, signal.SIGINT, signal.SIGTERM):
            with announcing(announce):
                warm(prepared)
            progress(0, wanted)
            with closing(_results(comparison, n_workers)) as results:
                for done in results:
                    all_done.append(done)
                    n_done += len(done.loadings)
                    progress(n_done, wanted)
    except KeyboardInterrupt:
        ended_by = StopRequested(received[0] if received else signal.SIGINT)
    except LabseqError as error:
        ended_by = error
    duration_s = time.perf_counter() - start_s
    rows = make_rows(comparison, prepared, all_done)
    return Report(comparison, rows, n_done, duration_s, ended_by)


def _results(comparison: Comparison, n_workers: int | None) -> Generator[Done]:
    """The results of all loadings, in any order."""
    todo = _jobs(comparison, n_workers or n_cores())
    if n_workers is None:
        start_s, n_done = time.perf_counter(), 0
        for done in run_jobs(comparison, todo, 1):
            yield done
            n_done += 1
            if time.perf_counter() - start_s > ALONE_S:
                break
        todo = todo[n_done:]
    if todo:
        yield from run_jobs(comparison, todo, min(n_workers or n_cores(), len(todo)))


def _jobs(comparison: Comparison, n_workers: int) -> list[Job]:
    """Divide the work into jobs, several for every process.

    The first loadings of all conditions come first, so that about the same share
    of each condition is done at any time.
    """
    n_loadings, n_conditions = comparison.n_loadings, len(comparison.conditions)
    size = min(MAX_AT_ONCE, n_loadings, -(-n_loadings * n_conditions // (4 * n_workers)))
    return [
        Job(condition, start, min(start + size, n_loadings))
        for start in range(0, n_loadings, size)
        for condition in range(n_conditions)
    ]
