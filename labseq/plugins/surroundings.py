"""What all code in a process shares, and a plugin is to leave as it is: compared, put back and told."""

from __future__ import annotations

import gc
import locale
import logging
import os
import random
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from labseq.plugins.overheard import RedirectedStdout

MAX_NAMED: Final = 3
"""Things of a kind that are named; of more only how many there are."""


@dataclass(frozen=True, slots=True)
class SharedState:
    """Something that all code in the process shares.

    Attributes:
        read: What it is now; None if it cannot be told.
        did: What was done to it between two readings, in words; "" for nothing.
        put_back: Makes it again what a reading says.
        instead: What a plugin should do.
        of_thread: Whether each thread has its own, so that no other can put it back, and none need to.
    """

    read: Callable[[], Any]
    change_text: Callable[[Any, Any], str]
    restore_state: Callable[[Any], object]
    advice: str
    of_thread: bool = False


class ProcessState:
    """The process as it is when a plugin's code begins, and what came of it."""

    def __init__(self) -> None:
        self._before: list[Any] = []
        self._threads: set[int | None] = set()
        self._stdout: RedirectedStdout | None = None

    def enter(self) -> None:
        """Look at everything; what is printed goes to stderr from now on."""
        self._before = [shared.read() for shared in SHARED]
        self._threads = {thread.ident for thread in threading.enumerate()}
        sys.stdout = self._stdout = RedirectedStdout(sys.stdout)

    def leave(self, *, inside: bool) -> list[str]:
        """Put back what can be put back.

        Args:
            inside: Whether this is still the plugin's thread.

        Returns:
            What it did, a sentence each.
        """
        changes: list[str] = []
        if self._stdout is not None:
            changes += self._stdout.restore()
        for shared, before in zip(SHARED, self._before, strict=False):
            after = shared.read() if inside or not shared.of_thread else before
            change_text = shared.change_text(before, after) if before is not None and after is not None else ""
            if change_text:
                with suppress(OSError, ValueError, locale.Error):
                    shared.restore_state(before)
                changes.append(f"it {change_text}; this was put back: {shared.advice}")
        if inside:
            new = [t for t in threading.enumerate() if t.ident not in self._threads and t.is_alive()]
            if names := sorted(thread.name for thread in new):
                end = "start none before open(), and end it in close()"
                changes.append(f"it started {_listed(names, 'thread')}; {end}")
        return changes


def _listed(names: list[str], kind: str) -> str:
    told = ", ".join(f"'{name:.60}'" for name in names[:MAX_NAMED])
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return f"the {kind}{'s' if len(names) > 1 else ''} {told}{more}"


def _changed(text: str) -> Callable[[Any, Any], str]:
    return lambda before, after: "" if before == after else text


def _changed_to(text: str) -> Callable[[Any, Any], str]:
    return lambda before, after: "" if before == after else f"{text} {after!s:.200}"


def _module(name: str, read: Callable[[Any], Any]) -> Callable[[], Any]:
    """Reads something of a module that need not be loaded."""
    return lambda: None if name not in sys.modules else read(sys.modules[name])


def _numpy_state(module: Any) -> Any:
    kind, key, *rest = module.get_state()
    return kind, key.tobytes(), *rest


def _restore_numpy(state: Any) -> None:
    np.random.set_state((state[0], np.frombuffer(state[1], np.uint32), *state[2:]))  # noqa: NPY002 - not ours


def _environment_change(before: dict[str, str], after: dict[str, str]) -> str:
    names = sorted(key for key in {*before, *after} if before.get(key) != after.get(key))
    return f"changed {_listed(names, 'environment variable')}" if names else ""


def _restore_environment(before: dict[str, str]) -> None:
    for key in {*os.environ} - {*before}:
        del os.environ[key]
    os.environ.update(before)


def _path_change(before: list[str], after: list[str]) -> str:
    if before == after:
        return ""
    names = [str(folder) for folder in after if folder not in before]
    return f"changed sys.path (it added {_listed(names, 'folder')})" if names else "changed sys.path"


def _restore_path(before: list[str]) -> None:
    sys.path[:] = before


def _is_broad(rule: Any) -> bool:
    """Whether a rule for warnings counts for everybody's, not for those of one module or kind."""
    _, message, category, module, _ = rule
    return message is None and module is None and category.__module__ == "builtins"


