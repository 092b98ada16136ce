"""Lets kernels call functions in C, read memory by its address, and keep time, without Python's lock.

A kernel that runs in its own thread during a whole run cannot be given new arguments, so it finds changing
values at addresses. Addresses and handles are int64 throughout.
"""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import sys
import time
import weakref
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import helper_kernel, kernel, with_numba

Ints = NDArray[np.int64]


_FUNCTION: Final = ctypes.CFUNCTYPE(ctypes.c_uint32, *[ctypes.c_int64] * 3)


def call_c(address: Any, a: Any, b: Any, c: Any) -> Any:
    """Call a C function with up to three integers or pointers, and return its uint32.

    Extra arguments are ignored, as in the calling conventions of all 64-bit systems.
    """
    return int(_FUNCTION(int(address))(int(a), int(b), int(c)))


def pointer(address: Any) -> Any:
    """An address for :func:`carray`."""
    return address


def carray(pointer: Any, shape: Any, dtype: Any) -> Any:
    """The array at an address, by ``carray(pointer(address), shape, dtype)``."""
    n_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory: Any = (ctypes.c_char * n_bytes).from_address(int(pointer))
    return np.frombuffer(memory, dtype).reshape(shape)


def swap(address: Any, value: Any) -> Any:
    """Set an int64 and return its old value, in one step for all threads."""
    word = ctypes.c_int64.from_address(int(address))
    before, word.value = word.value, value
    return before


with_numba(lambda: importlib.import_module("labseq.kernels.native_code"))

N_TIMER: Final = 10
_CLOCK, _FIRST, _SECOND, _SCALE, _PER, _SLEEP, _SECONDS, _TICKS, _PAUSE = range(9)


def new_timer(timer: Ints | None = None) -> Ints:
    """int64 (N_TIMER,), new or given, for :func:`now_ns` and :func:`sleep_ns`, by one thread at a time.

    The time has the zero and rate of ``time.perf_counter``.
    """
    timer = np.zeros(N_TIMER, np.int64) if timer is None else timer
    address = timer.ctypes.data + 8 * _SECONDS
    if sys.platform == "win32":
        frequency, library = ctypes.c_int64(), ctypes.windll.kernel32
        library.QueryPerformanceFrequency(ctypes.byref(frequency))
        clock, sleep = library.QueryPerformanceCounter, library.SwitchToThread
        shared = math.gcd(10**9, frequency.value)
        timer[_FIRST] = address
        timer[_SCALE], timer[_PER] = 10**9 // shared, frequency.value // shared
    else:
        library = ctypes.CDLL(None)
        clock, sleep = library.clock_gettime, library.nanosleep
        timer[_FIRST], timer[_SECOND], timer[_SCALE], timer[_PER] = time.CLOCK_MONOTONIC, address, 10**9, 1
    for at, function in ((_CLOCK, clock), (_SLEEP, sleep)):
        timer[at] = ctypes.cast(function, ctypes.c_void_p).value or 0
    return timer


@helper_kernel("int64(int64[::1])")
def now_ns(timer: Ints) -> int:
    """The time in nanoseconds."""
    call_c(timer[_CLOCK], timer[_FIRST], timer[_SECOND], 0)
    return timer[_SECONDS] * timer[_SCALE] // timer[_PER] + timer[_TICKS]  # pyright: ignore[reportReturnType]


@helper_kernel("void(int64[::1], int64)")
def sleep_ns(timer: Ints, duration_ns: int) -> None:
    """Wait less than a second. On Windows it returns as soon as other threads had their turn."""
    timer[_PAUSE], timer[_PAUSE + 1] = 0, duration_ns
    call_c(timer[_SLEEP], timer[_PAUSE:].ctypes.data, 0, 0)


_WAIT, _TAKE, _GIVE, _HANDLE, _SETS, _ROOM, _ENTRY, _BYTES = range(8)
N_SIGNAL: Final = _BYTES + 1
POLLIN: Final = 1


class WakeSignal:
    """Signal that one thread sets and a kernel in another waits for. It may be set before the wait starts.

    Attributes:
        words: Argument of :func:`wait_signal` and :func:`set_signal`.
    """

    def __init__(self) -> None:
        self.words = words = np.zeros(N_SIGNAL, np.int64)
        if sys.platform == "win32":
            library = ctypes.windll.kernel32
            library.CreateEventW.restype = ctypes.c_void_p
            event = library.CreateEventW(None, False, False, None)
            words[_HANDLE] = words[_SETS] = event
            functions = (_WAIT, library.WaitForSingleObject), (_GIVE, library.SetEvent)
            weakref.finalize(self, library.CloseHandle, ctypes.c_void_p(event))
        else:
            library = ctypes.CDLL(None)
            reads, writes = os.pipe()
            for end in (reads, writes):
                os.set_blocking(end, False)
                weakref.finalize(self, os.close, end)
            words[_HANDLE], words[_SETS] = reads, writes
            functions = (_WAIT, library.poll), (_TAKE, library.read), (_GIVE, library.write)
            words[_ENTRY:].view(np.int32)[0] = reads
            words[_ENTRY:].view(np.int16)[2] = POLLIN
        for at, function in functions:
            words[at] = ctypes.cast(function, ctypes.c_void_p).value or 0


@kernel("void(int64[::1])")
def set_signal(words: Ints) -> None:
    """Wake the waiting thread, or the next thread that waits. Nothing happens if it is set very often."""
    call_c(words[_GIVE], words[_SETS], words[_BYTES:].ctypes.data, 1)


@helper_kernel("void(int64[::1], int64)")
def wait_signal(words: Ints, most_ms: int) -> None:
    """Wait until a signal is set, at most ``most_ms``. One thread at a time may use its words."""
    if words[_TAKE] == 0:
        call_c(words[_WAIT], words[_HANDLE], most_ms, 0)
    elif call_c(words[_WAIT], words[_ENTRY:].ctypes.data, 1, most_ms) == 1:
        call_c(words[_TAKE], words[_HANDLE], words[_ROOM:].ctypes.data, 8)
