"""Helpers of the contracts, which name the broken promise and watch the side effects of calls."""

from __future__ import annotations

import inspect
import io
import os
import random
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import Context
from functools import partial, wraps
from itertools import takewhile
from pathlib import Path
from typing import Any, Final, NoReturn, ParamSpec, TypeVar

import numpy as np
import pytest

from labseq.guard import Guard

P = ParamSpec("P")
T = TypeVar("T")
E = TypeVar("E", bound=Exception)

_FAILURES: Final = (Exception, pytest.fail.Exception)


class ContractViolation(AssertionError):  # noqa: N818 - a clear name in pytest's summary
    """A plugin does not do what its role promises.

    Attributes:
        promise: The promise, as a sentence.
        detail: What happened instead.
        advice: What to do, or "".
    """

    def __init__(self, promise: str, detail: str, advice: str = "") -> None:
        self.promise = promise
        self.detail = detail
        self.advice = advice
        super().__init__(f"promise: {promise}; but {detail}" + (f"\nto do: {advice}" if advice else ""))


class CallHungError(AssertionError):
    """A call has not returned. Its thread is abandoned."""


@contextmanager
def promised(promise: str) -> Generator[None]:
    """Report any failure inside as a breach of this promise, unless it already names another one."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation:
        raise
    except _FAILURES as error:
        raise ContractViolation(promise, format_error(error)) from _of_the_plugin(error)


def _of_the_plugin(error: BaseException) -> BaseException | None:
    """The error whose traceback the author needs, from the plugin's code and not the suite's."""
    cause: BaseException | None = error
    while cause is not None and isinstance(cause, AssertionError):
        cause = cause.__cause__
    return cause


def failure_text(error: ContractViolation) -> str:
    """The promise, what happened, what to do, and the lines of the plugin's own code, for pytest."""
    frames = traceback.extract_tb(error.__cause__.__traceback__) if error.__cause__ is not None else []
    here = Path(__file__).parent
    first = next((i for i, f in enumerate(frames) if here not in Path(f.filename).parents), len(frames))
    while first < len(frames) and any(here in Path(f.filename).parents for f in frames[first:]):
        first += 1
    plugin_frames = [f for f in frames[first:] if Path(f.filename).name not in ("contextlib.py", "guard.py")]
    lines = ["\n\n", *traceback.format_list(plugin_frames)] if plugin_frames else []
    return str(error) + "".join(lines).rstrip()


def promise(text: str, advice: str = "") -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Decorate a test of a contract with the promise that it tests, and with advice if it is broken.

    The sentence is kept as the test's attribute ``promise``. A test that cannot continue because
    another promise is broken is skipped if a test of that promise fails, so a fault is reported once.
    The same applies if one of the suite's ``bases``, the promises that all others need, is broken.
    """

    def decorate(test: Callable[P, None]) -> Callable[P, None]:
        @wraps(test)
        def run(*args: P.args, **kwargs: P.kwargs) -> None:
            __tracebackhide__ = True
            try:
                test(*args, **kwargs)
            except ContractViolation as error:
                if error.promise != text and _is_reported_elsewhere(error.promise, *args, *kwargs.values()):
                    pytest.skip(f"cannot continue: {error}")
                raise
            except _FAILURES as error:
                for basis in takewhile(text.__ne__, getattr(args[0], "bases", ())):
                    if _is_reported_elsewhere(basis, *args, *kwargs.values()):
                        pytest.skip(f"cannot continue: promise: {basis}")
                raise ContractViolation(text, format_error(error), advice) from _of_the_plugin(error)

        run.__dict__["promise"] = text
        return run

    return decorate


def _is_reported_elsewhere(promise: str, *args: Any) -> bool:
    """Whether a test of that promise also fails. ``args`` are the suite and its tests' arguments."""
    suite = args[0]
    tests = (getattr(type(suite), name) for name in dir(suite) if name.startswith("test_"))
    for test in tests:
        if getattr(test, "promise", None) == promise:
            try:
                test.__wrapped__(*args)
            except _FAILURES:
                return True
    return False


@contextmanager
def doing(what: str) -> Generator[None]:
    """Add the action in progress to the message of a failure inside."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation:
        raise
    except _FAILURES as error:
        raise AssertionError(f"{what}: {format_error(error)}") from error


@contextmanager
def as_this_promise() -> Generator[None]:
    """Report any broken promise inside as a breach of the promise being tested."""
    __tracebackhide__ = True
    try:
        yield
    except ContractViolation as error:
        raise AssertionError(error.detail) from error


def refusal(
    kind: type[E] | tuple[type[E], ...],
    what: str,
    call: Callable[P, object],
    *args: P.args,
    **kwargs: P.kwargs,
) -> E:
    """Make a call that must be refused.

    Returns:
        The error that was raised.
    """
    __tracebackhide__ = True
    wanted = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
    try:
        call(*args, **kwargs)
    except kind as error:
        return error
    except Exception as error:
        raise AssertionError(f"{what} {format_error(error)}; expected {wanted}") from error
    raise AssertionError(f"{what} was accepted; expected {wanted}")


_guard = Guard()  # for all calls, because starting a thread takes longer than most calls


def in_time(limit_s: float, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Make a call that must return.

    Raises:
        CallHungError: It has not returned after ``limit_s`` of real time.
    """
    __tracebackhide__ = True
    done = _guard.run("test of a contract", limit_s, partial(Context().run, call, *args, **kwargs))
    if done is None:
        _guard.end()
        raise CallHungError(f"{what} has not returned after {limit_s:g} s")
    if done.error is not None:
        raise done.error
    return done.result


