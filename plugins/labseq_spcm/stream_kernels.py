"""The loop that keeps a running card supplied, compiled: it needs Python's lock at no time.

It reads what the card has fetched, hands silence over while no program plays, and renders programs into the
ring. The driver library's functions are called by their addresses. Python and the loop share one array,
int64 (N_WORDS,), whose words one of the two writes and the other reads.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import call_c, carray, helper_kernel, kernel, now_ns, pointer, sleep_ns, swap
from labseq_spcm.kernels import interleave
from labseq_spcm.limits import FRAME_BYTES

Words = NDArray[np.int64]

COMMAND, STATUS, USER_LEN, CARD_LEN = 100, 110, 200, 202
"""M2CMD, M2STATUS, DATA_AVAIL_USER_LEN and DATA_AVAIL_CARD_LEN, as in the vendor's header files."""
READY: Final = 0x4
"""M2STAT_CARD_READY: it does not run."""

(GET, SET, HANDLE, RENDER, RING, N_RING, BLOCK, ON_CARD, AHEAD, SILENCE, SCRATCH, VALUE) = range(12)
"""Set before the loop: the library's functions and the card's handle, :func:`labseq.plugin.render_address`,
address and samples of the ring, samples of a block, on the card and ahead of it in silence; addresses of a
block of silence, of room for 2 x CHUNK samples, and of the next word but one."""
FOUND: Final = 12
STOP, QUEUED, QUEUE = 13, 14, 15
"""Written by Python: end the loop, the number of programs so far, and the addresses of the last N_QUEUE."""
N_QUEUE: Final = 4
(TAKEN, WRITTEN, FETCHED, START, END, SILENT_FROM, ERROR, IS_FEEDING) = range(19, 27)
"""Written by the loop: programs begun, samples handed over and fetched, where the last program starts and
ends, from where on the ring holds silence again, error code of the library, and whether the loop runs."""
(HAS_HELPER, POSTED, DONE, HELP_AXIS, HELP_START, HELP_OUT) = range(27, 33)
"""Whether :func:`assist` runs in another thread; a part of the column axis that waits to be rendered and one
that was, and which: the arguments of RENDER."""
(IS_FILLING, TO_START, START_COMMAND, N_QUICK) = range(33, 37)
"""Whether the card is filled before its start, the samples that it must have fetched then, the M2CMD, and how
many looks are still to follow one another quickly."""
N_WORDS: Final = 37

LENGTH, ROW_CHANNEL, READY_MADE, N_READY, AXES, N_AXIS, BEGAN = range(7)
"""Words of a program: samples in whole blocks, output of the row axis, address and number of the samples that
were rendered beforehand, address of :meth:`labseq.plugin.Renderer.words`, and words of an axis. The loop
writes where in the stream it begins."""
N_PROGRAM: Final = 7

CHUNK: Final = 1 << 15
"""Samples rendered at a time, few enough to stay in the processor's cache until they are interleaved."""
MOST_SAMPLES: Final = 1 << 17
"""Samples handed over at a time, 0.2 ms at 625 MS/s, if there is room: the loop looks for STOP after them."""
FILLING_POLL_NS: Final = 20_000
"""Time between two looks at a card that is filled before its start, and until its own FIFO is full."""
QUICK_LOOKS: Final = 100
"""After the start the bus fills the card's FIFO; at a tenth more than what is played that takes 1 ms."""
POLL_NS: Final = 1_000_000
"""Longest time between two looks at the ring while a program plays."""
SPIN_NS: Final = 50_000
"""How long the helping thread waits for the next part without sleeping."""
HELP_POLL_NS: Final = 100_000
"""Time between two looks for a part after that."""

STOPPED, DRY, FAILED = -1, -2, -3
"""The driver asked for the end; the card has stopped; the library reports an error."""


