"""Compiled functions: a numba decorator that takes explicit signatures, and a cache of machine code.

Because every kernel has explicit signatures, no new dtype or layout can cost a compile
in the middle of a shot. :func:`load_kernels` compiles the kernels of all imported modules or
loads them from the user's cache; otherwise the first call of a kernel does. Several processes
compile what the cache lacks. numba itself is imported only then.

What Python calls is kept as machine code, what other kernels call as bitcode for linking.
Each is made when something needs it, and kept in a file named after everything that it is
compiled from: the function's bytecode, the constants that it names, the same of all kernels
that it calls, the processor, numba's settings, and the versions of Python, numba and numpy.
An edit anywhere therefore leads to a new file.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
import importlib
import os
import pickle
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property, update_wrapper
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numpy as np

from labseq.errors import LabseqError, PluginLoadError
from labseq.files import cache_root
from labseq.machine_code import (
    MachineCode,
    calling,
    compile_for_python,
    environment,
    load,
    make_only_bitcode,
    packed,
    prefer_wide_vectors,
    unpacked,
)

F = TypeVar("F", bound=Callable[..., Any])

UNUSED_DAYS: Final = 30
"""Compiled kernels that no process has loaded for this many days are deleted."""
MAX_WORKERS: Final = 4
"""Maximum number of processes that compile; each needs about 200 MB."""
WORTH_A_PROCESS_S: Final = 3.0
"""What would take less than this is compiled without starting processes."""
COMPILE_S: Final = 0.0031
"""Scale of the estimates of the time for compiling, in seconds; measured on two cores."""

_INTERPRETED = threading.Event()
_PENDING: dict[_Kernel, None] = {}  # neither compiled nor loaded yet
_ANNOUNCE: list[Callable[[float], None]] = []
_LOADING = threading.RLock()


def const(dtype: str, ndim: int) -> str:
    """Type of a C-contiguous array that a kernel only reads, for a signature.

    Takes read-only and writeable arrays alike; numba's ``dtype[:, ::1]`` refuses
    read-only ones.

    Example:
        >>> const("bool_", 2)
        "Array(bool_, 2, 'C', readonly=True)"
    """
    return f"Array({dtype}, {ndim}, 'C', readonly=True)"


def kernel(signature: str | Sequence[str], *, fused: bool = False, for_c: bool = False) -> Callable[[F], F]:
    """Compile a function for the given signatures, without the GIL, into the cache.

    With ``NUMBA_DISABLE_JIT=1`` the function stays plain Python.

    Args:
        signature: numba signature such as ``f"int64({const('bool_', 2)}, float64)"``,
            or several of them.
        fused: Let ``a * b + c`` be rounded once instead of twice, where the processor
            can. That is faster, but the last digit may differ between processors.
        for_c: Code in C calls it, too, by :func:`c_address`; its only signature takes and returns int64.
    """
    return _decorator(signature, fused, is_helper=False, for_c=for_c)


def c_address(function: Callable[..., Any]) -> int:
    """Address at which code in C can call a kernel that is made for it; it is loaded if need be."""
    return cast("_Kernel", function).c_address


def helper_kernel(signature: str | Sequence[str], *, fused: bool = False) -> Callable[[F], F]:
    """Like :func:`kernel`, for a function that only kernels call: nothing to load if they are in the cache.

    Python may call it, too; the first call then compiles it, or loads it from the cache.
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
    wanted = [one for one in list(_PENDING) if one.is_in_use()]
    if not wanted or _is_interpreted():
        return
    if not all(one.is_cached() for one in wanted if not one.is_helper):
        _compile_in_processes([one for one in wanted if not one.is_cached()], poll)
    for one in [one for one in wanted if not one.is_helper]:
        poll()
        try:
            one.load()
        except Exception as error:
            _PENDING.pop(one, None)  # the next session may do without it
            reason = f"kernel '{one.function.__name__}' cannot be compiled: {type(error).__name__}: {error}"
            raise error if isinstance(error, LabseqError) else PluginLoadError(one.module, reason) from error


def _decorator(
    signature: str | Sequence[str], fused: bool, *, is_helper: bool, for_c: bool = False
) -> Callable[[F], F]:
    signatures = [signature] if isinstance(signature, str) else list(signature)
    return lambda function: cast(
        "F", _Kernel(cast("FunctionType", function), signatures, fused, is_helper, for_c)
    )


