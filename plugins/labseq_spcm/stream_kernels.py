"""The compiled loop that keeps a running card supplied without ever taking Python's lock.

The whole ring is handed over to the card at all times, silence where no program plays. A program is written
over the silence that the card is about to fetch, piece by piece. Between two pieces no tone is on. A piece
begins when all of it is rendered, or when so much is ahead of the card that it surely will be in time. The
driver library's functions are called by their addresses. Python and the loop share one array, int64
(N_WORDS,), whose words one of the two writes and the other reads.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.native import (
    N_SIGNAL,
    N_TIMER,
    call_c,
    carray,
    now_ns,
    pointer,
    set_signal,
    sleep_ns,
    swap,
    wait_signal,
)
from labseq_spcm.kernels import give, interleave, take
from labseq_spcm.limits import FRAME_BYTES

Words = NDArray[np.int64]
Shorts = NDArray[np.int32]
Reals = NDArray[np.float64]

TONES: Final = f"{const('int32', 1)}, {const('float64', 1)}, {const('float64', 1)}"

COMMAND, STATUS, USER_LEN, CARD_LEN = 100, 110, 200, 202
"""M2CMD, M2STATUS, DATA_AVAIL_USER_LEN and DATA_AVAIL_CARD_LEN, as in the vendor's header files."""
ENDED: Final = 0x4 | 0x400
"""M2STAT_CARD_READY (it does not run) or M2STAT_DATA_OVERRUN (it ran dry, and need not be ready)."""

(GET, SET, HANDLE, RENDER, RING, N_RING, BLOCK, ON_CARD, AHEAD, SILENCE, SCRATCH, VALUE) = range(12)
"""Set before the loop: the library's functions and the card's handle, :func:`render_address`, address and
samples of the ring, samples of a block, on the card, and from the fetched samples to where a program may
begin. Then the addresses of a block of silence, of room for 2 x CHUNK samples, and of the next word but
one."""
FOUND: Final = 12
STOP, QUEUED, QUEUE = 13, 14, 15
"""Written by Python: whether to end the loop, number of programs, addresses of the last N_QUEUE."""
N_QUEUE: Final = 4
PREPARED: Final = 19
"""Written by Python, the address of the program that will be queued next, 0 if there is none."""
(TAKEN, WRITTEN, FETCHED, START, END, MADE, UNTIL, PART, LEAST, N_PAUSES, SILENT_FROM, ERROR) = range(20, 32)
"""Written by the loop: programs begun, samples handed over and fetched, where the last program starts and
ends, up to where it is in the ring, how many samples of it may be written, from where on the last part of it
has just been written (-1 for none), the least distance of such a part from what the card may have fetched by
then, how many pieces came later than planned, from where on the ring holds silence again, and the library's
error code."""
(IS_FEEDING, RENDERED_AT, SLOW) = range(32, 35)
"""Also by the loop, whether it runs, the samples fetched when a block was last rendered whose place was not
known, and how much the card fetched meanwhile."""
(HELPER, POSTED, DONE, HELP_AXIS, HELP_START, HELP_OUT) = range(35, 41)
"""Address of the signal for :func:`assist` in another thread, 0 if there is none. Then a part of the column
axis that waits to be rendered, a rendered part, and the arguments of RENDER."""
(LOCK, TIMER) = range(46, 48)
"""Addresses of the lock of the library's calls, 0 where a call itself calls the loop, and of its timer."""
(IS_FILLING, TO_START, START_COMMAND, NOW_NS, FILLED_BY_NS) = range(41, 46)
"""Whether the card is filled before its start, the samples that it must have fetched then, the M2CMD, the
time of this step, and when the filling must be over."""
(STARTED_NS, SHIFT, WINDOW_NS, LEAST_LAG, USUAL_LAG, BY_CLOCK) = range(48, 54)
"""When the card was started, what else :func:`follow_clock` remembers, and its result."""
N_WORDS: Final = 54

LENGTH, ROW_CHANNEL, CUTS, N_CUTS, READY_MADE, ROOM, AXES, N_AXIS, BASE, N_READY, BEGAN = range(11)
"""Words of a program: samples in whole blocks, output of the row axis, address and number of the samples
where pieces end, address of and room for samples that are rendered before their place in the stream is known,
address of :meth:`Renderer.words`, and words of an axis. The loop writes the first of those
samples, their number, and where in the stream the program begins."""
N_PROGRAM: Final = 11

