"""A simulated card whose stream is answered by compiled code, so that a benchmark measures the driver alone.

The vendor's library needs no lock of Python; the simulator's functions in Python do. Here the registers of a
stream that plays are read and written by two compiled functions, which know how many bytes have flowed from
the time. All their state is in one array, int64 (N_WORDS,), some of whose words hold a float64. What they do
not model they pass on to the functions in Python.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm_sim import SimulatedLibrary, machine
from labseq_spcm_sim.library import _library
from labseq_spcm_sim.modes import Fifo
from numpy.typing import NDArray

from labseq.plugin import Clock, helper_kernel, kernel
from labseq.plugin.native import c_address, call_c, carray, new_timer, now_ns, pointer, sleep_ns, swap

Words = NDArray[np.int64]

STATUS, USER_LEN, CARD_LEN = 110, 200, 202
"""M2STATUS, DATA_AVAIL_USER_LEN and DATA_AVAIL_CARD_LEN, as in the vendor's header files."""
TRIGGERED, BLOCK_READY = 0x2, 0x100
"""M2STAT_CARD_TRIGGER and M2STAT_DATA_BLOCKREADY."""
(LOCK, READ, WRITE, N_BYTES, NOTIFY, FRAME, HANDED, DMA, FAILED, OFFSET_NS) = range(10)
"""Lock of all words, addresses of the functions in Python, bytes and notify size of the ring, bytes of a
frame and handed over, whether the bus fetches, whether it ran dry, from the timer's time to the session's."""
(RATE, ROOM, BUS, FETCHED, PLAYED, NOW, PLAY) = range(10, 17)
"""Of float64: samples and bytes per second of output and bus, bytes of room on the card, fetched and played,
the time of all that, and when the output starts."""
TIMER: Final = 17
N_WORDS: Final = TIMER + 10
SMALL: Final = 1e-3


@helper_kernel("void(int64[::1])")
def acquire(words: Words) -> None:
    """Wait for the lock."""
    while swap(words.ctypes.data, 1):
        pause = words[TIMER:].copy()  # the timer belongs to the owner of the lock
        sleep_ns(pause, 5_000)


@helper_kernel("void(int64[::1])")
def release(words: Words) -> None:
    """Give the lock back."""
    swap(words.ctypes.data, 0)


@helper_kernel("int64(int64[::1])")
def free_bytes(words: Words) -> int:
    """Bytes that are free for the user, in whole notify sizes."""
    done = math.floor(words.view(np.float64)[FETCHED] + SMALL)
    return words[N_BYTES] - (words[HANDED] - (done - done % max(1, words[NOTIFY])))


@helper_kernel("void(int64[::1], float64)")
def flow(words: Words, now_s: float) -> None:
    """Let bytes flow until something changes: the start, the end of the data, full, empty, or now."""
    real = words.view(np.float64)
    drain = real[RATE] * words[FRAME] if real[NOW] >= real[PLAY] else 0.0
    waiting, fill = words[HANDED] - real[FETCHED], real[FETCHED] - real[PLAYED]
    speed = 0.0
    if words[DMA] and waiting > SMALL:
        speed = real[BUS] if fill < real[ROOM] - SMALL else min(real[BUS], drain)
    if drain > speed and fill <= SMALL:
        words[FAILED] = 1
        return
    step_s = now_s - real[NOW]
    is_all = True
    for span, per_s in (
        (real[PLAY] - real[NOW], 1.0 if real[NOW] < real[PLAY] else 0.0),
        (waiting, speed),
        (real[ROOM] - fill, speed - drain),
        (fill, drain - speed),
    ):
        if per_s > 0.0 and span / per_s < step_s:
            step_s, is_all = span / per_s, False
    real[NOW] = now_s if is_all else max(real[NOW] + step_s, np.nextafter(real[NOW], np.inf))
    real[FETCHED] = min(float(words[HANDED]), real[FETCHED] + speed * step_s)
    real[PLAYED] = min(real[FETCHED], real[PLAYED] + drain * step_s)


@kernel("void(int64[::1], float64)")
def flow_until(words: Words, now_s: float) -> None:
    """The same up to a time."""
    acquire(words)
    real = words.view(np.float64)
    while real[NOW] < now_s and not words[FAILED]:
        flow(words, now_s)
    real[NOW] = max(real[NOW], now_s)
    release(words)


@helper_kernel("float64(int64[::1])")
def session_s(words: Words) -> float:
    """The session's time."""
    return 1e-9 * (now_ns(words[TIMER:]) + words[OFFSET_NS])


