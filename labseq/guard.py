"""Runs every call into a plugin in a thread of its own, with a time limit.

A plugin that hangs costs one thread, one that fails is named in the error, and one that calls ``sys.exit``
ends nothing. While a call is out, the main thread looks for Ctrl-C and for stop requests.
"""

from __future__ import annotations

import math
import queue
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final, ParamSpec, TypeVar, cast

from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceHungError,
    LabseqError,
    PlanError,
    StopRequested,
)
from labseq.messages import error_text, format_error

P = ParamSpec("P")
T = TypeVar("T")

POLL_S: Final = 0.05
"""How often a waiting thread looks for a stop request; on Windows, Ctrl-C does not wake a waiting thread."""
GRACE_S: Final = 1.0
"""How long a call may take to return after a stop request."""
STEP_GRACE_S: Final = 2.0
"""The same for a step, whose own call into a device has its grace first."""
DRIVER_MARGIN_S: Final = 2.0
"""A call counts as hung this long after the timeout that the driver itself was given."""


class StopFlag:
    """The request to stop a run: set by a signal, checked by everything that waits.

    While it is held (the devices are being made safe) waits do not raise, so that a driver can ramp down
    undisturbed.
    """

    def __init__(self) -> None:
        self._event = threading.Event()
        self._n_holds = 0
        self.signal_number = 2

    def request(self, signal_number: int = 2) -> None:
        """Ask the run to stop; safe to call from a signal handler."""
        if not self._event.is_set():
            self.signal_number = signal_number
        self._event.set()

    @contextmanager
    def held(self) -> Generator[None]:
        """Let waits within the block finish."""
        self._n_holds += 1
        try:
            yield
        finally:
            self._n_holds -= 1

    @property
    def is_set(self) -> bool:
        """Whether the run was asked to stop, even if held."""
        return self._event.is_set()

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        if self._event.is_set() and not self._n_holds:
            raise StopRequested(self.signal_number)

    def wait(self, duration_s: float) -> None:
        """Wait in real time; raise ``StopRequested`` as soon as the run is asked to stop."""
        deadline_s = time.monotonic() + duration_s
        self.check()
        while (left_s := deadline_s - time.monotonic()) > 0:
            if self._n_holds:
                time.sleep(min(left_s, POLL_S))
            elif self._event.wait(min(left_s, POLL_S)):
                self.check()


_SIGHUP: Final = getattr(signal, "SIGHUP", None)
_EXIT_SIGNALS: Final = {  # signal -> the signal that the run reports
    getattr(signal, name): meaning
    for name, meaning in {
        "SIGINT": signal.SIGINT,
        "SIGTERM": signal.SIGTERM,
        "SIGHUP": signal.SIGTERM,  # the terminal or the ssh connection is gone
        "SIGBREAK": signal.SIGINT,  # Ctrl-Break on Windows
    }.items()
    if hasattr(signal, name)
}


@contextmanager
def stop_on_signals(stop: StopFlag) -> Generator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP set a flag while the block runs, instead of raising an exception.

    A lost terminal that is ignored (``nohup``) stays ignored. Python lets only
    the main thread handle signals; in any other this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _frame: object) -> None:
        stop.request(_EXIT_SIGNALS[number])

    before = {number: signal.getsignal(number) for number in _EXIT_SIGNALS}
    if before.get(_SIGHUP) is signal.SIG_IGN:
        del before[_SIGHUP]
    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def readable(error: LabseqError) -> LabseqError:
    """One of labseq's own errors as a plugin raised it, or one of the same kind if its text is unusable.

    A text is unusable if it cannot be read, is longer than ``MAX_ERROR``, or has control characters.
    """
    text, given, is_config = error_text(error), "", issubclass(type(error), ConfigError)
    with suppress(BaseException):
        given = str(error)
    if text == given or (is_config and given and all(c.isprintable() or c == "\n" for c in given)):
        return error  # a ConfigError may have many problems, a line each
    if is_config:
        return ConfigError(text)
    kinds: list[type[LabseqError]] = [k for k in type(error).__mro__ if issubclass(k, LabseqError)]
    kind = next(one for one in kinds if one.__module__ == LabseqError.__module__)
    made = kind.__new__(kind, text)
    with suppress(BaseException):
        made.__dict__.update(vars(error))
    made.args = (text,)
    return made


class GuardedCall:
    """A call that a worker thread carries out.

    Attributes:
        done: Set when it has returned.
        result: What it returned.
        error: What it raised, or None.
        own_error: The same if it is one of labseq's own errors, else None.
        text: Kind and text of the error, or "".
    """

    def __init__(self, work: partial[Any]) -> None:
        self._work = work
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None
        self.own_error: LabseqError | None = None
        self.text = ""

    def run(self) -> None:
        """Carry it out; called by the worker thread."""
        try:
            self.result = self._work()
        except BaseException as error:  # noqa: BLE001 - handed to the thread that waits
            self.error = error
            self.text = format_error(error)  # in this thread, because it may take long
            if issubclass(type(error), LabseqError):  # isinstance() asks the object itself
                self.error = self.own_error = readable(cast("LabseqError", error))
        self.done.set()


