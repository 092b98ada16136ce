"""Shared parts of the rendering kernels, with arrays of axes and workspaces, envelopes, rounding and storing.

The tones of an axis are rows of a float64 array as in :mod:`labseq.motion.tone_kernels`, with frequency at
the start and at the end of the segment, amplitude at the start and at the end, and phase at the start. Their
units here are cycles per sample, fractions of full scale and cycles.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel
from labseq.kernels.native import carray, pointer

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bytes = NDArray[np.int8]
Ints = NDArray[np.int32]
Complex = tuple[float, float]

LANES: Final = 32
"""Samples computed together."""

CHUNK: Final = 128
"""Samples computed together for tones on a comb."""

STRIP: Final = 8192
"""Most samples computed in a row, so that they and their tables fit into the fast caches."""

N_CHIRPS: Final = 32
"""Number of cached chirps. Lanes that weave need up to 20 on an axis."""

N_KEPT: Final = 8
"""Number of sums kept in a workspace, which is twice the groups of a segment."""

F32: Final = "float32[::1]"
F64: Final = "float64[::1]"


@helper_kernel("UniTuple(float64, 2)(float64)")
def turn(cycles: float) -> Complex:
    """Cosine and sine of a phase in cycles."""
    phase = 2.0 * math.pi * (cycles - np.rint(cycles))
    return math.cos(phase), math.sin(phase)


START: Final = 0
END: Final = 1
START_AMPLITUDE: Final = 2
END_AMPLITUDE: Final = 3
PHASE: Final = 4
N_FIELDS: Final = 5

SILENT: Final = 0  # as labseq.motion.RenderPath
COMB: Final = 1
BLENDED: Final = 2
DIRECT: Final = 3

MAX_GROUPS: Final = 4
"""Groups of tones that move left, move right, are parked on lines, and are parked between lines."""

ON_TOOTH: Final = 2e-9
"""Phase by which a tone may leave its tooth in a segment, in cycles (0.0004 digits at full scale)."""

N_COEFFICIENTS: Final = 4

PHASE_SINCE: Final = 0  # of a group's wave, the phase by which its sums are turned in its segment
FREQUENCY: Final = 1  # at the start of the segment, less the frequency of its tooth
CHIRP: Final = 2
SINCE: Final = 3  # samples since the first sample of the sums, less whole periods
STEADY: Final = 4  # 1 if the amplitude stays the same
N_WAVE: Final = 5

TONES: Final = const("float64", 2)


Samples = NDArray[np.int16]

FULL_SCALE: Final = 32767.0

N_ROWS: Final = 2 * N_COEFFICIENTS
"""Rows of a table, which are real and imaginary part of the coefficient of each power of the time."""

# Kernels get int64 words, because passing twenty arrays to each takes as long as rendering 1000 samples.
N_OUT: Final = 0  # number of samples to render
N_TONES: Final = 1
N_SEGMENTS: Final = 2
PERIOD: Final = 3  # of the teeth
N_TEETH: Final = 4
FIRST_TOOTH: Final = 5
STEP: Final = 6  # spacing of the teeth in cycles per sample, a float64
BLOCK: Final = 7  # samples of a block
NUMBER: Final = 8  # unique to the axis
AXIS_AT: Final = 9  # addresses of the arrays of an Axis
Words = NDArray[np.int64]
WORDS: Final = "int64[::1]"


class Axis(NamedTuple):
    """The tones of an axis, and how they are rendered.

    Attributes:
        tones: float64 (N_FIELDS, n_tones).
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        course: int8 (n_segments,), of the frequencies.
        first: int64 (n_segments + 1,), first sample of each segment, and the end of the last.
        delta: float64 (n_segments,), time from the segment's start to its first sample, in samples.
        length: float64 (n_segments,), length of the segment, in samples.
        teeth: float64 (2 n_teeth, period), cosine and sine of each tooth.
        path: int8 (n_segments,), see :class:`labseq.motion.RenderPath`.
        squares: float64 (2, n_segments), squared amplitude of unsteady tones at its start and end.
        group: int8 (n_tones,), the group of each tone in its segment.
        origin: int32 (n_tones,), for the first tone of a group the first tone of the first group with the
            same sums, else -1.
        waves: float64 (N_WAVE, n_tones), for the first tone of a group the factor of these sums.
        tooth: int32 (n_tones,), tooth of each tone, as in the group of its origin.
    """

    tones: Floats
    offsets: Ints
    course: Bytes
    first: NDArray[np.int64]
    delta: Floats
    length: Floats
    teeth: Floats
    path: Bytes
    squares: Floats
    group: Bytes
    origin: Ints
    waves: Floats
    tooth: Ints


WIDTH: Final = AXIS_AT + len(Axis._fields)  # of the workspace in which the axis is rendered
SPACE_AT: Final = WIDTH + 1  # addresses of the arrays of its Space


@helper_kernel()
def axis_of(words: Words) -> Axis:
    """The arrays of an axis."""
    n, n_tones, at = words[N_SEGMENTS], words[N_TONES], words[AXIS_AT:]
    return Axis(
        carray(pointer(at[0]), (N_FIELDS, n_tones), np.float64),
        carray(pointer(at[1]), n + 1, np.int32),
        carray(pointer(at[2]), n, np.int8),
        carray(pointer(at[3]), n + 1, np.int64),
        carray(pointer(at[4]), n, np.float64),
        carray(pointer(at[5]), n, np.float64),
        carray(pointer(at[6]), (2 * words[N_TEETH], words[PERIOD]), np.float64),
        carray(pointer(at[7]), n, np.int8),
        carray(pointer(at[8]), (2, n), np.float64),
        carray(pointer(at[9]), n_tones, np.int8),
        carray(pointer(at[10]), n_tones, np.int32),
        carray(pointer(at[11]), (N_WAVE, n_tones), np.float64),
        carray(pointer(at[12]), n_tones, np.int32),
    )


class Space(NamedTuple):
    """The arrays of a workspace.

    Attributes:
        sums: float32 (N_KEPT, N_ROWS, width), over two periods, or a period and a strip.
        table: float32 (N_ROWS, width), the sums of a group in a strip times its wave.
        blended: float32 (2, width), a blended table.
        samples: float32 (width,), samples of a strip.
        wave: float32 (2, CHUNK).
        total: float64 (N_ROWS, width), unfinished sums.
        cubic: float64 (2, N_COEFFICIENTS).
        lanes: float64 (4, CHUNK).
        chirps: float32 (N_CHIRPS, 2, STRIP + CHUNK).
        chirp_keys: float64 (N_CHIRPS + 1,), see :func:`find_chirp`.
        sum_keys: int64 (N_KEPT + 1, 3), axis, first tone and latest segment, and the next place.
        strip: int64 (3,), axis, segment and strip of the samples.
        nodes: int32 (3, width / LANES), of a tone.
        repeated: int16 (width,), a block that is repeated.
    """

    sums: Singles
    table: Singles
    blended: Singles
    samples: Singles
    wave: Singles
    total: Floats
    cubic: Floats
    lanes: Floats
    chirps: Singles
    chirp_keys: Floats
    sum_keys: Words
    strip: Words
    nodes: Ints
    repeated: Samples


N_WORDS: Final = SPACE_AT + len(Space._fields)


@helper_kernel()
def space_of(words: Words) -> Space:
    """The arrays of a workspace."""
    width, at = words[WIDTH], words[SPACE_AT:]
    return Space(
        carray(pointer(at[0]), (N_KEPT, N_ROWS, width), np.float32),
        carray(pointer(at[1]), (N_ROWS, width), np.float32),
        carray(pointer(at[2]), (2, width), np.float32),
        carray(pointer(at[3]), width, np.float32),
        carray(pointer(at[4]), (2, CHUNK), np.float32),
        carray(pointer(at[5]), (N_ROWS, width), np.float64),
        carray(pointer(at[6]), (2, N_COEFFICIENTS), np.float64),
        carray(pointer(at[7]), (4, CHUNK), np.float64),
        carray(pointer(at[8]), (N_CHIRPS, 2, STRIP + CHUNK), np.float32),
        carray(pointer(at[9]), N_CHIRPS + 1, np.float64),
        carray(pointer(at[10]), (N_KEPT + 1, 3), np.int64),
        carray(pointer(at[11]), 3, np.int64),
        carray(pointer(at[12]), (3, width // LANES), np.int32),
        carray(pointer(at[13]), width, np.int16),
    )


class Workspace:
    """The workspace of one thread, for blocks of a given size.

    Attributes:
        words: int64 (N_WORDS - WIDTH,), for kernels, with its width and the addresses of its arrays.
    """

    def __init__(self, block: int) -> None:
        """Allocate the workspace.

        Args:
            block: Samples of a block.
        """
        width = 2 * max(block, STRIP) + 4 * CHUNK
        self._space = Space(
            sums=_aligned((N_KEPT, N_ROWS, width), np.float32),
            table=_aligned((N_ROWS, width), np.float32),
            blended=_aligned((2, width), np.float32),
            samples=_aligned((width,), np.float32),
            wave=_aligned((2, CHUNK), np.float32),
            total=_aligned((N_ROWS, width), np.float64),
            cubic=_aligned((2, N_COEFFICIENTS), np.float64),
            lanes=_aligned((4, CHUNK), np.float64),
            chirps=_aligned((N_CHIRPS, 2, STRIP + CHUNK), np.float32),
            chirp_keys=np.append(np.full(N_CHIRPS, np.nan), 0.0),
            sum_keys=np.append(np.full((N_KEPT, 3), -1, np.int64), np.zeros((1, 3), np.int64), axis=0),
            strip=np.full(3, -1, np.int64),
            nodes=np.zeros((3, width // LANES), np.int32),
            repeated=np.zeros(width, np.int16),
        )
        self.words = np.array([width, *(array.ctypes.data for array in self._space)], np.int64)


def _aligned(shape: tuple[int, ...], dtype: type[np.floating]) -> NDArray[Any]:
    """Zeros aligned for vector instructions. Without alignment rendering takes half as long again."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(size + 64, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first : first + size].view(dtype).reshape(shape)