def _warning_rules_change(before: list[Any], after: list[Any]) -> str:
    added = [rule for rule in after if _is_broad(rule) and rule not in before]
    if added:
        return f"set everybody's warnings of {added[0][2].__name__} to '{added[0][0]}'"
    moved = [rule for rule in after if rule in before] != before
    return "changed everybody's rules for warnings" if moved else ""


def _restore_rules(before: list[Any]) -> None:
    narrow = [rule for rule in warnings.filters if rule not in before and not _is_broad(rule)]
    warnings.filters[:] = [*narrow, *before]  # pyright: ignore[reportIndexIssue]
    with warnings.catch_warnings():  # what was once decided by the other rules is decided anew
        pass


def _read_logging() -> tuple[int, list[logging.Handler], int]:
    return logging.root.level, list(logging.root.handlers), logging.root.manager.disable


def _restore_logging(before: tuple[int, list[logging.Handler], int]) -> None:
    logging.root.setLevel(before[0])
    logging.root.handlers[:] = before[1]
    logging.disable(before[2])


def _read_folder() -> Path | None:
    try:
        return Path.cwd()
    except OSError:  # somebody has deleted it
        return None


def _restore_hooks(before: Any) -> None:
    sys.stderr, sys.excepthook, threading.excepthook = before


_NO_GLOBAL: Final = "draw from context.random"
_CLOSE: Final = "change it only around the calls that need it"

SHARED: Final = (
    SharedState(
        random.getstate,
        _changed("seeded or used Python's global random numbers"),
        random.setstate,
        _NO_GLOBAL,
    ),
    SharedState(
        _module("numpy.random", _numpy_state),
        _changed("seeded or used numpy's global random numbers"),
        _restore_numpy,
        _NO_GLOBAL,
    ),
    SharedState(
        np.geterr,
        _changed("changed numpy's error state"),
        lambda state: np.seterr(**state),
        "use 'with numpy.errstate(...)'",
        of_thread=True,
    ),
    SharedState(
        np.get_printoptions,
        _changed("changed numpy's print options"),
        lambda options: np.set_printoptions(**options),
        "use 'with numpy.printoptions(...)'",
        of_thread=True,
    ),
    SharedState(
        lambda: list(warnings.filters), _warning_rules_change, _restore_rules, "use 'with warnings.catch_warnings()'"
    ),
    SharedState(_read_folder, _changed_to("changed the working folder to"), os.chdir, "use absolute paths"),
    SharedState(
        lambda: locale.setlocale(locale.LC_ALL),
        _changed_to("changed the locale to"),
        lambda name: locale.setlocale(locale.LC_ALL, name),
        _CLOSE,
    ),
    SharedState(lambda: dict(os.environ), _environment_change, _restore_environment, "set it in open()"),
    SharedState(
        lambda: list(sys.path),
        _path_change,
        _restore_path,
        "import at the top of the module, or make the folder a package and import relatively",
    ),
    SharedState(
        _read_logging,
        _changed("changed the root of Python's logging"),
        _restore_logging,
        "use 'logging.getLogger(__name__)', without handlers",
    ),
    SharedState(
        lambda: (sys.stderr, sys.excepthook, threading.excepthook),
        _changed("replaced sys.stderr or an excepthook"),
        _restore_hooks,
        _CLOSE,
    ),
    SharedState(sys.getrecursionlimit, _changed_to("set the recursion limit to"), sys.setrecursionlimit, _CLOSE),
    SharedState(
        gc.isenabled,
        _changed("switched garbage collection on or off"),
        lambda on: gc.enable() if on else gc.disable(),
        _CLOSE,
    ),
    SharedState(
        _module("socket", lambda socket: (socket.getdefaulttimeout(),)),
        _changed("set a timeout for everybody's sockets"),
        lambda before: sys.modules["socket"].setdefaulttimeout(*before),
        "give each socket its own",
    ),
    SharedState(
        _module("multiprocessing", lambda module: (module.get_start_method(allow_none=True),)),
        _changed("set how multiprocessing starts processes"),
        lambda before: sys.modules["multiprocessing"].set_start_method(*before, force=True),
        "use 'multiprocessing.get_context(...)'",
    ),
)
"""What is looked at before and after."""
