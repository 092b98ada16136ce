"""Calls into plugins: failures are named, hangs end, and prints are kept."""

from __future__ import annotations

import gc
import importlib.util
import locale
import logging
import os
import random
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TextIO, TypeVar

import numpy as np

from labseq.errors import LabseqError, PluginLoadError
from labseq.registry import Owner

MAX_HEARD: Final = 200
"""Characters that are remembered."""


class RedirectedStdout:
    """Stands in for ``sys.stdout``: stdout may belong to a program that reads JSON from it.

    A plugin may keep it; afterwards it leads to where stdout led before.
    """

    def __init__(self, real: TextIO | Any) -> None:
        self._real = real
        self._is_over = False
        self._text = ""

    def restore(self) -> list[str]:
        """End it.

        Returns:
            What it heard, a sentence.
        """
        self._is_over = True
        heard: list[str] = []
        if sys.stdout is not self:
            heard.append(
                "it replaced sys.stdout; this was put back: change it only around the calls that need it"
            )
        sys.stdout = self._real
        if words := " ".join(self._text.split()):
            heard.append(
                f"it printed ('{words[:60]}'); this went to stderr: use 'logging.getLogger(__name__)'"
            )
        return heard

    def write(self, text: str) -> int:
        """Write to stderr, or once it is over to the real stdout."""
        if not self._is_over:
            self._text = (self._text + text)[:MAX_HEARD]
        stream = self._stream
        return len(text) if stream is None else stream.write(text)

    @property
    def _stream(self) -> Any:
        return self._real if self._is_over else sys.stderr

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


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
            change_text = (
                shared.change_text(before, after) if before is not None and after is not None else ""
            )
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
        lambda: list(warnings.filters),
        _warning_rules_change,
        _restore_rules,
        "use 'with warnings.catch_warnings()'",
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
    SharedState(
        sys.getrecursionlimit, _changed_to("set the recursion limit to"), sys.setrecursionlimit, _CLOSE
    ),
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


MAX_WORDS: Final = 500
"""Characters of a plugin's own error that are told."""


def format_error(error: BaseException) -> str:
    """Kind and text of an error that somebody else's code raised, in one line that is not too long.

    Example:
        >>> in_words(KeyError("typo"))
        "KeyError: 'typo'"
    """
    try:
        text = str(error)
    except (Exception, SystemExit) as another:  # noqa: BLE001 - it may raise anything
        text = f"(its text cannot be had: {type(another).__name__})"
    text = " ".join(f"{type(error).__name__}: {text[: 2 * MAX_WORDS]}".split()).rstrip(":")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= MAX_WORDS else f"{text[:MAX_WORDS]} ..."


LOCAL_PACKAGE: Final = "labseq_local"
"""Package in which the plugins of folders are modules."""


def import_file(name: str, path: Path) -> ModuleType:
    """Import a single file, or a package by its ``__init__.py``, as ``labseq_local.<name>``."""
    if LOCAL_PACKAGE not in sys.modules:
        sys.modules[LOCAL_PACKAGE] = ModuleType(LOCAL_PACKAGE)
        sys.modules[LOCAL_PACKAGE].__path__ = []
    full_name = f"{LOCAL_PACKAGE}.{name}"
    inside = [str(path.parent)] if path.name == "__init__.py" else None
    spec = importlib.util.spec_from_file_location(full_name, path, submodule_search_locations=inside)
    if spec is None or spec.loader is None:
        raise PluginLoadError(name, f"{path} is not a Python module")
    forget(name)  # of another folder, or as it was before somebody changed it
    module = importlib.util.module_from_spec(spec)
    sys.modules[full_name] = module  # before execution, as dataclasses and relative imports need it
    spec.loader.exec_module(module)
    return module


def forget(name: str) -> None:
    """Let nobody find the modules of a folder's plugin: they are imported anew."""
    full_name = f"{LOCAL_PACKAGE}.{name}"
    for module in [m for m in sys.modules if m == full_name or m.startswith(f"{full_name}.")]:
        del sys.modules[module]


def plugin_location(path: Path) -> Path:
    """What a folder's plugin consists of: its file, or the folder of its package."""
    path = path.absolute()
    return path.parent if path.name == "__init__.py" else path


