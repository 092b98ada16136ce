"""Notices when code reads files, opens connections or starts programs."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

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