FOLLOWED_NS: Final = 100_000_000
"""Time over which the least lag shows the drift of the clocks against each other."""
DRIFT: Final = 20e-6
"""How much slower the card's clock may be than the computer's. The manual gives 5 ppm for the card's."""
UNKNOWN: Final = 1 << 62
FILLED_NS: Final = 2_000_000
"""Time after the start when the card's buffers are full. Before, it holds less than the clock says."""
SURE: Final = 4
"""A piece is surely in time if so many times its length is ahead."""
CHUNK: Final = 1 << 15
"""Samples rendered at a time, few enough to stay in the processor's cache until they are interleaved."""
MOST_SAMPLES: Final = 1 << 17
"""Samples written at a time, 0.2 ms at 625 MS/s, if there is room. The loop looks for STOP after them."""
FILLING_POLL_NS: Final = 20_000
"""Time between two looks at a card that is filled before its start."""
FILLING_NS: Final = 1_000_000_000
"""How long that may take."""
POLL_NS: Final = 1_000_000
"""Longest time between two looks at the ring while a program plays."""
SPIN_NS: Final = 50_000
"""How long the helping thread waits for the next part without sleeping."""
HELP_POLL_NS: Final = 100_000
"""Time between two looks for a part, or for a program, where a signal would not come in time."""
WAIT_MS: Final = 100
"""Longest wait for a signal."""

STOPPED, DRY, FAILED, LATE, STUCK = -1, -2, -3, -4, -5
"""The driver asked for the end, the card has stopped, the library reports an error, the card may have fetched
samples before they were written, or it did not fetch enough samples to be started."""


@kernel(f"int64({const('int64', 1)}, {TONES}, {TONES}, int64[::1])")
def find_cuts(
    first_sample: Words,
    row_offsets: Shorts, row_start: Reals, row_end: Reals,
    column_offsets: Shorts, column_start: Reals, column_end: Reals,
    cuts: Words,
) -> int:  # fmt: skip
    """Find the joints between segments at which no tone is on, and return their number.

    The amplitudes belong to the program's axes. ``cuts`` are the first samples after these joints.
    """
    n = 0
    for i in range(1, len(first_sample) - 1):
        is_on = False
        for at in range(row_offsets[i - 1], row_offsets[i]):
            is_on |= row_end[at] > 0.0
        for at in range(row_offsets[i], row_offsets[i + 1]):
            is_on |= row_start[at] > 0.0
        for at in range(column_offsets[i - 1], column_offsets[i]):
            is_on |= column_end[at] > 0.0
        for at in range(column_offsets[i], column_offsets[i + 1]):
            is_on |= column_start[at] > 0.0
        if not is_on:
            cuts[n] = first_sample[i]
            n += 1
    return n


@helper_kernel("int64(int64[::1], int64, int64, int64)")
def call_library(box: Words, function: int, register: int, value: int) -> int:
    """Call one of the library's functions while no other thread does, and return its error code."""
    if box[LOCK]:
        take(box[LOCK], carray(pointer(box[TIMER]), N_TIMER, np.int64))
    box[ERROR] = call_c(function, box[HANDLE], register, value)
    if box[LOCK]:
        give(box[LOCK])
    return box[ERROR]  # pyright: ignore[reportReturnType]


@helper_kernel("int64(int64[::1], int64)")
def read(box: Words, register: int) -> int:
    """A register of the card, FAILED if the library reports an error."""
    call_library(box, box[GET], register, box[VALUE])
    return FAILED if box[ERROR] else box[FOUND]  # pyright: ignore[reportReturnType]


