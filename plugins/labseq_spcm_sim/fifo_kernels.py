"""How bytes flow through the card in FIFO mode, and the C functions that read and write its registers then.

In real time the driver calls these functions from a thread that never holds Python's lock, as it calls those
of the vendor's library. All that they need is in one array, int64 (N_WORDS,), some of whose words hold a
float64. What they do not model they pass on to the functions in Python.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import helper_kernel, kernel
from labseq.plugin.native import call_c, carray, now_ns, pointer, sleep_ns, swap

Words = NDArray[np.int64]
Bytes = NDArray[np.uint8]

STATUS, USER_LEN, CARD_LEN = 110, 200, 202
"""M2STATUS, DATA_AVAIL_USER_LEN and DATA_AVAIL_CARD_LEN, as in the vendor's header files."""
TRIGGERED, BLOCK_READY = 0x2, 0x100
"""M2STAT_CARD_TRIGGER and M2STAT_DATA_BLOCKREADY."""

(LOCK, READ, WRITE, IS_DIRECT, ADDRESS, N_BYTES, NOTIFY, FRAME, HANDED, DMA, FAILED, FINISHED) = range(12)
"""Lock of all words; addresses of the functions in Python, and whether the others answer themselves; address,
bytes and notify size of the ring, bytes of a frame and handed over, whether the bus fetches, how it ended."""
(RATE, ROOM, BUS, TOTAL, FETCHED, PLAYED, NOW, PLAY) = range(12, 20)
"""Of float64: samples and bytes per second of output and bus, bytes of room on the card and to play, bytes
fetched and played, the time of all that, and when the output starts."""
(OFFSET_NS, KEPT, N_KEPT, ENTRIES, N_ENTRIES, N_READ, HAS_LEFT_OUT, LATCHED) = range(20, 28)
"""From the timer's time to the session's; address and bytes of the memory for what was fetched, 0 for none,
address of the entries, their number so far and that of those read, whether one was left out, and the bytes
whose content is decided: the bus may read a whole block when it fetches the first byte of it."""
TIMER: Final = 28
N_WORDS: Final = TIMER + 10

MOST_ENTRIES: Final = 1 << 14
"""An entry: first byte in the stream, bytes, where they are kept, and how many: fewer if they repeat."""
RETRY_NS: Final = 5_000
SMALL: Final = 1e-3
"""Bytes that are a rounding error of time."""


@helper_kernel("void(int64[::1])")
def acquire(words: Words) -> None:
    """Wait for the lock."""
    while swap(words.ctypes.data, 1):
        pause = words[TIMER:].copy()  # the timer belongs to the owner of the lock
        sleep_ns(pause, RETRY_NS)


@helper_kernel("void(int64[::1])")
def release(words: Words) -> None:
    """Give the lock back."""
    swap(words.ctypes.data, 0)


@helper_kernel("int64(int64[::1])")
def free_bytes(words: Words) -> int:
    """Bytes that are free for the user, in whole notify sizes."""
    done = math.floor(words.view(np.float64)[FETCHED] + SMALL)
    notified = done - done % max(1, words[NOTIFY])
    return words[N_BYTES] - (words[HANDED] - notified)


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
        (real[TOTAL] - real[PLAYED], drain),
    ):
        if per_s > 0.0 and span / per_s < step_s:
            step_s, is_all = span / per_s, False
    real[NOW] = now_s if is_all else max(real[NOW] + step_s, np.nextafter(real[NOW], np.inf))
    real[FETCHED] = min(float(words[HANDED]), real[FETCHED] + speed * step_s)
    real[PLAYED] = min(real[FETCHED], real[PLAYED] + drain * step_s)
    words[FINISHED] = real[PLAYED] >= real[TOTAL] - SMALL


@helper_kernel("void(int64[::1], float64)")
def flow_until(words: Words, now_s: float) -> None:
    """The same up to a time."""
    real = words.view(np.float64)
    if real[NOW] == -np.inf:
        real[NOW] = now_s
    while real[NOW] < now_s and not words[FAILED] and not words[FINISHED]:
        flow(words, now_s)
    real[NOW] = max(real[NOW], now_s)


@kernel("int64(int64[::1])")
def user_bytes(words: Words) -> int:
    """Bytes that are free for the user, in whole notify sizes."""
    acquire(words)
    free = free_bytes(words)
    release(words)
    return free  # pyright: ignore[reportReturnType]


@helper_kernel("boolean(uint8[::1], int64, int64, int64)")
def repeats(ring: Bytes, first: int, n_bytes: int, block: int) -> bool:
    """Whether bytes of the ring, from ``first`` on and around its end, are one block over and over."""
    if block == 0 or n_bytes % block or first % block:
        return False
    pattern = ring[first : first + block].view(np.uint64)
    for at in range(block, n_bytes, block):
        start = (first + at) % len(ring)
        if not np.array_equal(ring[start : start + block].view(np.uint64), pattern):
            return False
    return True


@helper_kernel("boolean(uint8[::1])")
def is_silent(samples: Bytes) -> bool:
    """Whether all bytes are 0; without a way out in the middle it is several times faster."""
    found = np.uint8(0)
    for i in range(len(samples)):
        found |= samples[i]
    return found == 0