@helper_kernel("int64(int64[::1], int64)")
def read(box: Words, register: int) -> int:
    """A register of the card; FAILED if the library reports an error."""
    box[ERROR] = call_c(box[GET], box[HANDLE], register, box[VALUE])
    return FAILED if box[ERROR] else box[FOUND]  # pyright: ignore[reportReturnType]


@helper_kernel("int64(int64[::1], int64)")
def hand_over(box: Words, n_samples: int) -> int:
    """Let the card fetch samples that are in the ring; returns 0 or FAILED."""
    box[ERROR] = call_c(box[SET], box[HANDLE], CARD_LEN, n_samples * FRAME_BYTES)
    if box[ERROR]:
        return FAILED
    box[WRITTEN] += n_samples
    return 0


@helper_kernel("void(int64, int64, int64)")
def copy(source: int, out: int, n_samples: int) -> None:
    """Copy frames from one address to another."""
    frames, copied = carray(pointer(source), n_samples, np.uint32), carray(pointer(out), n_samples, np.uint32)
    for i in range(len(copied)):
        copied[i] = frames[i]


@kernel("void(int64[::1], int64[::1], int64, int64, int64)")
def render_frames(box: Words, program: Words, start: int, out: int, n_samples: int) -> None:
    """Render samples of a program as the card stores them; after its end there is silence.

    Of ``box`` it needs RENDER and SCRATCH only, so that it can be called while the loop hands silence over.
    """
    for done in range(0, n_samples, CHUNK):
        n = min(CHUNK, n_samples - done)
        rows, columns = program[AXES], program[AXES] + 8 * program[N_AXIS]
        carray(pointer(rows), 1, np.int64)[0] = carray(pointer(columns), 1, np.int64)[0] = n
        box[HELP_AXIS], box[HELP_START] = columns, start + done
        box[HELP_OUT] = box[SCRATCH] + 2 * CHUNK * (1 - program[ROW_CHANNEL])
        is_shared = box[HAS_HELPER]
        swap(box[POSTED:].ctypes.data, is_shared)
        call_c(box[RENDER], rows, start + done, box[SCRATCH] + 2 * CHUNK * program[ROW_CHANNEL])
        if not is_shared or swap(box[POSTED:].ctypes.data, 0):  # the helper sleeps
            call_c(box[RENDER], columns, start + done, box[HELP_OUT])
        else:
            while swap(box[DONE:].ctypes.data, 0) == 0:
                pass
        first = carray(pointer(box[SCRATCH]), n, np.uint16)
        second = carray(pointer(box[SCRATCH] + 2 * CHUNK), n, np.uint16)
        interleave(first, second, carray(pointer(out + FRAME_BYTES * done), n, np.uint32))


@kernel("void(int64[::1], int64[::1])")
def assist(box: Words, timer: Words) -> None:
    """Render the column axis of each part while :func:`feed` renders the row axis, until STOP is set."""
    last_ns = now_ns(timer)
    while box[STOP] == 0:
        if box[POSTED] and swap(box[POSTED:].ctypes.data, 0):
            call_c(box[RENDER], box[HELP_AXIS], box[HELP_START], box[HELP_OUT])
            swap(box[DONE:].ctypes.data, 1)
            last_ns = now_ns(timer)
        elif now_ns(timer) - last_ns > SPIN_NS:
            sleep_ns(timer, HELP_POLL_NS)


@helper_kernel("int64(int64[::1], int64)")
def supply_program(box: Words, room: int) -> int:
    """Copy or render the next part of a program into the ring; returns 0 or FAILED.

    A part is at most a quarter of what is ahead of the outputs, so that it is there long before its time.
    """
    place = box[QUEUE + (box[TAKEN] - 1) % N_QUEUE]
    program = carray(pointer(place), N_PROGRAM, np.int64)
    done, at = box[WRITTEN] - box[START], box[WRITTEN] % box[N_RING]
    ahead = (box[N_RING] - room + box[ON_CARD]) // (4 * box[BLOCK]) * box[BLOCK]
    n = min(room, box[END] - box[WRITTEN], box[N_RING] - at, max(box[BLOCK], min(MOST_SAMPLES, ahead)))
    out = box[RING] + FRAME_BYTES * at
    if done < program[N_READY]:
        n = min(n, program[N_READY] - done)
        copy(program[READY_MADE] + FRAME_BYTES * done, out, n)
    else:
        render_frames(box, program, done, out, n)
    box[SILENT_FROM] = box[END] + box[N_RING]
    return hand_over(box, n)  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1], int64)")
