"""Planners compared on the same random loadings."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any, Final, cast

from labseq.bench.comparison import (
    BARE_MOTION,
    Comparison,
    Condition,
    Done,
    Job,
    parse_entrants,
    parse_grid,
    parse_loading,
    parse_overrides,
    prepare,
    set_up,
    warm,
)
from labseq.bench.report import Figure, Report, Tally, find_figure
from labseq.errors import ConfigError, LabseqError, Problem, StopRequested

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


DEFAULTS: Final = {"planners": "psca", "grid": "20x20", "target": "compact:15x15", "loading": "75 %"}
MAX_AT_ONCE: Final = 50
"""Most loadings of a job: what is lost of each process when a comparison is stopped."""
ALONE_S: Final = 2.0
"""How long one process works before it starts others: about what their start takes."""


@dataclass(frozen=True, slots=True)
class BenchRequest:
    """What is to be compared, in the words of the command line; None for the default.

    Attributes:
        figure: A figure of the paper, which says all but what follows ``dop``.
        planners: See :func:`labseq.bench.comparison.parse_entrants`.
        grid: "20x20".
        target: "compact:15x15".
        loading: "75 %".
        dop: Degree of parallelism, for every planner that has such a setting.
        loadings: Number of loadings of each condition.
        seed: What all of them are drawn from.
        overrides: See :func:`labseq.bench.comparison.parse_overrides`.
        workers: Number of processes; as many as there are cores, if there is work enough, if None.
    """

    figure: str | None = None
    planners: str | None = None
    grid: str | None = None
    target: str | None = None
    loading: str | None = None
    dop: int | None = None
    loadings: int = 1000
    seed: int = 1
    overrides: Sequence[str] = ()
    workers: int | None = None


def read_request(request: BenchRequest) -> tuple[Comparison, Figure | None]:
    """Read what is to be compared.

    Raises:
        ConfigError: Something in it is wrong; says what was expected.
    """
    settings, motion = parse_overrides(request.overrides)
    if request.figure is None:
        given = {name: getattr(request, name) or default for name, default in DEFAULTS.items()}
        shape, loading = parse_grid(given["grid"]), parse_loading(given["loading"])
        condition = Condition(shape, given["target"], loading, request.dop, (*BARE_MOTION, *motion))
        planner_entries = parse_entrants(given["planners"])
        called = f"--planners {given['planners']}"
        return Comparison(
            planner_entries, (condition,), request.loadings, request.seed, settings, called
        ), None
    figure = find_figure(request.figure)
    _check_figure_alone(request, figure, bool(settings))
    conditions = tuple(figure.with_motion(motion))
    called = f"figure {figure.name}"
    return Comparison(figure.planner_entries, conditions, request.loadings, request.seed, (), called), figure


def compare(
    comparison: Comparison,
    n_workers: int | None = None,
    *,
    announce: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda _done, _wanted: None,
) -> Report:
    """Let all planners plan all loadings, check every plan, and sum up.

    The same comparison gives the same report, times aside, whatever the number of
    processes. Ctrl-C or SIGTERM ends it early with what is done until then.

    Args:
        comparison: What is to be compared.
        n_workers: Number of processes; as many as there are cores, if there is work enough, if None.
        announce: Called with the name of a module before its kernels are compiled.
        progress: Called with the numbers of loadings that are done and wanted.

    Raises:
        ConfigError: Something in the comparison is wrong; says what was expected.
        PluginLoadError: A plugin that is named failed to load.
    """
    from labseq.kernel import announcing

    start_s = time.perf_counter()
    courses = set_up(comparison)
    tally = Tally(comparison, courses)
    wanted = comparison.n_loadings * len(courses)
    ended_by: LabseqError | None = None
    received: list[int] = []
    try:
        with _interrupted_by_signals(received):
            with announcing(announce):
                warm(courses)
            progress(0, wanted)
            with closing(_results(comparison, n_workers)) as results:
                for done in results:
                    tally.add(done)
                    progress(tally.n_done, wanted)
    except KeyboardInterrupt:
        ended_by = StopRequested(received[0] if received else signal.SIGINT)
    except LabseqError as error:
        ended_by = error
    duration_s = time.perf_counter() - start_s
    return Report(comparison, tally.rows(), tally.n_done, duration_s, ended_by)


def _results(comparison: Comparison, n_workers: int | None) -> Generator[Done]:
    """What comes of all loadings, the order aside."""
    todo = _jobs(comparison, n_workers or _n_cores())
    if n_workers is None:
        start_s, n_done = time.perf_counter(), 0
        for done in run_jobs(comparison, todo, 1):
            yield done
            n_done += 1
            if time.perf_counter() - start_s > ALONE_S:
                break
        todo = todo[n_done:]
    if todo:
        yield from run_jobs(comparison, todo, min(n_workers or _n_cores(), len(todo)))


def _check_figure_alone(request: BenchRequest, figure: Figure, has_settings: bool) -> None:
    names = [*DEFAULTS, "dop"]
    given = [f"--{name}" for name in names if getattr(request, name) is not None]
    given += ["--set planner.*"] if has_settings else []
    if given:
        what = f"{' and '.join(given)} cannot be given besides: figure {figure.name} says that itself"
        expected = "--loadings, --seed and --set profile.mobile_tweezers.KEY=VALUE at most"
        raise ConfigError(Problem(what, f"--figure {figure.name}", expected=expected))


def _jobs(comparison: Comparison, n_workers: int) -> list[Job]:
    """The work in pieces, some for every process.

    The first loadings of all conditions come first, so that what is done at any
    time is about the same share of each.
    """
    n_loadings, n_conditions = comparison.n_loadings, len(comparison.conditions)
    size = min(MAX_AT_ONCE, n_loadings, -(-n_loadings * n_conditions // (4 * n_workers)))
    return [
        Job(condition, start, min(start + size, n_loadings))
        for start in range(0, n_loadings, size)
        for condition in range(n_conditions)
    ]


def _n_cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # not on Windows or macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _interrupted_by_signals(received: list[int]) -> Generator[None]:
    """Let SIGTERM interrupt as Ctrl-C does, and note which it was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