def _numba() -> Any:
    import numba

    return numba  # as Any: it ships no types


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
        self.for_c = for_c
        self._options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"} if fused else False}
        self._dispatcher: Any = None  # for kernels that call it, and for itself while it is compiled
        self._call: Callable[..., Any] = self._first_call
        self._c_address = 0
        _PENDING[self] = None

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def _first_call(self, *args: Any) -> Any:
        if _is_interpreted():
            self._call = self.function
        else:
            self.load()
        return self._call(*args)

    def __reduce__(self) -> str:
        return self.function.__qualname__

    @property
    def _numba_type_(self) -> Any:
        """Numba asks for it when it compiles a call."""
        return _numba().types.Dispatcher(self._dispatcher or self.compile())

    def compile(self) -> Any:
        """Compile it or load its bitcode from the cache: numba's object that lets kernels call it."""
        from numba.core.compiler_lock import global_compiler_lock

        with global_compiler_lock:
            if self._dispatcher is None:
                prefer_wide_vectors()
                options = self._options | {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}
                self._dispatcher = _numba().njit(**options)(self.function)
                self._dispatcher._cache = _Bitcode(self)  # noqa: SLF001 - numba has no other way
                try:
                    for signature in self.signatures:
                        self._dispatcher.compile(signature)
                    self._dispatcher.disable_compile()
                except BaseException:
                    self._dispatcher = None
                    raise
                if self.is_helper:
                    _PENDING.pop(self, None)
        return self._dispatcher

    def load(self) -> None:
        """Compile it or load its machine code from the cache, for Python."""
        with _LOADING:
            if self._call == self._first_call:
                try:
                    codes = [*map(self._load, range(len(self.signatures)))]
                    self._c_address = codes[0][2]
                    self._call = calling(self.function.__name__, codes)
                except (AttributeError, ImportError, LookupError):  # another numba than machine_code knows
                    self._call = _numba().njit(self.signatures, **self._options)(self.function)
                if not self.is_helper:
                    _PENDING.pop(self, None)

    @cached_property
    def c_address(self) -> int:
        """See :func:`c_address`; of a function in Python where kernels are not compiled."""
        if self._call == self._first_call and not _is_interpreted():
            self.load()
        if not self._c_address:
            word = ctypes.c_int64
            self._for_c = ctypes.CFUNCTYPE(word, *[word] * self.function.__code__.co_argcount)(self)
            self._c_address = ctypes.cast(self._for_c, ctypes.c_void_p).value or 0
        return self._c_address

    def _load(self, number: int) -> tuple[MachineCode, Callable[..., Any], int]:
        path = self.path(number, "python")
        with suppress(Exception):  # whatever is wrong with the cache, it can be compiled
            return load(_read(path))
        _announce_compiling(self)
        code = compile_for_python(
            [*self.compile().overloads.values()][number],
            is_only=len(self.signatures) == 1,
            for_c=self.for_c,
        )
        _write(path, pickle.dumps(code))
        return load(code)

    def path(self, number: int, kind: str) -> Path:
        """File in the cache of the signature of that number: of the kind "python" or "kernels"."""
        return cache_root() / "kernels" / f"{self.function.__name__}-{self.digest}-{number}.{kind}"

    @property
    def module(self) -> str:
        return self.function.__module__

    @property
    def compile_s(self) -> float:
        """Roughly how long compiling takes, in seconds."""
        return COMPILE_S * len(self.signatures) * (30 + len(self.function.__code__.co_code) / 10)

    def is_in_use(self) -> bool:
        """Whether its module is the imported one, and not one that was edited and imported again since."""
        return getattr(sys.modules.get(self.module), "__dict__", None) is self.function.__globals__

    def is_cached(self) -> bool:
        kind = "kernels" if self.is_helper else "python"
        return all(self.path(number, kind).is_file() for number in range(len(self.signatures)))

    @cached_property
    def named(self) -> dict[str, Any]:
        """The values of all names in its code that are not its own variables."""
        code, cells = self.function.__code__, self.function.__closure__ or ()
        scope = self.function.__globals__ | dict(zip(code.co_freevars, cells, strict=True))
        found = {name: scope[name] for name in _names(code) if name in scope}
        for module in [value for value in found.values() if isinstance(value, ModuleType)]:
            found |= {f"{module.__name__}.{name}": vars(module).get(name) for name in _names(code)}
        return {name: getattr(value, "cell_contents", value) for name, value in found.items()}

    @property
    def callees(self) -> list[_Kernel]:
        return [value for value in self.named.values() if isinstance(value, _Kernel)]

    @cached_property
    def source(self) -> str:
        """What it is compiled from, without the kernels that it calls."""
        constants = [_constant(name, value) for name, value in sorted(self.named.items())]
        options = (self.module, self.function.__qualname__, self.signatures, self._options, self.for_c)
        return repr((options, _code(self.function.__code__), [text for text in constants if text]))

    @cached_property
    def digest(self) -> str:
        """Digest of everything that it is compiled from."""
        reached = [self]
        for one in reached:
            reached += [callee for callee in one.callees if callee not in reached]
        parts = [environment(), self.source, *sorted(one.source for one in reached)]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def _names(code: CodeType) -> Iterator[str]:
    """All names in a function's code, and in that of the functions within it."""
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
    """Text of a constant that a kernel is compiled with; "" for anything else."""
    if isinstance(value, np.ndarray):
        return repr((name, value.dtype.str, value.shape, value.tobytes()))
    if isinstance(value, bool | int | float | complex | str | tuple | np.generic):
        return repr((name, type(value).__name__, value))
    if isinstance(value, type) and hasattr(value, "__members__"):  # an enumeration
        return repr((name, list(cast("Any", value))))
    return ""


