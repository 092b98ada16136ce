"""Runs every call into a plugin with a time limit, in a thread that can be abandoned.

A plugin that hangs costs one thread. If a plugin fails, the error names it. A plugin that calls ``sys.exit``
ends nothing. While a call runs, the main thread looks for Ctrl-C and for stop requests.

Each device has its own thread. The steps of a shot share a thread. The planner, the detector and devices that
allow it are called in the same thread, because waking another takes 0.1 ms of the time between a frame and
the moves.
"""

from __future__ import annotations

import math
import queue
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, ParamSpec, TypeVar

from labseq.errors import DeviceError, DeviceHungError, LabseqError, PlanError, StopRequested
from labseq.messages import format_plugin_error

P = ParamSpec("P")
T = TypeVar("T")

POLL_S: Final = 0.05
"""How often a waiting thread looks for a stop request. Ctrl-C does not wake a waiting thread on Windows."""
GRACE_S: Final = 1.0
"""How long a call may take to return after a stop request."""
SHOT_GRACE_S: Final = 2.0
"""Grace time of the steps of a shot, longer than the grace time of a device call within a step."""
DRIVER_MARGIN_S: Final = 2.0
"""A call counts as hung this long after the timeout that the driver itself was given."""


class Pulse:
    """Progress of one thread, for the heartbeat that another thread sends.

    The thread beats whenever it waits. The work between two waits is short.
    """

    def __init__(self) -> None:
        self._n = self._n_before = 0
        self._silent_s = 0.0
        self.begin()

    def begin(self) -> None:
        """Follow the calling thread from now on."""
        self._thread = threading.get_ident()
        self._n += 1

    def beat(self) -> None:
        """Note progress. Calls from other threads do not count."""
        if threading.get_ident() == self._thread:
            self._n += 1

    def silent_s(self, passed_s: float) -> float:
        """Time without progress, in seconds.

        Args:
            passed_s: Time since the last call that counts towards it, in seconds.
        """
        self._silent_s = self._silent_s + passed_s if self._n == self._n_before else 0.0
        self._n_before = self._n
        return self._silent_s