@helper_kernel("void(int64[::1], int64)")
def keep(words: Words, n_bytes: int) -> None:
    """Copy what is fetched next, for those who look at the outputs.

    Silence is left out; of equal blocks, as of tones that keep the AODs warm, only one is kept.
    """
    ring = carray(pointer(words[ADDRESS]), words[N_BYTES], np.uint8)
    first = words[LATCHED] % words[N_BYTES]
    head = min(n_bytes, words[N_BYTES] - first)
    if is_silent(ring[first : first + head]) and is_silent(ring[: n_bytes - head]):
        return
    entries = carray(pointer(words[ENTRIES]), (MOST_ENTRIES, 4), np.int64)
    kept = carray(pointer(words[KEPT]), words[N_KEPT], np.uint8)
    n, n_read, stored, at = words[N_ENTRIES], words[N_READ], n_bytes, 0
    if repeats(ring, first, n_bytes, words[NOTIFY]):
        stored = head = words[NOTIFY]
    if n > n_read:
        last = entries[(n - 1) % MOST_ENTRIES]
        at = last[2] + last[3]
        if stored < n_bytes and last[3] == stored and last[0] + last[1] == words[LATCHED]:
            before = kept[last[2] : at].view(np.uint64)
            if np.array_equal(before, ring[first : first + stored].view(np.uint64)):
                last[1] += n_bytes
                return
        if at + stored > words[N_KEPT]:
            at = 0
    oldest = entries[n_read % MOST_ENTRIES, 2]
    if n - n_read == MOST_ENTRIES or stored > words[N_KEPT] or (n > n_read and at <= oldest < at + stored):
        words[HAS_LEFT_OUT] = 1
        return
    kept[at : at + head] = ring[first : first + head]
    kept[at + head : at + stored] = ring[: stored - head]
    entry = entries[n % MOST_ENTRIES]
    entry[0], entry[1], entry[2], entry[3] = words[LATCHED], n_bytes, at, stored
    words[N_ENTRIES] = n + 1


@helper_kernel("int64(int64[::1])")
def begun_bytes(words: Words) -> int:
    """Bytes of the blocks that the bus has begun to fetch."""
    block = max(1, words[NOTIFY])
    begun = math.ceil((words.view(np.float64)[FETCHED] - SMALL) / block) * block
    return min(begun, words[HANDED])


@helper_kernel("void(int64[::1])")
def latch(words: Words) -> None:
    """Keep what the bus has fetched since the last time; what the user writes there now comes too late."""
    n_bytes = begun_bytes(words) - words[LATCHED]
    if n_bytes > 0:
        if words[KEPT]:
            keep(words, n_bytes)
        words[LATCHED] += n_bytes


@kernel("int64(int64[::1], float64)")
def advance(words: Words, now_s: float) -> int:
    """Let bytes flow up to a time; returns how many are fetched that Python has to keep."""
    acquire(words)
    flow_until(words, now_s)
    if words[KEPT]:
        latch(words)
    n_bytes = begun_bytes(words) - words[LATCHED]
    release(words)
    return n_bytes  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1], int64[::1], uint8[::1])")
def take(words: Words, entry: Words, data: Bytes) -> int:
    """Take the oldest entry, int64 (4,), and its bytes out.

    Returns:
        Bytes of ``data`` that were filled in; 0 if there is no entry, or if it is too short, and ``entry[3]``
        is what it needs.
    """
    entry[3] = 0
    if words[KEPT] == 0:
        return 0
    acquire(words)
    done = 0
    if words[N_READ] < words[N_ENTRIES]:
        entries = carray(pointer(words[ENTRIES]), (MOST_ENTRIES, 4), np.int64)
        kept = carray(pointer(words[KEPT]), words[N_KEPT], np.uint8)
        entry[:] = entries[words[N_READ] % MOST_ENTRIES]
        if entry[3] <= len(data):
            done = entry[3]
            data[:done] = kept[entry[2] : entry[2] + done]
            words[N_READ] += 1
    release(words)
    return done


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
    if words[IS_DIRECT] and register in (STATUS, USER_LEN):
        acquire(words)
        flow_until(words, session_s(words))
        latch(words)
        is_over, free = words[FAILED] + words[FINISHED], free_bytes(words)
        is_triggered = words.view(np.float64)[PLAY] < np.inf
        release(words)
        if not is_over and register == USER_LEN:
            carray(pointer(out), 1, np.int64)[0] = free
            return 0
        if not is_over and is_triggered:
            is_ready = free >= max(1, words[NOTIFY])
            carray(pointer(out), 1, np.int64)[0] = TRIGGERED + (BLOCK_READY if is_ready else 0)
            return 0
    return call_c(words[READ], handle, register, out)


@kernel("int64(int64, int64, int64)", for_c=True)
def write_register(handle: int, register: int, value: int) -> int:
    """spcm_dwSetParam_i64, likewise."""
    words = carray(pointer(carray(pointer(handle), 1, np.int64)[0]), N_WORDS, np.int64)
    if words[IS_DIRECT] and register == CARD_LEN:
        acquire(words)
        flow_until(words, session_s(words))
        latch(words)
        is_over, free = words[FAILED] + words[FINISHED], free_bytes(words)
        is_fine = not is_over and 0 <= value <= free and value % words[FRAME] == 0
        if is_fine:
            words[HANDED] += value
        release(words)
        if is_fine:
            return 0
    return call_c(words[WRITE], handle, register, value)