def supply_silence(box: Words, n_samples: int) -> int:
    """Hand over blocks of silence, at most so many samples; returns 0 or FAILED."""
    n = min(box[N_RING], n_samples // box[BLOCK] * box[BLOCK])
    if n <= 0:
        return 0
    if box[WRITTEN] < box[SILENT_FROM]:
        for done in range(0, n, box[BLOCK]):
            at = (box[WRITTEN] + done) % box[N_RING]
            copy(box[SILENCE], box[RING] + FRAME_BYTES * at, box[BLOCK])
    return hand_over(box, n)  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1])")
def look(box: Words) -> int:
    """Read how much of the ring the card has fetched.

    Returns:
        Samples that are still in the ring; or DRY or FAILED.
    """
    free = read(box, USER_LEN)
    if free < 0:
        return FAILED
    in_ring = box[N_RING] - free // FRAME_BYTES
    fetched, before = box[WRITTEN] - in_ring, box[FETCHED]
    box[FETCHED] = fetched
    if in_ring and fetched != before:
        return in_ring  # pyright: ignore[reportReturnType]
    status = read(box, STATUS)
    if status < 0:
        return FAILED
    return DRY if status & READY else in_ring  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1], int64)")
def supply(box: Words, rate_hz: int) -> int:
    """One step: hand over what there is room for; returns after how many ns that is due again, or a code."""
    in_ring = look(box)
    if box[IS_FILLING] and in_ring != FAILED:
        if box[FETCHED] < box[TO_START]:
            return FILLING_POLL_NS
        box[IS_FILLING], box[N_QUICK] = 0, QUICK_LOOKS
        box[ERROR] = call_c(box[SET], box[HANDLE], COMMAND, box[START_COMMAND])
        return FAILED if box[ERROR] else 0
    if in_ring < 0:
        return in_ring
    if box[WRITTEN] >= box[END] and box[TAKEN] < box[QUEUED]:
        if in_ring < box[AHEAD] // 2 and box[WRITTEN] >= box[END] + box[ON_CARD]:  # it came late in silence
            if supply_silence(box, box[AHEAD] - in_ring):
                return FAILED
            in_ring = max(in_ring, box[AHEAD])
        program = carray(pointer(box[QUEUE + box[TAKEN] % N_QUEUE]), N_PROGRAM, np.int64)
        program[BEGAN] = box[WRITTEN]
        box[START], box[END] = box[WRITTEN], box[WRITTEN] + program[LENGTH]
        box[TAKEN] += 1
    if box[WRITTEN] < box[END]:
        room = box[N_RING] - in_ring
        if room:
            return supply_program(box, room)
        return min(POLL_NS, box[N_RING] * 125_000_000 // rate_hz)  # an eighth of the ring
    failed = supply_silence(box, box[AHEAD] - in_ring)
    if box[N_QUICK]:
        box[N_QUICK] -= 1
        return failed or FILLING_POLL_NS
    return failed or box[AHEAD] * 500_000_000 // rate_hz  # half of it


@kernel("int64(int64[::1], int64, int64[::1])")
def feed(box: Words, rate_hz: int, timer: Words) -> int:
    """Supply the card until STOP is set, in a thread of its own; returns STOPPED, DRY or FAILED."""
    box[IS_FEEDING] = 1
    code = STOPPED
    while box[STOP] == 0:
        code = supply(box, rate_hz)
        if code < 0:
            break
        if code > 0:
            sleep_ns(timer, code)
        code = STOPPED
    box[IS_FEEDING] = 0
    return code
