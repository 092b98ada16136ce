"""Compiled functions: a numba decorator that takes explicit signatures, and a cache keyed by the source.

Because every kernel has explicit signatures, no new dtype or layout can cost a compile
in the middle of a shot. After its module was imported, :func:`load_kernels` compiles a
kernel or loads its machine code from the user's cache; otherwise its first call does.
Several processes compile what the cache lacks. A helper, which only kernels call, is part
of their machine code and is not loaded.

numba's own cache notices an edit of a kernel's file, but not of a kernel or constant
imported from another file: it would continue to use the old machine code. So each
kernel is kept in a folder named after everything that it is compiled from: its file,
the kernels that its module imports from other files (and theirs), the constants that
it names, numba's settings, and the versions of Python, numba and numpy. An edit
anywhere therefore leads to a new folder.
"""

from __future__ import annotations

import gc
import hashlib
import importlib
import os
import pickle
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numpy as np

from labseq.errors import LabseqError, PluginLoadError
from labseq.files import cache_root

F = TypeVar("F", bound=Callable[..., Any])

UNUSED_DAYS: Final = 30
"""Compiled kernels that no process has loaded for this many days are deleted."""
MAX_WORKERS: Final = 4
"""Maximum number of processes that compile; each needs about 200 MB."""
WORTH_A_PROCESS_S: Final = 3.0
"""What would take less than this is compiled without starting processes."""
COMPILE_S: Final = 0.003
"""Scale of the estimates of the time for compiling, in seconds; measured on a laptop's core."""

_FOLDER_NAME = re.compile(r"[0-9a-f]{24}")
_INTERPRETED = threading.Event()
_KERNELS: dict[int, tuple[Any, str]] = {}  # id of a kernel -> itself, its digest
_PENDING: dict[int, _Kernel] = {}  # id of a kernel that is neither compiled nor loaded yet
_ANNOUNCE: list[Callable[[float], None]] = []


@dataclass(eq=False)
class _Kernel:
    """A kernel, and what is needed to compile or load it; its folder is None if it cannot be kept."""

    dispatcher: Any
    signatures: list[str]
    folder: Path | None
    is_helper: bool
    builds_on: frozenset[str]  # modules
    is_begun: bool = False

    @property
    def module(self) -> str:
        return self.dispatcher.py_func.__module__

    @property
    def compile_s(self) -> float:
        """Roughly how long compiling takes, in seconds."""
        return COMPILE_S * len(self.signatures) * (30 + len(self.dispatcher.py_func.__code__.co_code) / 10)

    def is_in_use(self) -> bool:
        """Whether its module is the imported one, and not one that was edited and imported again since."""
        return getattr(sys.modules.get(self.module), "__dict__", None) is self.dispatcher.py_func.__globals__

    def is_cached(self) -> bool:
        if self.folder is None:
            return False
        code, cache = self.dispatcher.py_func.__code__, self.dispatcher._cache  # noqa: SLF001
        # a copy of labseq in another place has a folder of its own below that of the digest
        return any(Path(cache.cache_path).glob(f"*{code.co_name}-{code.co_firstlineno}.*.nbi"))


def const(dtype: str, ndim: int) -> str:
    """Type of a C-contiguous array that a kernel only reads, for a signature.

    Takes read-only and writeable arrays alike; numba's ``dtype[:, ::1]`` refuses
    read-only ones.

    Example:
        >>> const("bool_", 2)
        "Array(bool_, 2, 'C', readonly=True)"
    """
    return f"Array({dtype}, {ndim}, 'C', readonly=True)"


def kernel(signature: str | Sequence[str], *, fused: bool = False) -> Callable[[F], F]:
    """Compile a function for the given signatures, without the GIL, into the cache.

    With ``NUMBA_DISABLE_JIT=1`` the function stays plain Python.

    Args:
        signature: numba signature such as ``f"int64({const('bool_', 2)}, float64)"``,
            or several of them.
        fused: Let ``a * b + c`` be rounded once instead of twice, where the processor
            can. That is faster, but the last digit may differ between processors.
    """
    return _decorator(signature, fused, is_helper=False)


def helper_kernel(signature: str | Sequence[str], *, fused: bool = False) -> Callable[[F], F]:
    """Like :func:`kernel`, for a function that only kernels call: nothing to load if they are in the cache.

    Python may call it, too; the first call then takes a few milliseconds longer.
    """
    return _decorator(signature, fused, is_helper=True)


def interpret() -> None:
    """Use plain Python for all kernels from now on, for a process that calls them only a few times.

    Loading numba would take longer. Does nothing if numba is already loaded, or if
    ``NUMBA_DISABLE_JIT`` is set, to 0 as well as to 1.
    """
    if "numba" not in sys.modules and "NUMBA_DISABLE_JIT" not in os.environ:
        _INTERPRETED.set()