@helper_kernel(f"boolean({WORDS}, int64, int64, int64)")
def is_there(key: Words, number: int, i: int, strip: int) -> bool:
    """True if the samples already belong to a strip of segment ``i`` of an axis. From now on they do."""
    if key[0] == number and key[1] == i and key[2] == strip:
        return True
    key[0], key[1], key[2] = number, i, strip
    return False


@helper_kernel("void(int16[::1], int64, float32[::1], int64)")
def store(out: NDArray[np.int16], n: int, values: Singles, skip: int) -> None:
    """Round ``values[skip:skip + n]`` to integers through int32, which is four times faster."""
    most, kept = np.int32(FULL_SCALE), values[skip:]
    for j in range(n):
        out[j] = np.int16(min(max(np.int32(np.rint(kept[j])), -most), most))


@helper_kernel("void(int16[::1], int64, int16[::1], int64)")
def repeat(out: NDArray[np.int16], skip: int, block: NDArray[np.int16], n: int) -> None:
    """Fill ``out`` by repeating the ``n`` samples of a block, from sample ``skip`` on."""
    at = skip % n
    done = 0
    while done < len(out):
        length = min(n - at, len(out) - done)
        part, again = out[done:], block[at:]
        for j in range(length):
            part[j] = again[j]
        done += length
        at = 0


