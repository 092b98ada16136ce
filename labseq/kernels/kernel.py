"""Compiles functions by numba with explicit signatures, and caches them by all that they are compiled from.

Because every kernel has explicit signatures, no new dtype or layout can cost a compile in the middle of a
shot. :func:`load_kernels` compiles the kernels of all imported modules or loads them from the user's cache.
Without it, the first call of a kernel does. Several processes compile the missing kernels. numba itself is
imported only then.

The cache is numba's own, which does not notice that a constant or a function in another file has changed. The
folder of each kernel is therefore named after all that it is compiled from, which is its bytecode and the
constants that it names, the same for all kernels that it calls, and the versions of Python, numba and numpy.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache, cached_property, partial, update_wrapper
from importlib.metadata import version
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numpy as np

from labseq.errors import LabseqError, PluginLoadError
from labseq.files import cache_root

F = TypeVar("F", bound=Callable[..., Any])

WORTH_A_PROCESS_S: Final = 3.0
"""Kernels that compile faster than this, in seconds, are compiled in this process."""

_INTERPRETED = threading.Event()
_PENDING: dict[_Kernel, None] = {}  # not compiled or loaded yet
_ANNOUNCE: list[Callable[[float], None]] = []
_LOADING = threading.RLock()
_TEACH: list[Callable[[], object]] = []


def const(dtype: str, ndim: int) -> str:
    """Type of a C-contiguous array that a kernel only reads, for a signature.

    Takes read-only and writeable arrays. numba's ``dtype[:, ::1]`` refuses read-only arrays.

    Example:
        >>> const("bool_", 2)
        "Array(bool_, 2, 'C', readonly=True)"
    """
    return f"Array({dtype}, {ndim}, 'C', readonly=True)"


def kernel(signature: str | Sequence[str], *, fused: bool = False, for_c: bool = False) -> Callable[[F], F]:
    """Compile a function for the given signatures, without the GIL, into the cache.

    With ``NUMBA_DISABLE_JIT=1`` the function stays plain Python.

    Args:
        signature: numba signature such as ``f"int64({const('bool_', 2)}, float64)"``, or several signatures.
        fused: Let ``a * b + c`` be rounded once instead of twice, if the processor can. That is faster, but
            the last digit may differ between processors.
        for_c: Only code in C calls the kernel, by :func:`c_address`. Its only signature takes and returns
            int64.
    """
    return _decorator(signature, fused, is_helper=False, for_c=for_c)


def c_address(function: Callable[..., Any]) -> int:
    """Address at which code in C can call a kernel made with ``for_c``, which is loaded if necessary."""
    return cast("_Kernel", function).c_address


def helper_kernel(signature: str | Sequence[str] = (), *, fused: bool = False) -> Callable[[F], F]:
    """Like :func:`kernel`, for a function that only kernels call. It is not loaded if they are in the cache.

    Without a signature numba infers the types, and the function is compiled as part of each kernel that calls
    it. Python may also call it. The first call then compiles it, or loads it from the cache.
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


def cache_problem() -> str:
    """Why compiled kernels cannot be cached, and the remedy, or "" if they can."""
    folder, remedy = "the user's cache", "set LABSEQ_CACHE to a folder that you may write to"
    try:
        folder = str(cache_root())
        (cache_root() / "kernels").mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache_root() / "kernels"):
            return ""
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return f"{folder} cannot be written ({reason.lower()}); {remedy}"


def load_kernels(poll: Callable[[], None] = lambda: None) -> None:
    """Compile the kernels of all modules imported so far, or load them from the cache.

    Args:
        poll: Called while waiting for processes, and before each kernel.

    Raises:
        PluginLoadError: A kernel cannot be compiled.
    """
    pending = [item for item in list(_PENDING) if item.is_in_use()]
    if not pending or _is_interpreted():
        return
    if not all(item.is_cached() for item in pending if not item.is_helper):
        _compile_in_processes([item for item in pending if not item.is_cached()], poll)
    for item in [item for item in pending if not item.is_helper]:
        poll()
        try:
            item.load()
        except Exception as error:
            _PENDING.pop(item, None)  # the next session may do without it
            reason = f"kernel '{item.function.__name__}' cannot be compiled: {type(error).__name__}: {error}"
            raise error if isinstance(error, LabseqError) else PluginLoadError(item.module, reason) from error


