"""Kernels that all renderers share: paths of tones, phase tables, rounding and storing.

The tones of an axis are rows of a float64 array, as in :mod:`labseq.motion.tone_kernels`:
frequency at the start and at the end of the segment, amplitude at the start and at the
end, and phase at the start, here in cycles per sample, fractions of full scale and cycles.
"""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel

N_STATE: Final = 8
"""Numbers in the state of a group of tones in a block."""


Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Complex = tuple[float, float]

LANES: Final = 32
"""Samples computed together."""

N_CHIRPS: Final = 8
"""Number of cached chirps: to the right, to the left and parked, on two axes, and two spare ones."""

TABLES: Final = 2 * N_CHIRPS + 1
STRIP_KEYS: Final = TABLES + 3
N_KEYS: Final = STRIP_KEYS + 3
"""Behind the keys of the chirps: what tables and samples there are of, number of the axis, segment, strip."""

FREQUENCY_GRID: Final = 2.0**44
CHIRP_GRID: Final = 2.0**62

F32: Final = "float32[::1]"
F64: Final = "float64[::1]"


@helper_kernel("UniTuple(float64, 2)(float64)")
def turn(cycles: float) -> Complex:
    """Cosine and sine of a phase in cycles."""
    phase = 2.0 * math.pi * (cycles - np.rint(cycles))
    return math.cos(phase), math.sin(phase)


@helper_kernel("UniTuple(float64, 2)(float64, float64, float64, float64)", fused=True)
def times(a_re: float, a_im: float, b_re: float, b_im: float) -> Complex:
    """Product of two complex numbers."""
    return a_re * b_re - a_im * b_im, a_re * b_im + a_im * b_re


@helper_kernel(f"void(float64, {F64}, {F64})")
def fill_powers(cycles: float, re: Floats, im: Floats) -> None:
    """Fill in exp(2 pi i cycles r), r = 0, 1, ..."""
    step_re, step_im = turn(cycles)
    re[0], im[0] = 1.0, 0.0
    for r in range(1, len(re)):
        re[r], im[r] = times(re[r - 1], im[r - 1], step_re, step_im)


@kernel(f"void({F64}, {F64}, {F64}, {F64}, int64)", fused=True)
def multiply(re: Floats, im: Floats, by_re: Floats, by_im: Floats, n: int) -> None:
    """Multiply the first ``n`` complex numbers by others in place."""
    for r in range(n):
        x, y = re[r], im[r]
        re[r] = x * by_re[r] - y * by_im[r]
        im[r] = x * by_im[r] + y * by_re[r]


@helper_kernel(
    f"void({const('float64', 1)}, {const('float64', 1)}, float64, float64, {F64}, {F64})", fused=True
)
def add_tooth(
    cosine: Floats, sine: Floats, weight_re: float, weight_im: float, re: Floats, im: Floats
) -> None:
    """Add a tone, the wave of its tooth times a complex weight, to the sum over a period, float64 (>= n,)."""
    for j in range(len(cosine)):
        re[j] += weight_re * cosine[j] - weight_im * sine[j]
        im[j] += weight_re * sine[j] + weight_im * cosine[j]