@kernel("int64(int64[::1])")
def timer_ns(words: Words) -> int:
    """The time of the words' timer."""
    return now_ns(words[TIMER:])  # pyright: ignore[reportReturnType]


@kernel("int64(int64, int64, int64)", for_c=True)
def read_register(handle: int, register: int, out: int) -> int:
    """spcm_dwGetParam_i64: the handle points to the address of the words."""
    words = carray(pointer(carray(pointer(handle), 1, np.int64)[0]), N_WORDS, np.int64)
    if register in (STATUS, USER_LEN) and words.view(np.float64)[PLAY] < np.inf:
        flow_until(words, session_s(words))
        if not words[FAILED]:
            free = free_bytes(words)
            is_ready = free >= max(1, words[NOTIFY])
            status = TRIGGERED + (BLOCK_READY if is_ready else 0)
            carray(pointer(out), 1, np.int64)[0] = free if register == USER_LEN else status
            return 0
    return call_c(words[READ], handle, register, out)


@kernel("int64(int64, int64, int64)", for_c=True)
def write_register(handle: int, register: int, value: int) -> int:
    """spcm_dwSetParam_i64, likewise."""
    words = carray(pointer(carray(pointer(handle), 1, np.int64)[0]), N_WORDS, np.int64)
    if register == CARD_LEN and words.view(np.float64)[PLAY] < np.inf:
        flow_until(words, session_s(words))
        acquire(words)
        is_fine = not words[FAILED] and 0 <= value <= free_bytes(words) and value % words[FRAME] == 0
        if is_fine:
            words[HANDED] += value
        release(words)
        if is_fine:
            return 0
    return call_c(words[WRITE], handle, register, value)


def word(index: int) -> property:
    """A number of a stream that is kept in one of the words."""
    return property(
        lambda self: int(self.words[index]), lambda self, value: self.words.__setitem__(index, value)
    )


def real_word(index: int) -> property:
    """The same for a float64."""
    return property(
        lambda self: float(self.words.view(np.float64)[index]),
        lambda self, value: self.words.view(np.float64).__setitem__(index, value),
    )


class NativeFifo(Fifo):
    """A stream whose state is in the words of :func:`read_register`; nothing of what it plays is kept."""

    words: NDArray[np.int64] = np.zeros(N_WORDS, np.int64)

    handed, is_transferring, failed = word(HANDED), word(DMA), word(FAILED)  # type: ignore[assignment]
    fetched, n_played = real_word(FETCHED), real_word(PLAYED)  # type: ignore[assignment]
    play_s = real_word(PLAY)  # type: ignore[assignment]
    _room, _now_s = real_word(ROOM), real_word(NOW)  # type: ignore[assignment]

    def __init__(self, *arguments: Any, keeps: bool) -> None:
        super().__init__(*arguments, keeps=keeps)
        self.words[[N_BYTES, NOTIFY, FRAME]] = self._buffer.n_bytes, self._buffer.notify_bytes, self._frame
        self.words.view(np.float64)[[RATE, BUS]] = self._rate, self._bus

    def advance(self, now_s: float) -> None:
        """Let bytes flow up to now."""
        if self._now_s == -math.inf:
            self._now_s = now_s
        flow_until(self.words, now_s)
        self._reported.add(now_s, self.fetched)


class NativeLibrary(SimulatedLibrary):
    """The library of an installed card; a stream's registers are read and written by compiled code."""

    def __init__(self, name: str, clock: Clock) -> None:
        super().__init__(name, clock, None, 0)
        self._time = clock

    def functions(self) -> tuple[int, int]:
        """Addresses of the two functions, once the handles of open cards point to the words."""
        words = NativeFifo.words
        words[READ], words[WRITE] = super().functions()
        words[TIMER:] = new_timer(words[TIMER:])
        tries = [(1e9 * self._time.now(), timer_ns(words)) for _ in range(10)]
        words[OFFSET_NS] = max(int(clock_ns) - ns for clock_ns, ns in tries)
        for handle in _library()._open:
            ctypes.c_int64.from_address(handle).value = words.ctypes.data
        return c_address(read_register), c_address(write_register)


@contextmanager
def native_stream(tweezers: SpcmMobileTweezers, name: str, clock: Clock) -> Generator[None]:
    """Within the block, streams of this driver's simulated card are answered by compiled code."""
    tweezers.library = NativeLibrary(name, clock)
    original, machine.Fifo = machine.Fifo, NativeFifo
    try:
        yield
    finally:
        machine.Fifo = original