def _decorator(
    signature: str | Sequence[str], fused: bool, *, is_helper: bool, for_c: bool = False
) -> Callable[[F], F]:
    signatures = [signature] if isinstance(signature, str) else list(signature)
    return lambda function: cast(
        "F", _Kernel(cast("FunctionType", function), signatures, fused, is_helper, for_c)
    )


@cache
def _numba() -> Any:
    """numba, after it has learned how kernels call other kernels."""
    import numba
    from llvmlite import binding
    from numba.extending import typeof_impl

    # LLVM prefers vectors of 256 bits on all of Intel's processors. From Ice Lake on, rendering takes a
    # quarter less time with 512 (Sapphire Rapids).
    settings, features = cast("Any", numba).config, binding.get_host_cpu_features()
    if features.get("avx512vbmi2") and settings.ENABLE_AVX and settings.CPU_FEATURES is None:
        settings.CPU_FEATURES = f"{features.flatten()},-prefer-256-bit"

    def typeof(value: _Kernel, _: object) -> Any:
        return cast("Any", numba.types).Dispatcher(value.dispatcher)

    cast("Any", typeof_impl).register(_Kernel)(typeof)
    for teach in _TEACH:
        teach()
    return numba  # as Any: it ships no types


def with_numba(teach: Callable[[], object]) -> None:
    """Call a function that teaches numba something, as soon as numba is needed."""
    _TEACH.append(teach)
    if _numba.cache_info().currsize:
        teach()


def _is_interpreted() -> bool:
    return _INTERPRETED.is_set() or os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}