@contextmanager
def calls_of_sleep(module: str) -> Generator[list[float]]:
    """The times that a module passes to ``time.sleep``, which nothing can interrupt."""
    seen: list[float] = []
    sleep = time.sleep

    def watched(duration_s: float) -> None:
        frame = inspect.currentframe()
        if (
            frame is not None
            and frame.f_back is not None
            and frame.f_back.f_globals.get("__name__") == module
        ):
            seen.append(duration_s)
        sleep(duration_s)

    time.sleep = watched
    try:
        yield seen
    finally:
        time.sleep = sleep


def no_factory(suite: object, signature: str) -> NoReturn:
    """Fail because a test class that inherits a contract does not provide the fixture."""
    name = type(suite).__name__
    pytest.fail(f"{name} needs a fixture 'factory' that returns a callable: {signature}", pytrace=False)


def format_error(error: BaseException) -> str:
    """The text of an error, as the end of a sentence."""
    if isinstance(error, AssertionError | pytest.fail.Exception) and str(error):
        return str(error).split("\nassert ")[0]  # without pytest's explanation of the values
    return f"raised {type(error).__name__}: {error}" if str(error) else f"raised {type(error).__name__}"


_EVENTS: Final = frozenset(
    {
        "ctypes.dlopen",
        "glob.glob",
        "open",
        "os.exec",
        "os.listdir",
        "os.posix_spawn",
        "os.scandir",
        "os.startfile",
        "os.system",
        "socket.bind",
        "socket.connect",
        "socket.getaddrinfo",
        "subprocess.Popen",
        "urllib.Request",
        "winreg.OpenKey",
    }
)


class _Watcher:
    """One audit hook for the whole process, because Python cannot remove one."""

    def __init__(self) -> None:
        self._installed = False
        self._local = threading.local()

    @contextmanager
    def watching(self) -> Generator[list[str]]:
        if not self._installed:
            sys.addaudithook(self._hook)
            self._installed = True
        seen: list[str] = []
        self._local.seen = seen
        try:
            yield seen
        finally:
            self._local.seen = None

    def _hook(self, event: str, args: tuple[Any, ...], events: frozenset[str] = _EVENTS) -> None:
        if event not in events:  # not _EVENTS, which no longer exists while Python shuts down
            return
        seen: list[str] | None = getattr(self._local, "seen", None)
        if seen is not None and not _is_importing():
            seen.append(f"{event}({', '.join(repr(value) for value in args[:2])})")


def _is_importing() -> bool:
    """Whether the event comes from an import statement, which may read files at any time."""
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


_WATCHER: Final = _Watcher()


def watch_io() -> Any:
    """Context manager that lists everything that this thread opens inside it, except for imports.

    Example:
        >>> with watch_io() as seen:
        ...     _ = open(__import__("os").devnull).close()
        >>> len(seen)
        1
    """
    return _WATCHER.watching()


def _numpy_state() -> tuple[object, ...]:
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 - the global one is what is watched
    return (name, np.asarray(keys).tobytes(), *rest)


_STATES: Final[Mapping[str, Callable[[], object]]] = {
    "it drew from random (create your own numpy Generator)": random.getstate,
    "it drew from numpy.random (create your own Generator)": _numpy_state,
    "it changed numpy's error state (use `with numpy.errstate(...)`)": np.geterr,
    "it changed the warning filters (use `with warnings.catch_warnings()`)": lambda: tuple(warnings.filters),
    "it changed the working folder": os.getcwd,
    "it changed the environment's variables": lambda: dict(os.environ),
}


def process_state() -> list[object]:
    """The state that all code of this process shares."""
    return [state() for state in _STATES.values()]


def changes_since(before: list[object]) -> list[str]:
    """The changes since an earlier :func:`process_state`, as sentences."""
    return [change for change, was, now in zip(_STATES, before, process_state(), strict=True) if was != now]


@contextmanager
def quietly(advice: str = "") -> Generator[None]:
    """Check that the code inside does no I/O and leaves the process unchanged.

    Args:
        advice: Added to the message if it does not.

    Raises:
        AssertionError: It did I/O or changed something, which the message names.
    """
    __tracebackhide__ = True
    random.random()  # so that the state differs from a freshly seeded one
    np.random.random()  # noqa: NPY002 - the global one is what is watched
    before = process_state()
    with redirect_stdout(io.StringIO()) as printed, watch_io() as seen:
        yield
    did = [f"it did {', '.join(seen)}"] if seen else []
    if text := printed.getvalue():
        did += [f"it printed {text[:40]!r} (use logging.getLogger(__name__))"]
    did += changes_since(before)
    assert not did, "; ".join([*did, advice] if advice else did)
