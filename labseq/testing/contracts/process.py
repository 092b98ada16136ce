"""Promises about the process: no files, connections or programs, and nothing shared is changed."""

from __future__ import annotations

import inspect
import os
import random
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

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
    """One audit hook for the whole process, because Python cannot take one away again."""

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

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if event not in _EVENTS:
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
    """Context manager: the list of everything that this thread opens inside of it; imports do not count.

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
    "it drew from random; make a numpy Generator of your own": random.getstate,
    "it drew from numpy.random; make a Generator of your own": _numpy_state,
    "it changed numpy's error state; use `with numpy.errstate(...)`": np.geterr,
    "it changed the warnings' filters; use `with warnings.catch_warnings()`": lambda: tuple(warnings.filters),
    "it changed the working folder": os.getcwd,
    "it changed the environment's variables": lambda: dict(os.environ),
}


def process_state() -> list[object]:
    """What all code of this process shares."""
    return [state() for state in _STATES.values()]


def changes_since(before: list[object]) -> list[str]:
    """What was changed, as sentences; ``before`` is an earlier :func:`process_state`."""
    return [what for what, was, now in zip(_STATES, before, process_state(), strict=True) if was != now]


@contextmanager
def quietly(advice: str = "") -> Generator[None]:
    """What is done inside does no I/O and leaves the process as it is.

    Args:
        advice: Said to who does otherwise.

    Raises:
        AssertionError: It does not; says what it did.
    """
    __tracebackhide__ = True
    random.random()  # so that the state is not what a fixed seed leaves behind
    np.random.random()  # noqa: NPY002 - the global one is what is watched
    before = process_state()
    with watch_io() as seen:
        yield
    did = [f"it did {', '.join(seen)}"] if seen else []
    did += changes_since(before)
    assert not did, "; ".join([*did, advice] if advice else did)