@helper_kernel("int64(int64[::1], int64)")
def hand_over(box: Words, n_samples: int) -> int:
    """Let the card fetch samples that are in the ring. Returns 0 or FAILED."""
    if call_library(box, box[SET], CARD_LEN, n_samples * FRAME_BYTES):
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
    """Render samples of a program as the card stores them, with silence after its end.

    It uses only RENDER and SCRATCH of ``box``, so that it can be called while the loop hands silence over.
    """
    for done in range(0, n_samples, CHUNK):
        n = min(CHUNK, n_samples - done)
        rows, columns = program[AXES], program[AXES] + 8 * program[N_AXIS]
        carray(pointer(rows), 1, np.int64)[0] = carray(pointer(columns), 1, np.int64)[0] = n
        box[HELP_AXIS], box[HELP_START] = columns, start + done
        box[HELP_OUT] = box[SCRATCH] + 2 * CHUNK * (1 - program[ROW_CHANNEL])
        is_shared = box[HELPER] != 0
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


@kernel("void(int64[::1], int64[::1], int64[::1])")
def assist(box: Words, timer: Words, signal: Words) -> None:
    """Render the column axis of each part while :func:`feed` renders the row axis, until STOP is set."""
    last_ns = now_ns(timer)
    while box[STOP] == 0:
        if box[POSTED] and swap(box[POSTED:].ctypes.data, 0):
            call_c(box[RENDER], box[HELP_AXIS], box[HELP_START], box[HELP_OUT])
            swap(box[DONE:].ctypes.data, 1)
            last_ns = now_ns(timer)
        elif now_ns(timer) - last_ns > SPIN_NS:
            if box[MADE] < box[END]:
                sleep_ns(timer, HELP_POLL_NS)
            else:
                wait_signal(signal, WAIT_MS)
                last_ns = now_ns(timer)


@helper_kernel("int64(int64[::1], int64)")
def supply_program(box: Words, room: int) -> int:
    """Copy or render the next part of a piece into the ring. Returns 0 or FAILED.

    A part is at most a quarter of the samples ahead of the card, so that it is there long before its time.
    Only whole blocks are handed over.
    """
    place = box[QUEUE + (box[TAKEN] - 1) % N_QUEUE]
    program = carray(pointer(place), N_PROGRAM, np.int64)
    done, at, block = box[MADE] - box[START], box[MADE] % box[N_RING], box[BLOCK]
    most = max(block, min(MOST_SAMPLES, (box[MADE] - box[FETCHED]) // 4))
    n = min(room, box[UNTIL] - done, box[N_RING] - at, most)
    out, ready = box[RING] + FRAME_BYTES * at, program[BASE] + program[N_READY] - done
    if ready > 0:
        n = min(n, ready)
        copy(program[READY_MADE] + FRAME_BYTES * (done - program[BASE]), out, n)
    else:
        render_frames(box, program, done, out, n)
    box[PART] = box[MADE]
    box[MADE] += n
    box[SILENT_FROM] = box[MADE] + box[N_RING]
    more = (box[MADE] - box[WRITTEN]) // block * block
    return hand_over(box, more) if more > 0 else 0  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1], int64)")