@helper_kernel(f"void(float64, float64, int64, {F32}, {F32}, float64[:, ::1])", fused=True)
def fill_chirp(frequency: float, chirp: float, n: int, re: Singles, im: Singles, lanes: Floats) -> None:
    """Fill in exp 2 pi i (frequency j + chirp j^2 / 2), j = 0 ... n - 1.

    ``re`` and ``im`` are float32 (>= n + LANES,), ``lanes`` is scratch, float64 (4, >= LANES).
    """
    step_re, step_im = turn(frequency + 0.5 * chirp)
    more_re, more_im = turn(chirp)
    x, y = 1.0, 0.0
    for r in range(LANES):
        lanes[0, r], lanes[1, r] = x, y
        x, y = times(x, y, step_re, step_im)
        step_re, step_im = times(step_re, step_im, more_re, more_im)
    fill_powers(chirp * LANES, lanes[2], lanes[3])
    now_re, now_im, by_re, by_im = lanes[0], lanes[1], lanes[2], lanes[3]
    for q in range((n + LANES - 1) // LANES):
        at = q * LANES
        a, b = turn(frequency * at + 0.5 * chirp * at * at)
        for r in range(LANES):
            re[at + r] = np.float32(a * now_re[r] - b * now_im[r])
        for r in range(LANES):
            im[at + r] = np.float32(a * now_im[r] + b * now_re[r])
        multiply(now_re, now_im, by_re, by_im, LANES)


@helper_kernel(f"int64(float64, float64, int64, float32[:, :, ::1], {F64}, float64[:, ::1])")
def find_chirp(frequency: float, chirp: float, n: int, chirps: Singles, keys: Floats, lanes: Floats) -> int:
    """Find or fill in exp 2 pi i (frequency j + chirp j^2 / 2), which many segments share.

    Frequency and chirp are rounded to grids that make no difference in a block.

    Args:
        frequency: In cycles per sample.
        chirp: In cycles per sample squared.
        n: Samples of a block.
        chirps: float32 (N_CHIRPS, 2, >= n + LANES), those that there are; updated.
        keys: float64 (N_KEYS,), frequency and chirp of each, and how many were filled in.
        lanes: Scratch, see :func:`fill_chirp`.

    Returns:
        Its index in ``chirps``.
    """
    frequency = np.rint(frequency * FREQUENCY_GRID) / FREQUENCY_GRID
    chirp = np.rint(chirp * CHIRP_GRID) / CHIRP_GRID
    for at in range(N_CHIRPS):
        if keys[2 * at] == frequency and keys[2 * at + 1] == chirp:
            return at
    at = int(keys[2 * N_CHIRPS]) % N_CHIRPS
    fill_chirp(frequency, chirp, n, chirps[at, 0], chirps[at, 1], lanes)
    keys[2 * at], keys[2 * at + 1] = frequency, chirp
    keys[2 * N_CHIRPS] += 1.0
    return at


@helper_kernel(f"void({F64}, {F64}, int64, {F32}, {F32}, int64, {F32}, {F32})", fused=True)
def fill_table(
    sum_re: Floats,
    sum_im: Floats,
    period: int,
    chirp_re: Singles,
    chirp_im: Singles,
    length: int,
    re: Singles,
    im: Singles,
) -> None:
    """Repeat a comb's sum over a block, and multiply it by the chirp."""
    for at in range(0, length, period):
        out_re, out_im, by_re, by_im = re[at:], im[at:], chirp_re[at:], chirp_im[at:]
        for j in range(period):
            out_re[j] = np.float32(sum_re[j]) * by_re[j] - np.float32(sum_im[j]) * by_im[j]
        for j in range(period):
            out_im[j] = np.float32(sum_re[j]) * by_im[j] + np.float32(sum_im[j]) * by_re[j]


Bytes = NDArray[np.int8]
Ints = NDArray[np.int32]

START: Final = 0
END: Final = 1
START_AMPLITUDE: Final = 2
END_AMPLITUDE: Final = 3
PHASE: Final = 4

SILENT: Final = 0  # as labseq.motion.RenderPath
COMB: Final = 1
BLENDED: Final = 2
DIRECT: Final = 3

MAX_GROUPS: Final = 3
"""Tones that move left, that move right, and that are parked."""

ON_TOOTH: Final = 2e-9
"""Phase by which a tone may leave its tooth in a segment, in cycles: 0.0004 digits at full scale."""

NEAR_TOOTH: Final = 0.05
"""Phase beyond which no cubic follows a tone, in cycles."""

BLENDING: Final = 1e-7
"""Allowed error of all cubics together, as a fraction of full scale: 0.003 of the last digit."""

N_COEFFICIENTS: Final = 4
NODES: Final = 0.5 - 0.5 * np.cos(np.pi * (np.arange(N_COEFFICIENTS) + 0.5) / N_COEFFICIENTS)
"""Points of a segment at which a cubic equals the function that it approximates: Chebyshev nodes."""

TO_CUBIC: Final = np.linalg.inv(np.vander(NODES, increasing=True))
EXTREMES: Final = 0.5 - 0.5 * np.cos(np.pi * np.arange(N_COEFFICIENTS + 1) / N_COEFFICIENTS)
"""Points at which the error of a cubic is largest."""

TONES: Final = const("float64", 2)


@helper_kernel(f"Tuple((boolean, float64, float64))({TONES}, int64, int64)")
def envelope(tones: Floats, start: int, stop: int) -> tuple[bool, float, float]:
    """Find the common course of the squared amplitudes of a segment's tones.

    Returns:
        Whether they share one; its value at the start and at the end, the larger being 1.
    """
    first = last = largest = 0.0
    for k in range(start, stop):
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if max(a, b) > largest:
            first, last, largest = a, b, max(a, b)
    if largest == 0.0:
        return True, 1.0, 1.0
    for k in range(start, stop):
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if abs(a * last - b * first) > 1e-9 * largest * largest:
            return False, 1.0, 1.0
    return True, (first / largest) ** 2, (last / largest) ** 2


@helper_kernel("UniTuple(float64, 2)(float64, float64, float64, float64, float64)")
def slow_part(u: float, a: float, b: float, drift: float, bend: float) -> tuple[float, float]:
    """Amplitude and phase of a tone relative to its tooth at a fraction ``u`` of the segment.

    The amplitude goes from ``a`` to ``b``; ``drift`` and ``bend`` are the cycles by which the tone
    leaves the tooth in the segment, by its first frequency and by its chirp.
    """
    amplitude = math.sqrt(max(0.0, a * a + (b * b - a * a) * u))
    re, im = turn(drift * u + bend * u * u)
    return amplitude * re, amplitude * im


@helper_kernel(f"float64(float64, float64, float64, float64, {F64}, {F64})")
def fit_cubic(a: float, b: float, drift: float, bend: float, re: Floats, im: Floats) -> float:
    """Fit a cubic in u to :func:`slow_part`, coefficients float64 (4,) by power; return its largest error."""
    re[:], im[:] = 0.0, 0.0
    for n in range(N_COEFFICIENTS):
        x, y = slow_part(NODES[n], a, b, drift, bend)
        for i in range(N_COEFFICIENTS):
            re[i] += TO_CUBIC[i, n] * x
            im[i] += TO_CUBIC[i, n] * y
    worst = 0.0
    for n in range(N_COEFFICIENTS + 1):
        u = EXTREMES[n]
        x, y = slow_part(u, a, b, drift, bend)
        x -= re[0] + u * (re[1] + u * (re[2] + u * re[3]))
        y -= im[0] + u * (im[1] + u * (im[2] + u * im[3]))
        worst = max(worst, math.sqrt(x * x + y * y))
    return worst


@helper_kernel(f"UniTuple(float64, 2)({TONES}, int64, int64, int32, int32, float64, float64)")
def off_tooth(
    tones: Floats, k: int, anchor: int, tooth: int, anchor_tooth: int, step: float, length: float
) -> tuple[float, float]:
    """Phase by which tone ``k`` leaves its tooth of the group's comb, in cycles: by frequency, by chirp.

    ``anchor`` is the group's first tone, which defines its frequency and chirp; the spacing of the teeth,
    ``step``, is in cycles per sample, the ``length`` of the segment in samples.
    """
    apart = tones[START, k] - tones[START, anchor] - step * (tooth - anchor_tooth)
    sweep = (tones[END, k] - tones[START, k]) - (tones[END, anchor] - tones[START, anchor])
    return apart * length, 0.5 * sweep * length


@helper_kernel(f"boolean({TONES}, int64, int64, float64, float64, float64, int64, int32[::1], int8[::1])")
def find_groups(
    tones: Floats,
    start: int,
    stop: int,
    length: float,
    origin: float,
    step: float,
    n_teeth: int,
    tooth: Ints,
    group: Bytes,
) -> bool:
    """Give each tone of a segment its tooth, and a group of tones that share its chirp.

    Returns:
        Whether all have one.
    """
    anchors = np.zeros(MAX_GROUPS, np.int64)
    n_groups = 0
    for k in range(start, stop):
        nearest = np.rint((tones[START, k] - origin) / step)
        if not 0 <= nearest < n_teeth:
            return False
        tooth[k] = np.int32(nearest)
        its = -1
        for g in range(n_groups):
            anchor = int(anchors[g])
            drift, bend = off_tooth(tones, k, anchor, tooth[k], tooth[anchor], step, length)
            if its < 0 and abs(drift) <= NEAR_TOOTH and abs(bend) <= NEAR_TOOTH:
                its = g
        if its < 0:
            if n_groups == MAX_GROUPS:
                return False
            anchors[n_groups] = k
            its = n_groups
            n_groups += 1
        group[k] = its
    return True


@helper_kernel(f"int64({TONES}, int64, int64, float64, float64, int32[::1], int8[::1])")
def choose(
    tones: Floats, start: int, stop: int, length: float, step: float, tooth: Ints, group: Bytes
) -> int:
    """Choose between COMB, BLENDED and DIRECT for a segment whose tones all have a group."""
    anchors = np.full(MAX_GROUPS, -1, np.int64)
    for k in range(stop - 1, start - 1, -1):
        anchors[group[k]] = k
    shared, _, _ = envelope(tones, start, stop)
    exact = shared
    for k in range(start, stop):
        anchor = int(anchors[group[k]])
        drift, bend = off_tooth(tones, k, anchor, tooth[k], tooth[anchor], step, length)
        exact = exact and abs(drift) + abs(bend) <= ON_TOOTH
    if exact:
        return COMB
    re, im = np.empty(N_COEFFICIENTS), np.empty(N_COEFFICIENTS)
    error = 0.0
    for k in range(start, stop):
        anchor = int(anchors[group[k]])
        drift, bend = off_tooth(tones, k, anchor, tooth[k], tooth[anchor], step, length)
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if shared:
            a = b = max(a, b)
        error += fit_cubic(a, b, drift, bend, re, im)
    return BLENDED if error <= BLENDING else DIRECT


@kernel(
    f"void({TONES}, {const('int32', 1)}, {const('float64', 1)}, {const('int8', 1)}, float64, float64,"
    " int64, int8[::1], int32[::1], int8[::1])"
)
def choose_paths(
    tones: Floats,
    offsets: Ints,
    length: Floats,
    course: Bytes,
    origin: float,
    step: float,
    n_teeth: int,
    path: Bytes,
    tooth: Ints,
    group: Bytes,
) -> None:
    """Decide how each segment of an axis is rendered.

    Args:
        tones: float64 (5, n_tones).
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        length: float64 (n_segments,), in samples.
        course: int8 (n_segments,), of the frequencies.
        origin: Frequency of the first tooth, in cycles per sample.
        step: Spacing of the teeth.
        n_teeth: Number of teeth; 0 if there is no comb.
        path: Result, int8 (n_segments,).
        tooth: Result, int32 (n_tones,), tooth of each tone at the start of the segment.
        group: Result, int8 (n_tones,), its group.
    """
    for i in range(len(length)):
        start, stop = offsets[i], offsets[i + 1]
        loud = moving = False
        for k in range(start, stop):
            loud = loud or tones[START_AMPLITUDE, k] > 0.0 or tones[END_AMPLITUDE, k] > 0.0
            moving = moving or tones[START, k] != tones[END, k]
        if not loud:
            path[i] = SILENT
        elif (course[i] != 0 and moving) or not find_groups(
            tones, start, stop, length[i], origin, step, n_teeth, tooth, group
        ):
            path[i] = DIRECT
        else:
            path[i] = choose(tones, start, stop, length[i], step, tooth, group)


Samples = NDArray[np.int16]

FULL_SCALE: Final = 32767.0

N_SUMS: Final = 2 * N_COEFFICIENTS  # rows of the first array of Workspace
CUBIC_ROW: Final = N_SUMS
N_ROWS64: Final = N_SUMS + 2

SAMPLES: Final = 0  # rows of the second
BLENDED_ROW: Final = 1
WITHIN: Final = 3
V_ROW: Final = 4
N_ROWS32: Final = 6

STRIP: Final = 8192
"""Maximum number of samples of a strip of several blocks."""

Axis: TypeAlias = tuple[
    Floats, Ints, Bytes, Bytes, Ints, Bytes, Floats, NDArray[np.int64], Floats, Floats, float, int, int
]
"""An axis: tones, offsets, course, path, tooth and group (see :mod:`labseq.motion.render_kernels`),
cosine and sine of each tooth over a period, each segment's first sample (and the end of the last),
the time from its start to there and its length, both in samples, the spacing of the teeth in cycles
per sample, the samples of a block, and a number that no other axis has."""

Workspace: TypeAlias = tuple[Floats, Singles, Singles, Floats, Floats, Singles, Floats, Ints, Samples]
"""The workspace of one thread, see :func:`new_workspace`."""

AXIS: Final = (
    f"Tuple(({const('float64', 2)}, {const('int32', 1)}, {const('int8', 1)}, {const('int8', 1)},"
    f" {const('int32', 1)}, {const('int8', 1)}, {const('float64', 2)}, {const('int64', 1)},"
    f" {const('float64', 1)}, {const('float64', 1)}, float64, int64, int64))"
)
WORKSPACE: Final = (
    "Tuple((float64[:, ::1], float32[:, ::1], float32[:, :, ::1], float64[:, :, ::1], float64[:, ::1],"
    " float32[:, :, ::1], float64[::1], int32[:, ::1], int16[::1]))"
)


@kernel("int64(int64)")
def strip_samples(block: int) -> int:
    """Number of samples computed together: as many blocks as fit into the fastest cache."""
    return max(1, STRIP // block) * block


def new_workspace(block: int) -> Workspace:
    """Allocate the workspace of one thread, for blocks of ``block`` samples.

    Returns:
        float64 (N_ROWS64, width): sums over a period, coefficients of a cubic.
        float32 (N_ROWS32, width): the samples, a blended table, fractions of the segment, lanes.
        float32 (MAX_GROUPS, N_SUMS, width): tables of each group.
        float64 (MAX_GROUPS, 4, LANES + 1): lanes of each group.
        float64 (MAX_GROUPS, N_STATE): state of each group.
        float32 (N_CHIRPS, 2, width), float64 (N_KEYS,): chirps, their keys, and those of the tables.
        int32 (3, width / LANES): nodes of a tone.
        int16 (width,): a block that is repeated.
    """
    width = (strip_samples(block) // LANES + 2) * LANES
    return (
        np.zeros((N_ROWS64, width)),
        np.zeros((N_ROWS32, width), np.float32),
        np.zeros((MAX_GROUPS, N_SUMS, width), np.float32),
        np.zeros((MAX_GROUPS, 4, LANES + 1)),
        np.zeros((MAX_GROUPS, N_STATE)),
        np.zeros((N_CHIRPS, 2, width), np.float32),
        np.concatenate([np.full(2 * N_CHIRPS, np.nan), [0.0], np.full(N_KEYS - TABLES, -1.0)]),
        np.zeros((3, width // LANES), np.int32),
        np.zeros(width, np.int16),
    )


@helper_kernel(f"boolean({F64}, int64, int64, int64, int64)")
def is_there(keys: Floats, at: int, number: int, i: int, strip: int) -> bool:
    """Whether tables or samples are those of a strip of segment ``i``; from now on they are."""
    if keys[at] == number and keys[at + 1] == i and keys[at + 2] == strip:
        return True
    keys[at], keys[at + 1], keys[at + 2] = number, i, strip
    return False


@helper_kernel("void(int16[::1], int64, float32[::1], int64)")
def store(out: NDArray[np.int16], n: int, values: Singles, skip: int) -> None:
    """Round ``values[skip:skip + n]`` to integers, through int32, which is four times faster."""
    most = np.float32(FULL_SCALE)
    kept = values[skip:]
    for j in range(n):
        out[j] = np.int16(np.int32(np.rint(min(max(kept[j], -most), most))))


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

    ``start`` is the squared amplitude at the first sample (below 0 counts as 0), ``slope`` its change from
    each to the next; ``values`` is float32, its length a multiple of LANES.
    """
    by = np.float32(slope)
    for q in range((n + LANES - 1) // LANES):
        at = q * LANES
        first = np.float32(start + slope * at)
        for r in range(LANES):
            values[at + r] *= np.sqrt(max(np.float32(0.0), first + by * np.float32(r)))


N_FIELDS: Final = 5
SUM: Final = 5
"""Amplitudes that add up to more than full scale; see :data:`N_FIELDS` for the other fields."""
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

    These are, in samples, the time from its start to its first sample, and its length. Returns whether all
    durations are finite and not negative, and there are less than ``most_samples``.
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
        What is wrong, a field or SUM (FINE: nothing is), and the first tone or segment where it is.
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