class StopFlag:
    """The request to stop a run, set by a signal and checked wherever labseq waits.

    While it is held, because the devices are being made safe, waits do not raise, so that a driver can ramp
    down undisturbed.

    Attributes:
        signal_number: The signal that the run reports.
        pulse: Progress of the thread that takes the shots, which beats here whenever it waits.
    """

    def __init__(self) -> None:
        self._event = threading.Event()
        self._n_holds = 0
        self._n_requests = 0
        self.signal_number = 2
        self.pulse = Pulse()

    def request(self, signal_number: int = 2) -> None:
        """Ask the run to stop. Safe to call from a signal handler."""
        if not self._event.is_set():
            self.signal_number = signal_number
        self._n_requests += 1
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

    @property
    def is_urgent(self) -> bool:
        """Whether it was asked twice. From then on, only calls into devices are waited for."""
        return self._n_requests > 1

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop."""
        self.pulse.beat()
        if self._event.is_set() and not self._n_holds:
            raise StopRequested(self.signal_number)

    def wait(self, duration_s: float) -> None:
        """Wait in real time. Raises ``StopRequested`` as soon as the run is asked to stop."""
        deadline_s = time.monotonic() + duration_s
        self.check()
        while (left_s := deadline_s - time.monotonic()) > 0:
            self.pulse.beat()
            if self._n_holds:
                time.sleep(min(left_s, POLL_S))
            elif self._event.wait(min(left_s, POLL_S)):
                self.check()


_SIGHUP: Final = getattr(signal, "SIGHUP", None)
_EXIT_SIGNALS: Final[dict[Any, int]] = {  # signal -> the signal that the run reports
    getattr(signal, name): meaning
    for name, meaning in {
        "SIGINT": signal.SIGINT,
        "SIGTERM": signal.SIGTERM,
        "SIGHUP": 1,  # the terminal or the ssh connection is gone; Windows has no name for it
        "SIGBREAK": signal.SIGINT,  # Ctrl-Break on Windows
    }.items()
    if hasattr(signal, name)
}


@contextmanager
def stop_on_signals(stop: StopFlag) -> Generator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP set a flag while the block runs, instead of raising an exception.

    If SIGHUP was ignored before (``nohup``), it stays ignored. Outside the main thread this does nothing,
    because Python handles signals only there.
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


@dataclass(frozen=True, slots=True, eq=False)
class Limit:
    """The time limit for one part of a call, enforced by the thread that waits for the call.

    Attributes:
        owner: Device or plugin that is called, or "step".
        name: The function or the step, for the message, with a space at its end. "" if it has no name.
        timeout_s: The limit.
        deadline_s: Time at which the limit is reached, on the monotonic clock.
    """

    owner: str
    name: str
    timeout_s: float
    deadline_s: float


class GuardedCall:
    """A call that a thread carries out.

    Attributes:
        done: Set when it has returned.
        result: Its return value.
        error: The exception it raised, or None.
        has_steps: True for the call that runs a whole shot.
        is_abandoned: True once nothing waits for it any longer. From then on it must make no calls.
    """

    def __init__(self, work: partial[Any], *, has_steps: bool = False) -> None:
        self._work = work
        self._limits: list[Limit] = []
        self._lock = threading.Lock()
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None
        self.has_steps = has_steps
        self.is_abandoned = False

    def run(self) -> None:
        """Run the call in the current thread."""
        outer_call, _this_thread.call = current_call(), self
        try:
            self.result = self._work()
        except BaseException as error:  # noqa: BLE001 - handed to the thread that waits
            self.error = error
        _this_thread.call = outer_call
        self.done.set()

    def enter(self, limit: Limit) -> None:
        """Begin a part of this call that has a time limit."""
        self._limits.append(limit)

    def leave(self) -> None:
        """End the part that was begun last."""
        with self._lock:
            self._limits.pop()

    def abandon_if_late(self) -> Limit | None:
        """Abandon the call if a limit is reached. Returns that limit, the innermost if there are several."""
        now_s = time.monotonic()
        with self._lock:  # with `leave`: a part that has just ended in time must not be the late one
            late = next((limit for limit in reversed(self._limits) if now_s >= limit.deadline_s), None)
            self.is_abandoned = late is not None
        return late


_this_thread = threading.local()


def current_call() -> GuardedCall | None:
    """The call that this thread carries out."""
    return getattr(_this_thread, "call", None)


class _Worker:
    """A thread that carries out calls one after another."""

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[GuardedCall | None] = queue.SimpleQueue()
        self._done = threading.Event()
        self._done.set()
        threading.Thread(target=self._loop, name=f"labseq {name}", daemon=True).start()

    @property
    def busy(self) -> bool:
        return not self._done.is_set()

    def submit(self, call: GuardedCall) -> None:
        self._done = call.done  # not the call: nothing keeps its result alive
        self._calls.put(call)

    def end(self) -> None:
        self._calls.put(None)

    def _loop(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()
            del call  # an idle thread keeps nothing alive


class Guard:
    """Runs the calls into devices and plugins.

    All calls into a device are made in one thread, as vendor libraries require. A call that does not return
    in time is abandoned. Its thread cannot be ended and lives until the process ends. Further calls of the
    same owner get a new thread.

    Args:
        stop: The request to stop. Without it, calls are never stopped.

    Attributes:
        direct: Owners whose calls a shot makes in the thread of its steps. If one of these hangs, the shot is
            abandoned.
    """

    def __init__(self, stop: StopFlag | None = None) -> None:
        self._stop = stop or StopFlag()
        self._workers: dict[str, _Worker] = {}
        self._lock = threading.Lock()
        self.direct: frozenset[str] = frozenset()

    def call(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a function of a device or plugin. See ``labseq.plugin.Shot.call``.

        After a stop request, or in an abandoned shot, nothing is called any more, not even while the request
        is held, because a step that wakes up late must not switch anything on after the safe state.
        """
        self.check()
        return self._call(owner, timeout_s, GRACE_S, partial(function, *args, **kwargs))

    def call_despite_stop(
        self, owner: str, timeout_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a function even if the run is asked to stop, to open, make safe or close a device."""
        return self._call(owner, timeout_s, math.inf, partial(function, *args, **kwargs))

    def begin(
        self, owner: str, timeout_s: float, work: partial[T], *, is_patient: bool = True
    ) -> tuple[threading.Event, Callable[[], T]]:
        """Begin a call, even if the run is asked to stop.

        Args:
            is_patient: False if a second stop request abandons the call, as for writing to the disk.

        Returns:
            An event that is set when the call has ended, and a function that waits for this and returns
            the result, as :meth:`call_despite_stop` does.
        """
        limit, call = _limit(owner, timeout_s, work), GuardedCall(work)
        is_out = self._submit(owner, call)

        def result() -> T:
            ended = call
            if is_out:
                ended = self._wait(call, limit.deadline_s, math.inf, is_patient=is_patient)
            return self._result(limit, ended)

        return call.done, result

    def check(self) -> None:
        """Raise ``StopRequested`` if the run was asked to stop, or if the calling shot was abandoned."""
        if self._stop.is_set or self.is_abandoned:
            raise StopRequested(self._stop.signal_number)

    @property
    def is_abandoned(self) -> bool:
        """Whether the calling thread belongs to a shot that was abandoned."""
        call = current_call()
        return call is not None and call.is_abandoned

    def run_shot(self, work: partial[None]) -> None:
        """Run the steps of a shot. It is abandoned if a step hangs, or soon after a stop request.

        Raises:
            LabseqError: As the shot raised it.
            DeviceHungError: A step, or a device that it called directly, did not return in time.
            PlanError: The planner did not return in time.
        """
        self._stop.check()
        call = self.run("step", math.inf, work, SHOT_GRACE_S, has_steps=True)
        self._result(_limit("step", math.inf, work), call)

    @contextmanager
    def step(self, name: str, timeout_s: float, owner: str = "step") -> Generator[None]:
        """Give the block, a step in :meth:`run_shot` or another part of a call, a time limit of its own.

        Args:
            name: Its name in messages, with a space at its end.
            timeout_s: Its time limit.
            owner: The device or plugin that a message names, or "step".

        Raises:
            StopRequested: The shot was abandoned meanwhile.
        """
        call = current_call()
        assert call is not None
        call.enter(Limit(owner, name, timeout_s, time.monotonic() + timeout_s))
        try:
            yield
        finally:
            call.leave()
            if call.is_abandoned:
                raise StopRequested(self._stop.signal_number)

    def run(
        self,
        owner: str,
        timeout_s: float,
        work: partial[Any],
        grace_s: float = math.inf,
        *,
        has_steps: bool = False,
    ) -> GuardedCall | None:
        """Run a call in the owner's thread and wait for its end.

        Args:
            owner: Device or plugin whose thread runs the call.
            timeout_s: How long it may take.
            work: The call.
            grace_s: How long it may take to return after a stop request.
            has_steps: True for the call that runs a whole shot.

        Returns:
            The call with its result or error, or None if it has not returned in time and is abandoned.

        Raises:
            StopRequested: The run was asked to stop, and the call did not return in its grace time.
            LabseqError: A limit within the call was reached.
        """
        call = GuardedCall(work, has_steps=has_steps)
        if not self._submit(owner, call):
            return call
        return self._wait(call, time.monotonic() + timeout_s, grace_s)

    def _submit(self, owner: str, call: GuardedCall) -> bool:
        """Hand a call to the owner's thread. False if it was carried out here instead."""
        try:
            with self._lock:
                self._worker(owner).submit(call)
        except (RuntimeError, MemoryError):  # no thread can be started; a call without limit beats none
            call.run()
            return False
        return True

    def _wait(
        self, call: GuardedCall, deadline_s: float, grace_s: float, *, is_patient: bool = True
    ) -> GuardedCall | None:
        """Wait for the end of a call. See :meth:`run`."""
        try:
            self._stop.pulse.beat()
            while not call.done.wait(min(POLL_S, max(0.0, deadline_s - time.monotonic()))):
                self._stop.pulse.beat()
                if not is_patient and self._stop.is_urgent:
                    raise StopRequested(self._stop.signal_number)
                if grace_s < math.inf and self._stop.is_set:
                    call.done.wait(grace_s)
                    if not call.done.is_set():
                        self._stop.check()  # does not raise while the request is held
                late = call.abandon_if_late()
                if late is not None:
                    raise _hung(late)
                if time.monotonic() >= deadline_s and not call.done.is_set():
                    call.is_abandoned = True
                    return None
        except BaseException:
            call.is_abandoned = True
            raise
        return call

    def end(self) -> None:
        """End the idle threads now, and the others as soon as their calls return."""
        with self._lock:
            for worker in self._workers.values():
                worker.end()
            self._workers.clear()

    def _worker(self, owner: str) -> _Worker:
        worker = self._workers.get(owner)
        if worker is not None and not worker.busy:
            return worker
        if worker is not None:
            worker.end()  # its call hangs, or belongs to another thread, so it gets no further calls
        worker = self._workers[owner] = _Worker(owner)
        return worker

    def _call(self, owner: str, timeout_s: float, grace_s: float, work: partial[T]) -> T:
        """Run a call. Errors other than labseq's own are raised again with the owner and the function."""
        limit = _limit(owner, timeout_s, work)
        shot = current_call()
        if owner in self.direct and grace_s < math.inf and shot is not None and shot.has_steps:
            call = self._directly(shot, limit, work)
        else:
            call = self.run(owner, timeout_s, work, grace_s)
        return self._result(limit, call)

    def _result(self, limit: Limit, call: GuardedCall | None) -> Any:
        """The result of a call that has ended, or None if it was abandoned."""
        if call is None:
            raise _hung(limit)
        if call.error is None:
            return call.result
        if isinstance(call.error, LabseqError) or call.has_steps:
            raise call.error
        owner, text = limit.owner, f"{limit.name}raised {format_plugin_error(call.error)}"
        raise (PlanError(text) if owner == "planner" else DeviceError(owner, text)) from call.error

    def _directly(self, shot: GuardedCall, limit: Limit, work: partial[Any]) -> GuardedCall:
        """Run a call in the thread of the steps."""
        call = GuardedCall(work)
        shot.enter(limit)
        call.run()
        shot.leave()
        if shot.is_abandoned:
            raise StopRequested(self._stop.signal_number)
        return call


def _limit(owner: str, timeout_s: float, work: partial[Any]) -> Limit:
    name = getattr(work.func, "__name__", "")
    name = f"{name}() " if name.isidentifier() else ""  # a lambda has none
    return Limit(owner, name, timeout_s, time.monotonic() + timeout_s)


def _hung(limit: Limit) -> LabseqError:
    """The error for a call or a step that did not end in time."""
    text = f"{limit.name}did not answer within {limit.timeout_s:.3g} s and is abandoned"
    if limit.owner == "planner":
        return PlanError(f"{text}; if it is only slow, raise 'timeouts: {{plan: ...}}' in the profile")
    return DeviceHungError(limit.owner, text, limit.timeout_s)