class _Bitcode:
    """Keeps a kernel's bitcode in files; numba's dispatcher uses it as its cache."""

    cache_path = None

    def __init__(self, owner: _Kernel) -> None:
        self._owner = owner

    def _path(self, signature: str) -> Path:
        return self._owner.path(self._owner.signatures.index(signature), "kernels")

    def load_overload(self, signature: str, context: Any) -> Any:
        """Numba's result of compiling, or None."""
        with suppress(Exception):  # whatever is wrong with the cache, it can be compiled
            return unpacked(_read(self._path(signature)), context)
        _announce_compiling(self._owner)
        return None

    def save_overload(self, signature: str, result: Any) -> None:
        """Write a file, unless that is impossible."""
        with suppress(Exception):
            _write(self._path(signature), packed(result))


def _announce_compiling(kernel: _Kernel) -> None:
    while _ANNOUNCE:
        missing = {kernel, *(other for other in list(_PENDING) if not other.is_cached())}
        _ANNOUNCE.pop()(sum(other.compile_s for other in missing))


def _read(path: Path) -> Any:
    """The object in a file of the cache."""
    data = path.read_bytes()
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        raise ValueError("truncated by a crash")
    found = pickle.loads(data[32:])  # noqa: S301
    with suppress(OSError):
        os.utime(path)
    return found


def _write(path: Path, data: bytes) -> None:
    """Write a file of the cache, unless that is impossible."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        _delete_unused(path.parent)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(data).digest() + data)
        try:
            Path(file.name).replace(path)
        except OSError:  # Windows: another process reads it
            Path(file.name).unlink()


def _compile_in_processes(kernels: list[_Kernel], poll: Callable[[], None]) -> None:
    """Let several processes compile kernels into the cache, a module at a time; failures are ignored."""
    from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
    from graphlib import TopologicalSorter

    seconds, graph = dict[str, float](), dict[str, set[str]]()
    for one in kernels:
        seconds[one.module] = seconds.get(one.module, 0.0) + one.compile_s
        graph.setdefault(one.module, set()).update(callee.module for callee in one.callees)
    n_workers = min(MAX_WORKERS, n_cores(), len(seconds))
    if n_workers < 2 or sum(seconds.values()) < WORTH_A_PROCESS_S:
        return
    while _ANNOUNCE:
        _ANNOUNCE.pop()(1.0 + max(sum(seconds.values()) / n_workers, *seconds.values()))
    order = TopologicalSorter({module: (on & seconds.keys()) - {module} for module, on in graph.items()})
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
    prefer_wide_vectors()
    make_only_bitcode()
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # a module may print
    for line in sys.stdin:
        with suppress(Exception):
            importlib.import_module(line.strip())
            for one in [one for one in _PENDING if one.module == line.strip()]:
                one.compile() if one.is_helper else one.load()
        print("done", file=answer, flush=True)


def n_cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # unavailable on Windows and macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_CLEANED: set[Path] = set()


def _delete_unused(folder: Path) -> None:
    """Delete files that no process has loaded for long, once per process.

    A clock that is ahead deletes none: the age of a file is at most that against the last one loaded.
    """
    if folder in _CLEANED:
        return
    _CLEANED.add(folder)
    used_s: dict[Path, float] = {}
    for path in folder.iterdir():
        with suppress(OSError):  # another process may be deleting it too
            if path.is_file():
                used_s[path] = path.stat().st_mtime
    too_old = min(time.time(), max(used_s.values(), default=0.0)) - UNUSED_DAYS * 86400
    for path, last_s in used_s.items():
        if last_s < too_old:
            with suppress(OSError):
                path.unlink()
