"""Calls into plugins that neither hang the run nor escape a stop request."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, ParamSpec, TypeVar

from labseq.errors import DeviceError, DeviceHungError, LabseqError, PlanError, StopRequested
from labseq.model import TimelineEntry
from labseq.roles import Shot, Step, StepContext
from labseq.sequencer.clock import LOOK_S, StopFlag

P = ParamSpec("P")
T = TypeVar("T")

GRACE_S: Final = 1.0
"""How long a call may take to come back after a stop request."""
STEP_GRACE_S: Final = 2.0
"""The same for a step, whose own call into a device has its grace first."""
LATE_S: Final = 2.0
"""A driver's own timeout comes first; only then does the guard count it as hung."""


class _Job:
    def __init__(self, work: partial[Any]) -> None:
        self._work = work
        name = getattr(work.func, "__name__", "")
        self.name = f"{name}() " if name.isidentifier() else ""  # a lambda has none
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self._work()
        except BaseException as error:  # noqa: BLE001 - handed to the thread that waits
            self.error = error
        self.done.set()


class _Worker:
    """One thread per device: vendor libraries want all calls from the same one."""

    def __init__(self, owner: str) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self.current: _Job | None = None
        threading.Thread(target=self._loop, name=f"labseq {owner}", daemon=True).start()

    @property
    def busy(self) -> bool:
        return self.current is not None and not self.current.done.is_set()

    def submit(self, job: _Job) -> None:
        self.current = job
        self._jobs.put(job)

    def end(self) -> None:
        self._jobs.put(None)

    def _loop(self) -> None:
        while (job := self._jobs.get()) is not None:
            job.run()


class Guard:
    """Runs every call into a device or plugin in that device's own thread.

    A call that does not return in time is given up: the run ends, and the thread,
    which nothing can end, dies with the process.
    """

    def __init__(self, stop: StopFlag) -> None:
        self._stop = stop
        self._workers: dict[str, _Worker] = {}
        self._step_hangs = False

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a function; see ``labseq.roles.Shot.call``.

        After a stop request, or behind a step that hangs, nothing is called any more, not even while
        the request is held: a step that was given up must not switch anything on behind the safe state.
        """
        if self._stop.is_set or self._step_hangs:
            raise StopRequested(self._stop.signal_number)
        job = self._submit(owner, partial(function, *args, **kwargs))
        return self._wait(owner, job, timeout_s, GRACE_S)

    def run_step(self, run: partial[None], timeout_s: float = math.inf) -> None:
        """Run a step; after a stop request one that hangs is given up.

        Args:
            run: Runs it.
            timeout_s: How long it may take before it counts as hung.
        """
        self._stop.check()
        try:
            self._wait("step", self._submit("step", run), timeout_s, STEP_GRACE_S)
        except DeviceHungError:
            self._step_hangs = True
            raise

    def call_to_the_end(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """The same, whether or not the run is asked to stop; for opening, safe states and closing."""
        return self._wait(owner, self._submit(owner, partial(function, *args, **kwargs)), timeout_s)

    def end(self) -> None:
        """Let idle threads end; a hung one is left to the end of the process."""
        for worker in self._workers.values():
            worker.end()
        self._workers.clear()

    def _submit(self, owner: str, work: partial[Any]) -> _Job:
        job = _Job(work)
        worker = self._workers.get(owner)
        if worker is not None and worker.busy:
            worker.end()  # it hangs: leave it behind
            worker = None
        if worker is None:
            worker = self._workers[owner] = _Worker(owner)
        worker.submit(job)
        return job

    def _wait(self, owner: str, job: _Job, timeout_s: float, grace_s: float = math.inf) -> Any:
        deadline = time.monotonic() + timeout_s
        while not job.done.wait(min(LOOK_S, max(0.0, deadline - time.monotonic()))):
            if grace_s < math.inf and self._stop.is_set:
                job.done.wait(grace_s)
                if not job.done.is_set():
                    self._stop.check()
            if time.monotonic() >= deadline and not job.done.is_set():
                raise _timeout(owner, job.name, timeout_s)
        if job.error is not None:
            raise _translated(owner, job.name, job.error)
        return job.result


def _timeout(owner: str, name: str, timeout_s: float) -> LabseqError:
    text = f"{name}did not answer within {timeout_s:.3g} s and is given up"
    return PlanError(text) if owner == "planner" else DeviceHungError(owner, text, timeout_s)


def _translated(owner: str, name: str, error: BaseException) -> BaseException:
    """Name the plugin and the call in whatever it raised; labseq's own errors pass as they are."""
    if isinstance(error, LabseqError):
        return error
    text = f"{name}raised {type(error).__name__}"
    if str(error):
        text += f": {error}"
    named = PlanError(text) if owner == "planner" else DeviceError(owner, text)
    named.__cause__ = error
    return named


def lay_out(step: Step, number: int, name: str, context: StepContext) -> list[TimelineEntry]:
    """A step's timeline. For a guarded call."""
    with _named(number, name):
        return list(step.plan_timeline(context))


def budget_s(step: Step, number: int, name: str, context: StepContext, detect_s: float) -> float:
    """What a step may take at most, in seconds. For a guarded call.

    Args:
        step: The step.
        number: Its index.
        name: Its name.
        context: What it lays out its timeline by.
        detect_s: What finding the atoms on an image may take; a timeline leaves that out.

    Returns:
        Nan if it does not say how long it takes.
    """
    with _named(number, name):
        bars = step.plan_timeline(context)
        planned_s = sum(bar.duration_s for bar in bars)
        return planned_s + detect_s * sum(bar.n_images for bar in bars) if planned_s else math.nan


def run_step(step: Step, number: int, name: str, shot: Shot) -> None:
    """Run a step. For a guarded call."""
    with _named(number, name):
        step.run(shot)


@contextmanager
def _named(number: int, name: str) -> Generator[None]:
    """Name the step in whatever it raises; labseq's own errors pass as they are."""
    try:
        yield
    except LabseqError:
        raise
    except BaseException as error:
        text = f"step {number} ({name}) raised {type(error).__name__}: {error}"
        raise LabseqError(text) from error
