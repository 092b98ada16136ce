"""Processes that share the work of a comparison."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, cast

from labseq.errors import LabseqError
from labseq.session.bench_spec import Comparison
from labseq.session.bench_work import Done, Job, prepare

_LOOK_S: Final = 0.1
"""How often the wait for results gives Ctrl-C a chance: Windows does not interrupt it."""
_FAREWELL_S: Final = 1.0


def run_jobs(comparison: Comparison, jobs: Iterable[Job], n_workers: int) -> Generator[Done]:
    """Do all jobs, in this process if there is to be one worker only.

    Args:
        comparison: The comparison that the jobs are of, known to be valid.
        jobs: The jobs; their order is about the order of the results.
        n_workers: Number of processes.

    Yields:
        What came of each job, as soon as it is done. A generator that is closed early
        ends its processes at once.

    Raises:
        LabseqError: A process died.
    """
    if n_workers == 1:
        yield from map(prepare(comparison), jobs)
        return
    workers: dict[Connection, BaseProcess] = {}
    try:
        with _interrupts_ignored():  # a process begins with the signals that its parent ignores
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
    """Keep every process busy with one job until there are no more."""
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
    """Do jobs until nobody asks for more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the first one decides
    do: Callable[[Job], Done] = prepare(comparison)
    with suppress(EOFError, OSError):  # the first process is gone
        while True:
            connection.send(do(connection.recv()))


@contextmanager
def _interrupts_ignored() -> Generator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