def supply_silence(box: Words, n_samples: int) -> int:
    """Hand over blocks of silence, at most ``n_samples``. Returns 0 or FAILED."""
    block = box[BLOCK]
    n = min(box[N_RING], n_samples // block * block)
    if n <= 0:
        return 0
    if box[WRITTEN] < box[SILENT_FROM]:
        for done in range(0, n, block):
            at = (box[WRITTEN] + done) % box[N_RING]
            skip = min(block, max(0, box[MADE] - box[WRITTEN] - done))  # the end of a piece
            copy(box[SILENCE] + FRAME_BYTES * skip, box[RING] + FRAME_BYTES * (at + skip), block - skip)
    return hand_over(box, n)  # pyright: ignore[reportReturnType]


@kernel("int64(int64[::1])")
def look(box: Words) -> int:
    """Read how much of the ring the card has fetched.

    Returns:
        Samples that are still in the ring, or DRY or FAILED.
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
    return DRY if status & ENDED else in_ring  # pyright: ignore[reportReturnType]


@helper_kernel("boolean(int64[::1], int64[::1], int64)")
def render_ahead(box: Words, program: Words, until: int) -> bool:
    """Render more samples whose place is not known yet, up to ``until``. Returns whether it did."""
    done = program[BASE] + program[N_READY]
    n = min(box[BLOCK], min(until, program[BASE] + program[ROOM]) - done)
    if n <= 0:
        return False
    render_frames(box, program, done, program[READY_MADE] + FRAME_BYTES * program[N_READY], n)
    program[N_READY] += n
    box[RENDERED_AT] = box[FETCHED]
    return True


@helper_kernel("void(int64[::1], int64)")
def follow_clock(box: Words, rate_hz: int) -> None:
    """Work out BY_CLOCK, the most samples that the card can have fetched by the clock, in whole blocks.

    It plays since its start and holds no more than its buffers do. The report lags behind that by a part of a
    block, and by the time of an interrupt. The change of the lag from one tenth of a second to the next is
    the drift of the clocks. A card that gains is followed at once. A card that loses is followed only as fast
    as clocks may differ, because its reports may also have become later.
    """
    played = 1e-9 * (box[NOW_NS] - box[STARTED_NS]) * rate_hz
    lag = int(played) + box[ON_CARD] + box[SHIFT] - box[FETCHED]
    box[LEAST_LAG] = min(box[LEAST_LAG], lag)
    if box[NOW_NS] >= box[WINDOW_NS]:
        if box[USUAL_LAG] == UNKNOWN:
            box[USUAL_LAG] = box[LEAST_LAG]
        slower = int(DRIFT * 1e-9 * (box[NOW_NS] - box[WINDOW_NS] + FOLLOWED_NS) * rate_hz)
        shift = min(box[LEAST_LAG] - box[USUAL_LAG], slower)
        box[SHIFT] -= shift
        lag -= shift
        box[LEAST_LAG], box[WINDOW_NS] = UNKNOWN, box[NOW_NS] + FOLLOWED_NS
    box[BY_CLOCK] = -(-(box[FETCHED] + lag) // box[BLOCK]) * box[BLOCK]


@helper_kernel("int64(int64[::1])")
def earliest(box: Words) -> int:
    """Where a program may begin at the earliest."""
    start = box[FETCHED] + box[AHEAD]
    if box[NOW_NS] - box[STARTED_NS] < FILLED_NS:
        start = max(start, box[BY_CLOCK] + box[BLOCK])
    return start  # pyright: ignore[reportReturnType]


@helper_kernel("void(int64[::1])")
def take_program(box: Words) -> None:
    """Make the next program the present one. It begins where the last one ends, or as soon as it can."""
    program = carray(pointer(box[QUEUE + box[TAKEN] % N_QUEUE]), N_PROGRAM, np.int64)
    start = max(box[END], earliest(box))
    box[END] = start + program[LENGTH]
    box[START] = box[MADE] = start
    box[PREPARED] = box[UNTIL] = 0
    swap(box[TAKEN:].ctypes.data, box[TAKEN] + 1)  # Python sees the rest before this
    if box[HELPER]:
        set_signal(carray(pointer(box[HELPER]), N_SIGNAL, np.int64))


@helper_kernel("int64(int64[::1])")
def begin_piece(box: Words) -> int:
    """Render the next piece, as far as there is room for it, then let it begin. Returns 0 or FAILED.

    If much is ahead of the card it begins at once. If its time has passed, silence is longer, and all that
    follows comes later. A computer that has just been slow is given more time.
    """
    program = carray(pointer(box[QUEUE + (box[TAKEN] - 1) % N_QUEUE]), N_PROGRAM, np.int64)
    cuts = carray(pointer(program[CUTS]), program[N_CUTS], np.int64)
    done = box[MADE] - box[START]
    until = cuts[np.searchsorted(cuts, done, side="right")]
    if done >= program[BASE] + program[N_READY]:
        program[BASE], program[N_READY] = done, 0
    if box[MADE] - box[FETCHED] < box[AHEAD] + SURE * (until - done) and render_ahead(box, program, until):
        is_low = 2 * (box[WRITTEN] - box[FETCHED]) < box[N_RING]
        return supply_silence(box, MOST_SAMPLES) if is_low else 0  # a little, as copying takes time
    late = earliest(box) + max(0, box[SLOW] - box[BLOCK]) - box[MADE]
    if late > 0:
        late = -(-late // box[BLOCK]) * box[BLOCK]
        if supply_silence(box, box[MADE] + late + box[BLOCK] - box[WRITTEN]):
            return FAILED
        box[END] += late
        box[START] += late
        box[MADE] += late
        box[N_PAUSES] += done > 0
    if done == 0:
        program[BEGAN] = box[START]
    box[UNTIL] = until
    return 0


@helper_kernel("boolean(int64[::1])")
def is_in_time(box: Words) -> bool:
    """Whether the last part was written before the card fetched it.

    The card reports whole blocks, so it may have fetched one more, or as much as the clock says, if its
    report is later than a block.
    """
    if box[PART] < 0:
        return True
    left = box[PART] - max(box[FETCHED] + box[BLOCK], box[BY_CLOCK])
    box[LEAST], box[PART] = min(box[LEAST], left), -1
    return left >= 0  # pyright: ignore[reportReturnType]


@helper_kernel("int64(int64[::1])")
def start_when_filled(box: Words) -> int:
    """Start the card once it has fetched enough. Returns after how many ns to look again, or a code."""
    if box[FETCHED] < box[TO_START]:
        if box[FILLED_BY_NS] == 0:
            box[FILLED_BY_NS] = box[NOW_NS] + FILLING_NS
        return STUCK if box[NOW_NS] > box[FILLED_BY_NS] else FILLING_POLL_NS
    box[IS_FILLING] = box[FILLED_BY_NS] = box[SHIFT] = 0
    box[LEAST_LAG] = box[USUAL_LAG] = UNKNOWN
    error = call_library(box, box[SET], COMMAND, box[START_COMMAND])
    if box[TIMER]:  # the card plays from some time during the call, so assume the latest
        box[NOW_NS] = now_ns(carray(pointer(box[TIMER]), N_TIMER, np.int64))
    box[STARTED_NS], box[WINDOW_NS] = box[NOW_NS], box[NOW_NS] + FOLLOWED_NS
    return FAILED if error else 0


@kernel("int64(int64[::1], int64)")
def supply(box: Words, rate_hz: int) -> int:
    """Write as much as there is room for. Returns after how many ns that is due again, or a code."""
    in_ring = look(box)
    if box[IS_FILLING] and in_ring != FAILED:
        return start_when_filled(box)  # pyright: ignore[reportReturnType]
    if in_ring < 0:
        return in_ring
    if box[RENDERED_AT] >= 0:
        box[SLOW], box[RENDERED_AT] = box[FETCHED] - box[RENDERED_AT], -1
    follow_clock(box, rate_hz)
    if not is_in_time(box):
        return LATE
    if box[MADE] >= box[END] and box[TAKEN] < box[QUEUED]:
        take_program(box)
    if box[MADE] < box[END]:
        if box[MADE] - box[START] == box[UNTIL]:
            return begin_piece(box)
        room = box[FETCHED] + box[N_RING] - box[MADE]
        return supply_program(box, room) if room else min(POLL_NS, box[N_RING] * 125_000_000 // rate_hz)
    room = box[FETCHED] + box[N_RING] - box[WRITTEN]
    if room:
        return supply_silence(box, min(room, MOST_SAMPLES) if box[WRITTEN] < box[SILENT_FROM] else room)
    if box[PREPARED]:
        program = carray(pointer(box[PREPARED]), N_PROGRAM, np.int64)
        if render_ahead(box, program, program[LENGTH]):
            return 0
    until_end = box[END] + box[ON_CARD] + box[BLOCK] - box[FETCHED]
    wait = min(until_end, box[N_RING] // 4) if until_end > 0 else box[N_RING] // 4
    return wait * 1_000_000_000 // rate_hz


@kernel("int64(int64[::1], int64, int64[::1], int64[::1])")
def feed(box: Words, rate_hz: int, timer: Words, signal: Words) -> int:
    """Supply the card until STOP is set, in a thread of its own. Returns a negative code."""
    box[IS_FEEDING] = 1
    code = STOPPED
    while box[STOP] == 0:
        box[NOW_NS] = now_ns(timer)
        code = supply(box, rate_hz)
        if code < 0:
            break
        if code >= 1_000_000:
            wait_signal(signal, code // 1_000_000)
        elif code > 0:
            sleep_ns(timer, min(code, HELP_POLL_NS))
        code = STOPPED
    box[IS_FEEDING] = 0
    return code
