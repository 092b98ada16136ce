"""Processes on this computer that carry out numbered tasks, even if some of the processes die.

Each task goes to one worker. If that worker is lost, another one gets its tasks, and a new worker takes its
place. A task that has ended several workers ends the work.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Final, Literal, Protocol, Self, cast

from labseq.errors import LabseqError
from labseq.messages import error_text

Do = Callable[[Any], Any]
"""Carries out the task with this argument and returns its result."""
Make = Callable[[Any], Do]
"""Prepares a worker from the common recipe. Must be a module's function, because it is sent by name."""

POLL_S: Final = 0.1
"""Interval at which waiting for results is interrupted, in seconds, as Ctrl-C does not end it on Windows."""
QUEUED: Final = 2
"""Tasks that a worker is given in advance, so that it need not wait for the next one."""
MAX_LOST: Final = 3
"""Workers that a task may end before the work ends too, as it may need more memory than there is."""
_START: Final = -1
"""Task number that means the preparation of a worker."""
_FAREWELL_S: Final = 10.0
"""Time for a worker to end, in seconds, in which a run makes its devices safe and records its end."""


class Workers(Protocol):
    """Carries out tasks. Used by one thread."""

    @property
    def n_workers(self) -> int:
        """Number of workers now, at least 1."""
        ...

    def prepare(self, make: Make, recipe: Any) -> None:
        """Set how tasks are carried out. Called once, before the first task.

        Args:
            make: Prepares each worker.
            recipe: The argument of ``make``, pickled.
        """
        ...

    def submit(self, task: int, argument: Any) -> None:
        """Hand out a task.

        Args:
            task: Its number, used once.
            argument: The argument of ``Do``, which is pickled, so keep it small.
        """
        ...

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        """Wait until a task is done, or time is up. Returns number and result of each finished task.

        Raises:
            LabseqError: A worker cannot be prepared, a task failed, or it has ended :data:`MAX_LOST` workers.
        """
        ...

    def close(self) -> None:
        """End all workers at once, whatever they are doing. Legal at any time."""
        ...


def portable(error: Exception) -> LabseqError:
    """An error that another process can receive, with only its text if it cannot be pickled."""
    if isinstance(error, LabseqError):
        with suppress(Exception):
            return pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    return LabseqError(error_text(error))


@dataclass(slots=True, eq=False)
class _Worker:
    """A worker process.

    Attributes:
        connection: Takes tasks to it, and brings its answers.
        process: The process.
        tasks: Its tasks, number -> argument.
        at: The task that it has begun last, or its start. None if it waits.
    """

    connection: Connection
    process: BaseProcess
    tasks: dict[int, Any] = field(default_factory=dict[int, Any])
    at: int | None = _START

    @classmethod
    def start(cls, make: Make, recipe: Any) -> Self:
        context: Any = multiprocessing.get_context("spawn")  # the same everywhere, and no locks are inherited
        ours, theirs = context.Pipe()
        process: BaseProcess = context.Process(target=_serve, args=(theirs, make, recipe), daemon=True)
        with _ignored(signal.SIGINT), _without_main():  # the process then ignores it, too
            process.start()
        theirs.close()
        return cls(ours, process)

    def send(self, task: int, argument: Any) -> None:
        self.tasks[task] = argument
        with suppress(OSError):  # it has died, which is noticed when its answers are read
            self.connection.send((task, argument))

    def end(self) -> None:
        self.process.terminate()
        self.connection.close()
        self.process.join(_FAREWELL_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(_FAREWELL_S)


class ProcessWorkers:
    """Worker processes on this computer.

    Args:
        n_workers: Their number.
        task_name: Name of a task in messages, for example "run".

    Attributes:
        n_workers: Their number.
    """

    def __init__(self, n_workers: int, task_name: str) -> None:
        self.n_workers = n_workers
        self._task_name = task_name
        self._n_lost = Counter[int]()
        self._workers: list[_Worker] = []

    def prepare(self, make: Make, recipe: Any) -> None:
        """Start the processes."""
        self._start = partial(_Worker.start, make, recipe)
        for _ in range(self.n_workers):
            self._workers.append(self._start())

    def submit(self, task: int, argument: Any) -> None:
        """Give a task to the worker that has the fewest."""
        min(self._workers, key=lambda worker: len(worker.tasks)).send(task, argument)

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        """See :class:`Workers`."""
        results: list[tuple[int, Any]] = []
        ready = wait([worker.connection for worker in self._workers], timeout_s)
        for number, worker in enumerate(self._workers):
            if worker.connection not in ready:
                continue
            try:
                event, task, answer = cast("_Answer", worker.connection.recv())
            except (EOFError, OSError):
                self._workers[number] = self._replacement(worker)
                continue
            if event == "failed":
                raise answer
            if event == "begins":
                worker.at = task
            elif event == "ready":
                worker.at = None
                self._n_lost[_START] = 0
            else:
                worker.at = None if worker.at == task else worker.at
                del worker.tasks[task]
                results.append((task, answer))
        return results

    def _replacement(self, lost: _Worker) -> _Worker:
        """A new worker that has the tasks of a lost one.

        Raises:
            LabseqError: The task that it was at, or the start, has ended too many workers.
        """
        lost.end()
        if lost.at is not None:
            self._n_lost[lost.at] += 1
            if self._n_lost[lost.at] >= MAX_LOST:
                cause = "a start" if lost.at == _START else f"{self._task_name} {lost.at}"
                raise LabseqError(
                    f"{MAX_LOST} worker processes have died of {cause} (exit code {lost.process.exitcode}); "
                    "try fewer --workers, the memory may be used up"
                )
        new = self._start()
        for task, argument in lost.tasks.items():
            new.send(task, argument)
        return new

    def close(self) -> None:
        """See :class:`Workers`."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            worker.end()


_Answer = tuple[Literal["ready", "begins", "done", "failed"], int, Any]
"""A worker's message, with the event, its task, and the result or the error."""


def _serve(connection: Connection, make: Make, recipe: Any) -> None:
    """Carry out tasks in a worker process until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process, but the first one decides
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def send(*answer: *_Answer) -> None:
        connection.send(answer)

    task = _START
    with suppress(EOFError, OSError):  # the first process has ended
        try:
            do = make(recipe)
            send("ready", _START, None)
            while True:
                task, argument = connection.recv()
                send("begins", task, None)
                send("done", task, do(argument))
        except Exception as error:  # noqa: BLE001 - the first process raises it
            send("failed", task, portable(error))


def _end_with_parent() -> None:
    """End this process, as SIGTERM does, when its parent has died."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    signal.raise_signal(signal.SIGTERM)


@contextmanager
def _ignored(number: int) -> Generator[None]:
    """Ignore a signal within the block. Does nothing outside the main thread, which alone gets signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(number, before)


@contextmanager
def _without_main() -> Generator[None]:
    """Hide the running program, which a new process would otherwise run as well, to import from it."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