class _Worker:
    """A thread that carries out calls one after another."""

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[GuardedCall | None] = queue.SimpleQueue()
        self._current: GuardedCall | None = None
        threading.Thread(target=self._loop, name=f"labseq {name}", daemon=True).start()

    @property
    def busy(self) -> bool:
        return self._current is not None and not self._current.done.is_set()

    def submit(self, call: GuardedCall) -> None:
        self._current = call
        self._calls.put(call)

    def end(self) -> None:
        self._calls.put(None)

    def _loop(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()


class Guard:
    """Runs the calls into each device or plugin in one thread: vendor libraries want all calls from the same.

    A call that does not return in time is abandoned. Its thread cannot be ended and lives on until the
    process ends; further calls of the same owner get a new thread.

    Args:
        stop: The request to stop; without one, calls are never stopped.
    """

    def __init__(self, stop: StopFlag | None = None) -> None:
        self._stop = stop or StopFlag()
        self._workers: dict[str, _Worker] = {}
        self._step_hangs = False

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a function of a device or plugin; see ``labseq.plugin.Shot.call``.

        After a stop request, or after a step that hangs, nothing is called any more, not even while the
        request is held: an abandoned step that wakes up must not switch anything on after the safe state.
        """
        if self._stop.is_set or self._step_hangs:
            raise StopRequested(self._stop.signal_number)
        return self._named(owner, timeout_s, GRACE_S, partial(function, *args, **kwargs))

    def call_despite_stop(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """The same, even if the run is asked to stop; for opening, safe states and closing."""
        return self._named(owner, timeout_s, math.inf, partial(function, *args, **kwargs))

    def run_step(self, run: partial[None], timeout_s: float = math.inf) -> None:
        """Run a step; one that hangs is abandoned after ``timeout_s``, or soon after a stop request."""
        self._stop.check()
        try:
            self._named("step", timeout_s, STEP_GRACE_S, run)
        except DeviceHungError:
            self._step_hangs = True
            raise

    def run(
        self, owner: str, timeout_s: float, work: partial[Any], grace_s: float = math.inf
    ) -> GuardedCall | None:
        """Run a call and wait for its end.

        Args:
            owner: Whose thread it runs in.
            timeout_s: How long it may take.
            work: The call.
            grace_s: How long it may take to return after a stop request.

        Returns:
            The call with its result or error; None if it has not returned in time and is abandoned.

        Raises:
            StopRequested: The run was asked to stop, and the call did not return in its grace time.
        """
        call = GuardedCall(work)
        try:
            worker = self._worker(owner)
        except (
            RuntimeError,
            MemoryError,
        ):  # no thread can be started: better without a limit than not at all
            call.run()
            return call
        worker.submit(call)
        deadline = time.monotonic() + timeout_s
        while not call.done.wait(min(POLL_S, max(0.0, deadline - time.monotonic()))):
            if grace_s < math.inf and self._stop.is_set:
                call.done.wait(grace_s)
                if not call.done.is_set():
                    self._stop.check()
            if time.monotonic() >= deadline and not call.done.is_set():
                return None
        return call

    def end(self) -> None:
        """End the idle threads; one that hangs is left to the end of the process."""
        for worker in self._workers.values():
            worker.end()
        self._workers.clear()

    def _worker(self, owner: str) -> _Worker:
        worker = self._workers.get(owner)
        if worker is not None and worker.busy:
            worker.end()  # its call hangs
            worker = None
        if worker is None:
            worker = self._workers[owner] = _Worker(owner)
        return worker

    def _named(self, owner: str, timeout_s: float, grace_s: float, work: partial[T]) -> T:
        """Run a call; name owner and function in whatever is not one of labseq's own errors."""
        call = self.run(owner, timeout_s, work, grace_s)
        if call is not None and call.error is None:
            return call.result
        name = getattr(work.func, "__name__", "")
        name = f"{name}() " if name.isidentifier() else ""  # a lambda has none
        if call is None:
            text = f"{name}did not answer within {timeout_s:.3g} s and is abandoned"
            if owner == "planner":
                raise PlanError(f"{text}; if it is only slow, raise 'timeouts: {{plan: ...}}' in the profile")
            raise DeviceHungError(owner, text, timeout_s)
        if call.own_error is not None:
            raise call.own_error
        text = f"{name}raised {call.text}"
        raise (PlanError(text) if owner == "planner" else DeviceError(owner, text)) from call.error