class _Kernel:
    """A function that is compiled, or loaded from the cache, when it is first needed."""

    def __init__(
        self, function: FunctionType, signatures: list[str], fused: bool, is_helper: bool, for_c: bool
    ) -> None:
        update_wrapper(self, function)
        self.function = function
        self.signatures = signatures
        self.is_helper = is_helper
        self._kind = "kernels" if is_helper else "python"
        self.for_c = for_c
        self._options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"} if fused else False}
        self._dispatchers: dict[str, Any] = {}
        self._call: Callable[..., Any] = self._first_call
        if signatures:
            _PENDING[self] = None

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def _first_call(self, *args: Any) -> Any:
        self._call = self.function if _is_interpreted() else self._dispatcher("python")
        return self._call(*args)

    def __reduce__(self) -> str:
        return self.function.__qualname__

    def load(self) -> None:
        """Compile it, or load it from the cache, for its callers, which are C, Python, or only kernels."""
        _ = self.c_address if self.for_c else self.dispatcher

    @property
    def dispatcher(self) -> Any:
        """The compiled or loaded function that other kernels call, and also Python unless it is a helper."""
        return self._dispatcher(self._kind)

    def _dispatcher(self, kind: str) -> Any:
        with _LOADING:
            if not self.signatures and kind not in self._dispatchers:
                self._compile(kind, None)  # its callers' caches hold it
            elif kind not in self._dispatchers:
                self._cached(kind, partial(self._compile, kind))
        return self._dispatchers[kind]

    def _compile(self, kind: str, file: Path | None) -> None:
        """Compile for Python or for other kernels, with ``file`` as in :meth:`_function`."""
        # only functions that Python calls take Python's objects, which needs a fifth of the compile time
        options = self._options | {"cache": file is not None, "no_cpython_wrapper": kind == "kernels"}
        dispatcher = self._dispatchers[kind] = _numba().njit(**options)(self._function(file))
        try:
            for signature in self.signatures:
                dispatcher.compile(signature)  # it may need the dispatcher, to call itself
        except BaseException:
            del self._dispatchers[kind]
            raise
        if self.signatures:
            dispatcher.disable_compile()

    @cached_property
    def c_address(self) -> int:
        """See :func:`c_address`. Gives the address of a Python function if kernels are not compiled."""
        if _is_interpreted():
            word = ctypes.c_int64
            self._c = ctypes.CFUNCTYPE(word, *[word] * self.function.__code__.co_argcount)(self.function)
            return ctypes.cast(self._c, ctypes.c_void_p).value or 0
        with _LOADING:
            self._cached("c", self._compile_for_c)
        return int(self._c.address)

    def _compile_for_c(self, file: Path | None) -> None:
        options = {key: value for key, value in self._options.items() if key != "nogil"}
        compiler = _numba().cfunc(self.signatures[0], cache=file is not None, **options)
        self._c: Any = compiler(self._function(file))

    def _function(self, file: Path | None) -> FunctionType:
        """The function as if it were alone in ``file``, for numba's cache. None means no cache.

        numba looks at the file of a function and at its line, and would compile it again in another copy
        of labseq, or after another function in its file was edited.
        """
        function = self.function
        if file is None:
            return function
        code = function.__code__.replace(co_filename=str(file), co_firstlineno=1)
        return FunctionType(
            code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
        )

    def _cached(self, kind: str, compile_it: Callable[[Path | None], None]) -> None:
        """Compile with numba's cache in the kernel's folder, or without it if that cannot be written to."""
        home, settings = self.folder, _numba().config
        folder, file = home / kind, home / "kernel.py"
        if not folder.is_dir():
            _announce_compiling(self)
        before, cached_file = settings.CACHE_DIR, None
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(home)
            _delete_unused(home.parent)
            with suppress(FileExistsError):  # numba before 0.63 knows it by its date
                file.touch(exist_ok=False)
            cached_file = file
        settings.CACHE_DIR = str(folder)
        try:
            compile_it(cached_file)
        except Exception:  # noqa: BLE001 - a crash may have truncated any file, and other errors come again
            shutil.rmtree(folder, ignore_errors=True)
            _announce_compiling(self)
            try:
                compile_it(cached_file)
            except Exception:  # noqa: BLE001 - it comes again, and names the line in the author's file
                compile_it(None)
        finally:
            settings.CACHE_DIR = before
        _PENDING.pop(self, None)

    @property
    def folder(self) -> Path:
        """The kernel's folder in the cache."""
        return cache_root() / "kernels" / f"{self.function.__name__}-{self.digest}"

    @property
    def module(self) -> str:
        return self.function.__module__

    @property
    def compile_s(self) -> float:
        """Roughly how long compiling takes, in seconds."""
        # measured on two cores
        within = [self, *(callee for callee in self.callees if not callee.signatures)]
        n_instructions = sum(30 + len(item.function.__code__.co_code) / 10 for item in within)
        return 0.0044 * len(self.signatures) * n_instructions

    def is_in_use(self) -> bool:
        """False if its module was edited and imported again since."""
        return getattr(sys.modules.get(self.module), "__dict__", None) is self.function.__globals__

    def is_cached(self) -> bool:
        return any(self.folder.glob(f"{'c' if self.for_c else self._kind}/*/kernel.*.nbi"))

    @cached_property
    def named(self) -> dict[str, Any]:
        """Values of all names in its code except its own variables."""
        code, cells = self.function.__code__, self.function.__closure__ or ()
        scope = self.function.__globals__ | dict(zip(code.co_freevars, cells, strict=True))
        objects = {name: scope[name] for name in _names(code) if name in scope}
        values = {name: getattr(value, "cell_contents", value) for name, value in objects.items()}
        modules = [value for value in values.values() if isinstance(value, ModuleType)]
        for module in modules:  # and their values, such as a.b.SPEED
            of_module = {name: vars(module)[name] for name in _names(code) if name in vars(module)}
            values |= {f"{module.__name__}.{name}": value for name, value in of_module.items()}
            modules += [
                module_within
                for module_within in of_module.values()
                if isinstance(module_within, ModuleType) and module_within not in modules
            ]
        return values

    @cached_property
    def callees(self) -> list[_Kernel]:
        """The kernels that it calls, directly or through other kernels."""
        reached: list[_Kernel] = [self]
        for item in reached:
            called = [value for value in item.named.values() if isinstance(value, _Kernel)]
            reached += [callee for callee in dict.fromkeys(called) if callee not in reached]
        return reached[1:]

    @cached_property
    def source(self) -> str:
        """Text of all that it is compiled from, without the kernels that it calls."""
        constants = [_constant(name, value) for name, value in sorted(self.named.items())]
        options = (self.module, self.function.__qualname__, self.signatures, self._options, self.for_c)
        return repr((options, _code(self.function.__code__), [text for text in constants if text]))

    @cached_property
    def digest(self) -> str:
        """Digest of everything that it is compiled from."""
        parts = [_environment(), self.source, *sorted(item.source for item in self.callees)]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


@cache
def _environment() -> str:
    """Text of everything except its source that a kernel depends on, and that numba ignores."""
    settings = sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    taught = Path(__file__).with_name("native_code.py").read_bytes()  # of functions that kernels call
    return repr((sys.version, *map(version, ("numba", "llvmlite", "numpy")), settings, taught))


def _names(code: CodeType) -> Iterator[str]:
    """All names in the code of a function and of the functions within it."""
    yield from (*code.co_names, *code.co_freevars)
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _names(value)


