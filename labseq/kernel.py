"""Compiled functions: a numba decorator that takes explicit signatures, and a cache keyed by the source.

numba compiles when a decorated function is defined, because every kernel has
explicit signatures: no new dtype or layout can cost a compile in the middle of
a shot. Later processes load the machine code from the user's cache.

numba's own cache notices an edit of a kernel's file, but not of a kernel or constant
imported from another file: it would continue to use the old machine code. So each
kernel is kept in a folder named after everything that it is compiled from: its file,
the kernels that its module imports from other files (and theirs), the constants that
it names, numba's settings, and the versions of Python, numba and numpy. An edit
anywhere therefore leads to a new folder.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final, TypeVar, cast

import numpy as np

from labseq.files import cache_root

F = TypeVar("F", bound=Callable[..., Any])

UNUSED_DAYS: Final = 30
"""Compiled kernels that no process has loaded for this many days are deleted."""

_FOLDER_NAME = re.compile(r"[0-9a-f]{24}")
_LOCK = threading.RLock()
_INTERPRETED = threading.Event()
_MODULES: set[str] = set()
_KERNELS: dict[int, tuple[Any, str]] = {}  # id of a compiled kernel -> itself, its digest


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
    signatures = [signature] if isinstance(signature, str) else list(signature)

    def decorate(function: F) -> F:
        return cast("F", _compile(cast("FunctionType", function), signatures, fused))

    return decorate


def interpret() -> None:
    """Use plain Python for all kernels from now on, for a process that calls them only a few times.

    Loading numba would take longer. Does nothing if numba is already loaded, or if
    ``NUMBA_DISABLE_JIT`` is set, to 0 as well as to 1.
    """
    if "numba" not in sys.modules and "NUMBA_DISABLE_JIT" not in os.environ:
        _INTERPRETED.set()


@contextmanager
def announcing(announce: Callable[[str], None]) -> Generator[None]:
    """Call ``announce(module_name)`` before a module's first kernel is compiled.

    Modules whose kernels all come from the cache are not announced. Import the
    kernels (for a planner: ``warm()``) inside the ``with`` block.
    """
    if _INTERPRETED.is_set():
        yield
        return

    from numba.core import event

    announced: set[str] = set()

    class Announcer(event.Listener):
        def on_start(self, event: Any) -> None:
            module = event.data["dispatcher"].py_func.__module__
            if module in _MODULES and module not in announced:
                announced.add(module)
                announce(module)

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Announcer()):
        yield


def _numba() -> Any:
    import numba

    return numba  # as Any: it ships no types


def _compile(function: FunctionType, signatures: list[str], fused: bool) -> Any:
    if _INTERPRETED.is_set():
        return function
    numba = _numba()
    if numba.config.DISABLE_JIT:
        return function
    with _LOCK:
        digest = _digest(function)
        in_file = Path(function.__code__.co_filename).is_file()
        folder = _folder(digest) if in_file else None
        _MODULES.add(function.__module__)
        try:
            compiled = _jit(function, signatures, folder, fused)
        except (OSError, EOFError, pickle.UnpicklingError):
            # a full disk, or files truncated by a crash: compile without the cache
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            compiled = _jit(function, signatures, None, fused)
        _KERNELS[id(compiled)] = compiled, digest
    return compiled


def _jit(function: FunctionType, signatures: list[str], folder: Path | None, fused: bool) -> Any:
    """Compile, keeping the machine code in a folder (None: nowhere)."""
    numba = _numba()
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = (
        "" if folder is None else str(folder)
    )  # kernels of other packages stay where they are
    try:
        return numba.njit(
            signatures,
            cache=folder is not None,
            nogil=True,
            error_model="numpy",
            no_cfunc_wrapper=True,
            fastmath={"contract"} if fused else False,
        )(function)
    finally:
        numba.config.CACHE_DIR = before


def _digest(function: FunctionType) -> str:
    """Digest of everything that a kernel is compiled from."""
    parts: list[object] = [sys.version, _numba().__version__, np.__version__]
    parts += sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    parts.append(_source(function))
    module_globals = function.__globals__
    taken = list(module_globals.values())
    for module in [value for value in taken if isinstance(value, ModuleType)]:
        taken += vars(module).values()
    kernels = [_KERNELS[id(value)] for value in taken if id(value) in _KERNELS]
    file = function.__code__.co_filename
    parts += sorted({digest for kernel, digest in kernels if kernel.py_func.__code__.co_filename != file})
    for name in function.__code__.co_names:
        value = module_globals.get(name)
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