@contextmanager
def announcing(announce: Callable[[float], None]) -> Generator[None]:
    """Call ``announce(seconds)`` before the first kernel is compiled, with roughly how long compiling takes.

    It is not called if all kernels come from the cache.
    """
    _ANNOUNCE.append(announce)
    try:
        yield
    finally:
        with suppress(ValueError):  # it was called
            _ANNOUNCE.remove(announce)


def load_kernels(poll: Callable[[], None] = lambda: None) -> None:
    """Compile the kernels of all modules imported so far, or load them from the cache.

    Args:
        poll: Called while it waits for processes, and before each kernel.

    Raises:
        PluginLoadError: A kernel cannot be compiled.
    """
    wanted = [one for one in _PENDING.values() if one.is_in_use() and not one.is_helper]
    if not all(one.is_cached() for one in wanted):
        _compile_in_processes(
            [one for one in _PENDING.values() if one.is_in_use() and not one.is_cached()], poll
        )
    for one in wanted:
        poll()
        try:
            _load(one)
        except Exception as error:
            _PENDING.pop(id(one.dispatcher), None)  # the next session may do without it
            name = one.dispatcher.py_func.__name__
            reason = f"kernel '{name}' cannot be compiled: {type(error).__name__}: {error}"
            raise error if isinstance(error, LabseqError) else PluginLoadError(one.module, reason) from error


def _numba() -> Any:
    import numba

    return numba  # as Any: it ships no types


def _decorator(signature: str | Sequence[str], fused: bool, *, is_helper: bool) -> Callable[[F], F]:
    signatures = [signature] if isinstance(signature, str) else list(signature)

    def decorate(function: F) -> F:
        if _INTERPRETED.is_set() or _numba().config.DISABLE_JIT:
            return function
        return cast("F", _define(cast("FunctionType", function), signatures, fused, is_helper))

    return decorate


def _define(function: FunctionType, signatures: list[str], fused: bool, is_helper: bool) -> Any:
    from numba.core.compiler_lock import global_compiler_lock

    config = _numba().config
    with global_compiler_lock:
        callees = _callees(function)
        digest = _digest(function, callees)
        folder = _folder(digest) if Path(function.__code__.co_filename).is_file() else None
        before = config.CACHE_DIR  # kernels of other packages stay where they are
        config.CACHE_DIR = str(folder or "")
        try:
            dispatcher = _numba().njit(
                cache=folder is not None,
                nogil=True,
                error_model="numpy",
                no_cfunc_wrapper=True,
                fastmath={"contract"} if fused else False,
            )(function)
        finally:
            config.CACHE_DIR = before
        _KERNELS[id(dispatcher)] = dispatcher, digest
        builds_on = frozenset(callee.py_func.__module__ for callee, _ in callees)
        _defer(_Kernel(dispatcher, signatures, folder, is_helper, builds_on))
    return dispatcher


def _defer(one: _Kernel) -> None:
    """Load a kernel when Python calls it or numba compiles a call of it, if not before."""
    dispatcher = one.dispatcher

    def callable_for(*_: Any) -> Any:
        _load(one)
        return dispatcher

    def get_call_template(args: Any, kws: Any) -> Any:
        _load(one)
        return type(dispatcher).get_call_template(dispatcher, args, kws)

    # Attributes of the object go before those of its class. They stay once it is loaded: a thread whose
    # call began before that would otherwise ask numba to compile, which is disabled by then.
    dispatcher._compile_for_args = callable_for  # noqa: SLF001
    dispatcher.get_call_template = get_call_template
    _PENDING[id(dispatcher)] = one


def _load(one: _Kernel) -> None:
    """Load a kernel from the cache, or compile it with all that it calls."""
    from numba.core.compiler_lock import global_compiler_lock

    dispatcher = one.dispatcher
    with global_compiler_lock:
        if one.is_begun:  # it calls itself, or another thread was faster
            return
        one.is_begun = True
        _PENDING.pop(id(dispatcher), None)
        try:
            try:
                _build(one)
            except (OSError, EOFError, pickle.UnpicklingError):
                # a full disk, or files truncated by a crash: compile without the cache
                if one.folder is not None:
                    shutil.rmtree(one.folder, ignore_errors=True)
                dispatcher._cache.disable()  # noqa: SLF001
                _build(one)
            dispatcher.disable_compile()
        except BaseException:
            one.is_begun = False
            _PENDING[id(dispatcher)] = one
            raise


def _build(one: _Kernel) -> None:
    from numba.core import event
    from numba.core.runtime.nrt import rtsys

    context = one.dispatcher.targetctx

    class Compiling(event.Listener):
        def on_start(self, event: Any) -> None:  # noqa: ARG002 - numba names it
            vars(context).pop("refresh", None)
            while _ANNOUNCE:
                missing = [one, *(other for other in _PENDING.values() if not other.is_cached())]
                _ANNOUNCE.pop()(sum(other.compile_s for other in missing))

        def on_end(self, event: Any) -> None:
            pass

    # before numba loads machine code, it would import all that it needs for compiling, which takes 0.4 s
    rtsys.initialize(context)
    context.refresh = lambda: None
    try:
        with event.install_listener("numba:compile", Compiling()):
            for signature in one.signatures:
                one.dispatcher.compile(signature)
    finally:
        vars(context).pop("refresh", None)