def _code(code: CodeType) -> tuple[object, ...]:
    """A function's code without its place in the file."""
    values = [_code(value) if isinstance(value, CodeType) else value for value in code.co_consts]
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return code.co_code, values, names, code.co_flags, code.co_argcount, code.co_kwonlyargcount


def _constant(name: str, value: object) -> str:
    """Text of a constant that a kernel is compiled with, or "" for anything else."""
    if isinstance(value, np.ndarray):
        return repr((name, value.dtype.str, value.shape, value.tobytes()))
    if isinstance(value, tuple):
        return repr([_constant(name, item) for item in cast("tuple[object, ...]", value)])
    if (function := getattr(value, "py_func", None)) is not None:  # compiled by numba itself
        return repr((name, _code(function.__code__)))
    if isinstance(value, bool | int | float | complex | str | np.generic):
        return repr((name, type(value).__name__, value))
    if isinstance(value, type) and hasattr(value, "__members__"):  # an enumeration
        return repr((name, list(cast("Any", value))))
    if isinstance(value, np.dtype):  # of records, with names and places of the columns
        return repr((name, dict(cast("Any", value).fields or {})))
    if isinstance(value, type) and hasattr(value, "_fields"):  # a named tuple
        return repr((name, cast("Any", value)._fields))
    return ""


def _announce_compiling(kernel: _Kernel) -> None:
    while _ANNOUNCE:
        missing = {kernel, *(other for other in list(_PENDING) if not other.is_cached())}
        _ANNOUNCE.pop()(sum(other.compile_s for other in missing))


def _compile_in_processes(kernels: list[_Kernel], poll: Callable[[], None]) -> None:
    """Let several processes compile kernels into the cache, a module at a time. Failures are ignored."""
    import multiprocessing
    from graphlib import TopologicalSorter

    from labseq.workers import POLL_S, ProcessWorkers

    seconds, graph = dict[str, float](), dict[str, set[str]]()
    for item in kernels:
        seconds[item.module] = seconds.get(item.module, 0.0) + item.compile_s
        graph.setdefault(item.module, set()).update(callee.module for callee in item.callees)
    # each process needs about 200 MB
    n_workers = min(4, n_cores(), len(seconds))
    if multiprocessing.current_process().daemon:
        return  # workers of a campaign or a cluster may not start processes
    if cache_problem():
        return  # the compiled kernels would be lost
    if n_workers < 2 or sum(seconds.values()) < WORTH_A_PROCESS_S:
        return
    while _ANNOUNCE:
        _ANNOUNCE.pop()(1.0 + max(sum(seconds.values()) / n_workers, *seconds.values()))
    order = TopologicalSorter({module: (on & seconds.keys()) - {module} for module, on in graph.items()})
    order.prepare()
    modules, ready, n_out = [*seconds], list[str](), 0
    with closing(ProcessWorkers(n_workers, "module")) as workers, suppress(LabseqError):
        workers.prepare(_make_compiler, None)
        while order.is_active():
            ready = sorted([*ready, *order.get_ready()], key=lambda module: seconds[module])
            while ready and n_out < n_workers:
                module = ready.pop()
                workers.submit(modules.index(module), module)
                n_out += 1
            for number, _ in workers.finished(POLL_S):
                order.done(modules[number])
                n_out -= 1
            poll()


def _make_compiler(_: None) -> Callable[[str], None]:
    """Prepare a process that compiles the kernels of modules into the cache."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):  # a module may print
        os.dup2(nothing, output)

    def compile_module(name: str) -> None:
        with suppress(Exception):
            importlib.import_module(name)
            for item in [item for item in _PENDING if item.module == name]:
                item.load()

    return compile_module


def n_cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # unavailable on Windows and macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_CLEANED: set[Path] = set()


def _delete_unused(root: Path) -> None:
    """Delete folders of kernels that no process has loaded for long, once per process.

    The age of a folder counts at most up to the last loaded folder, so a clock that is ahead deletes none.
    """
    if root in _CLEANED:
        return
    _CLEANED.add(root)
    used_s = {path: path.stat().st_mtime for path in root.iterdir() if path.is_dir()}
    too_old = min(time.time(), max(used_s.values(), default=0.0)) - 30 * 86400
    for path, last_s in used_s.items():
        if last_s < too_old:
            shutil.rmtree(path, ignore_errors=True)  # another process may be deleting it too