def module_location(name: str) -> Path | None:
    """The folder of an installed package, or its file; None if it cannot be told. Nothing is imported."""
    try:
        spec = importlib.util.find_spec(name.partition(".")[0])
    except (ImportError, ValueError, AttributeError):
        return None
    return None if spec is None or spec.origin is None else plugin_location(Path(spec.origin))


def error_location(error: BaseException, home: Path | None) -> str:
    """File and line that an error came from, the plugin's own if it has a part in it; "" if unknown."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno or 1}"
    frames = [frame for one in _chain(error) for frame in traceback.extract_tb(one.__traceback__)]
    own = [f for f in frames if home is not None and home in (Path(f.filename), *Path(f.filename).parents)]
    foreign = [f for f in frames if Path(f.filename).parent != Path(__file__).parent]
    frame = (own or foreign or [None])[-1]
    return "" if frame is None else f"{frame.filename}:{frame.lineno}"


def _chain(error: BaseException) -> list[BaseException]:
    """The error that came first, then those that it led to: the last ones are the one that is told."""
    chain = [error]
    while (cause := chain[0].__cause__ or chain[0].__context__) is not None and cause not in chain:
        chain.insert(0, cause)
    return chain


T = TypeVar("T")

_LOOK_S: Final = 0.05
"""How often the thread that waits looks up, for Ctrl-C."""


def contained(owner: Owner, what: str, work: Callable[[], T], *, watch: bool = True) -> T:
    """Let a plugin's code run, and name the plugin in whatever goes wrong.

    The code has a thread of its own, so that one that hangs is given up after the owner's patience, and that
    a ``SystemExit`` or ``KeyboardInterrupt`` of its own ends nothing but itself. What it prints goes to
    stderr. What it changes of the process is put back and noted with the owner.

    Args:
        owner: Whose code it is.
        what: What runs, for messages; "" for the loading of the plugin.
        work: The code.
        watch: Whether to look for changes of the process.

    Returns:
        What the code returned.

    Raises:
        PluginLoadError: It raised, or did not return in time.
        LabseqError: It raised this one of labseq's own.
    """
    job = _Job(work, ProcessState() if watch else None)
    thread = threading.Thread(target=job.run, name=f"labseq plugin {owner.name}", daemon=True)
    deadline = time.monotonic() + owner.max_wait_s
    try:  # from here on: Ctrl-C may come while the thread starts
        thread.start()
        while not job.done.wait(min(_LOOK_S, max(0.0, deadline - time.monotonic()))):
            if time.monotonic() >= deadline and not job.done.is_set():
                raise owner.fault(_hung(what, owner.max_wait_s))
    finally:
        job.leave()
        for change in job.changes:
            owner.note(f"{f'in {what}' if what else 'while it was loaded'} {change}")
    if job.error is not None:
        raise _named(owner, what, job.error) from job.error
    return job.result


class _Job:
    def __init__(self, work: Callable[[], Any], surroundings: ProcessState | None) -> None:
        self._work = work
        self._surroundings = surroundings
        self._leaving = threading.Lock()
        self.changes: list[str] = []
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            with self._leaving:
                if self._surroundings is not None:
                    self._surroundings.enter()
            self.result = self._work()
        except BaseException as error:  # noqa: BLE001 - a plugin may raise anything
            self.error = error
        finally:
            self.leave(inside=True)
            self.done.set()

    def leave(self, *, inside: bool = False) -> None:
        """Put back what was changed, once: by the thread itself, or by the one that gives it up."""
        with self._leaving:
            surroundings, self._surroundings = self._surroundings, None
            if surroundings is not None:
                self.changes = surroundings.leave(inside=inside)


def _hung(what: str, max_wait_s: float) -> str:
    did = f"{what} did not return" if what else "it did not finish loading"
    remedy = "if it is only slow, raise 'timeouts: {load: ...}' in the profile"
    return f"{did} within {max_wait_s:.3g} s and was given up; {remedy}"


def _named(owner: Owner, what: str, error: BaseException) -> LabseqError:
    is_own = isinstance(error, PluginLoadError) and error.plugin == owner.name
    if isinstance(error, LabseqError) and (what or is_own):
        return error
    text = f"{type(error).__name__}: {error.msg}" if isinstance(error, SyntaxError) else format_error(error)
    place = error_location(error, owner.home)
    text = f"{text} ({place})" if place else text
    return owner.fault(f"{what} raised {text}" if what else text)