def _compile_in_processes(kernels: list[_Kernel], poll: Callable[[], None]) -> None:
    """Let several processes compile kernels into the cache, a module at a time; failures are ignored."""
    from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
    from graphlib import TopologicalSorter

    seconds, graph = dict[str, float](), dict[str, set[str]]()
    for one in kernels:
        seconds[one.module] = seconds.get(one.module, 0.0) + one.compile_s
        graph.setdefault(one.module, set()).update(one.builds_on)
    n_workers = min(MAX_WORKERS, n_cores(), len(seconds))
    if n_workers < 2 or sum(seconds.values()) < WORTH_A_PROCESS_S:
        return
    while _ANNOUNCE:
        _ANNOUNCE.pop()(1.0 + max(sum(seconds.values()) / n_workers, *seconds.values()))
    order = TopologicalSorter({module: on & seconds.keys() for module, on in graph.items()})
    order.prepare()
    with ThreadPoolExecutor(n_workers) as pool, ExitStack() as stack:
        idle = [stack.enter_context(_Worker()) for _ in range(n_workers)]
        busy: dict[Future[None], tuple[_Worker, str]] = {}
        ready: list[str] = []
        while order.is_active():
            ready += order.get_ready()
            ready.sort(key=lambda module: seconds[module])
            while idle and ready:
                worker, module = idle.pop(), ready.pop()
                busy[pool.submit(worker.compile, module)] = worker, module
            for done in wait(busy, 0.1, FIRST_COMPLETED).done:
                worker, module = busy.pop(done)
                idle.append(worker)
                order.done(module)
            poll()


class _Worker:
    """A process that compiles the kernels of modules into the cache."""

    def __enter__(self) -> _Worker:
        import subprocess

        self._process = subprocess.Popen(
            [sys.executable, "-c", "from labseq.kernel import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            text=True,
        )
        return self

    def compile(self, module: str) -> None:
        """Ask for a module, and wait; returns at once if the process has ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(OSError, ValueError):
            print(module, file=self._process.stdin, flush=True)
            self._process.stdout.readline()

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        with self._process:
            pass


def serve() -> None:
    """Compile the kernels of each module that standard input names, one per line."""
    gc.disable()  # there are no cycles to speak of, and compiling takes a sixth less time
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # a module may print
    for line in sys.stdin:
        with suppress(Exception):
            importlib.import_module(line.strip())
            for one in [one for one in _PENDING.values() if one.module == line.strip()]:
                _load(one)
        print("done", file=answer, flush=True)


def n_cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # unavailable on Windows and macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _callees(function: FunctionType) -> list[tuple[Any, str]]:
    """The kernels that a function's module imports from other files, with their digests."""
    taken = list(function.__globals__.values())
    for module in [value for value in taken if isinstance(value, ModuleType)]:
        taken += vars(module).values()
    kernels = [_KERNELS[id(value)] for value in taken if id(value) in _KERNELS]
    file = function.__code__.co_filename
    return [(kernel, digest) for kernel, digest in kernels if kernel.py_func.__code__.co_filename != file]


def _digest(function: FunctionType, callees: list[tuple[Any, str]]) -> str:
    """Digest of everything that a kernel is compiled from."""
    parts: list[object] = [sys.version, _numba().__version__, np.__version__]
    parts += sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    parts.append(_source(function))
    parts += sorted({digest for _, digest in callees})
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, np.ndarray):
            parts.append((name, value.dtype.str, value.shape, value.tobytes()))
        elif isinstance(value, bool | int | float | complex | str | tuple | np.generic):
            parts.append((name, value))
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


def _source(function: FunctionType) -> bytes:
    try:
        return Path(function.__code__.co_filename).read_bytes()
    except OSError:  # typed at a prompt
        return function.__code__.co_code


def _folder(digest: str) -> Path | None:
    """Create the folder of a digest and mark it as used; None if nothing can be written."""
    try:
        root = cache_root() / "kernels"
        folder = root / digest
        if not folder.exists():
            _delete_unused(root)
            folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return None
    return folder


def _delete_unused(root: Path) -> None:
    too_old = time.time() - UNUSED_DAYS * 86400
    for folder in root.iterdir() if root.is_dir() else ():
        ours = _FOLDER_NAME.fullmatch(folder.name) and not folder.is_symlink()
        with suppress(OSError):  # another process may be deleting it too
            if ours and folder.stat().st_mtime < too_old:
                shutil.rmtree(folder, ignore_errors=True)