@helper_kernel("void(float32[::1], int64, float64, float64)", fused=True)
def apply_envelope(values: Singles, n: int, start: float, slope: float) -> None:
    """Multiply ``n`` samples by an amplitude whose square changes linearly from sample to sample.

    Where it changes by less than a sixteenth around the middle of some samples, a series of four terms with
    an error below 3e-8 is used, because square roots take much longer.

    Args:
        values: float32 (>= n + CHUNK,). Updated.
        n: Number of samples.
        start: The squared amplitude at the first sample. Below 0 counts as 0.
        slope: Its change from each sample to the next.
    """
    middle = 0.5 * (CHUNK - 1)
    for q in range((n + CHUNK - 1) // CHUNK):
        part, square = values[q * CHUNK :], start + slope * (q * CHUNK + middle)
        if abs(slope) * middle * 16.0 < square:
            root, by = np.float32(math.sqrt(square)), np.float32(slope / square)
            first = np.float32(-middle * slope / square)
            for r in range(CHUNK):
                z = first + by * np.float32(r)
                part[r] *= root + root * (z * (C_1 + z * (C_2 + z * (C_3 + z * C_4))))
        else:
            first, by = np.float32(square - middle * slope), np.float32(slope)
            for r in range(CHUNK):
                part[r] *= np.sqrt(max(np.float32(0.0), first + by * np.float32(r)))


C_1: Final = np.float32(1 / 2)
C_2: Final = np.float32(-1 / 8)
C_3: Final = np.float32(1 / 16)
C_4: Final = np.float32(-5 / 128)


SUM: Final = 5
"""Fault of a sum of amplitudes above full scale. Other faults are numbers of fields."""
FINE: Final = -1

ROUNDING: Final = 1e-9
"""Excess over full scale that rounding of amplitudes may cause."""

VALUES: Final = const("float64", 1)


@kernel(f"boolean({VALUES}, float64, float64, int64[::1], float64[::1], float64[::1])")
def place_segments(
    duration_s: Floats,
    sample_rate_hz: float,
    most_samples: float,
    first_sample: NDArray[np.int64],
    delta: Floats,
    length: Floats,
) -> bool:
    """Fill in the first sample of each segment and the end, int64 (n + 1,), and its times, float64 (n,).

    The times are the time from its start to its first sample and its length, in samples. Returns True if all
    durations are finite and not negative, and there are fewer than ``most_samples``.
    """
    start_s = 0.0
    for i in range(len(duration_s)):
        if not 0.0 <= duration_s[i] < np.inf:
            return False
        at = start_s * sample_rate_hz
        first_sample[i] = int(np.rint(at))
        delta[i], length[i] = first_sample[i] - at, duration_s[i] * sample_rate_hz
        start_s += duration_s[i]
        if not start_s * sample_rate_hz < most_samples:
            return False
    first_sample[len(duration_s)] = int(np.rint(start_s * sample_rate_hz))
    return True


@kernel(
    f"UniTuple(int64, 2)({VALUES}, {VALUES}, {VALUES}, {VALUES}, {VALUES}, {const('int32', 1)}, float64,"
    " float64[:, ::1])"
)
def take_tones(
    start_hz: Floats,
    end_hz: Floats,
    start_amplitude: Floats,
    end_amplitude: Floats,
    phase_rad: Floats,
    offsets: Ints,
    sample_rate_hz: float,
    tones: Floats,
) -> tuple[int, int]:
    """Convert the tones of an axis, as in :class:`labseq.model.AxisTones`, to the units of rendering.

    Returns:
        The wrong field, SUM, or FINE if nothing is wrong, and the first tone or segment where it is wrong.
    """
    half_hz, most = 0.5 * sample_rate_hz, 1.0 + ROUNDING
    for i in range(len(offsets) - 1):
        first = last = 0.0
        for k in range(offsets[i], offsets[i + 1]):
            if not 0.0 <= start_hz[k] <= half_hz:
                return START, k
            if not 0.0 <= end_hz[k] <= half_hz:
                return END, k
            if not 0.0 <= start_amplitude[k] <= most:
                return START_AMPLITUDE, k
            if not 0.0 <= end_amplitude[k] <= most:
                return END_AMPLITUDE, k
            if not np.isfinite(phase_rad[k]):
                return PHASE, k
            tones[START, k] = start_hz[k] / sample_rate_hz
            tones[END, k] = end_hz[k] / sample_rate_hz
            tones[START_AMPLITUDE, k] = start_amplitude[k]
            tones[END_AMPLITUDE, k] = end_amplitude[k]
            tones[PHASE, k] = phase_rad[k] / (2.0 * np.pi)
            first += start_amplitude[k]
            last += end_amplitude[k]
        if max(first, last) > most:
            return SUM, i
    return FINE, -1
