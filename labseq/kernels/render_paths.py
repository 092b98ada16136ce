"""Kernels that decide how each segment of an axis is rendered.

The tones of an axis are rows of a float64 array, as in :mod:`labseq.kernels.tone_build`:
frequency at the start and at the end of the segment, amplitude at the start and at the
end, and phase at the start, here in cycles per sample, fractions of full scale and cycles.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.render_tables import turn

Bytes = NDArray[np.int8]
Floats = NDArray[np.float64]
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
"""Cycles by which a tone may leave its tooth in a segment: 0.0004 of the last digit at full scale."""

NEAR_TOOTH: Final = 0.05
"""Cycles beyond which no cubic follows it."""

BLENDING: Final = 1e-7
"""Error of all cubics together, in fractions of full scale: 0.003 of the last digit."""

N_COEFFICIENTS: Final = 4
NODES: Final = 0.5 - 0.5 * np.cos(np.pi * (np.arange(N_COEFFICIENTS) + 0.5) / N_COEFFICIENTS)
"""Where in a segment a cubic agrees with what it stands for: Chebyshev's nodes."""

TO_CUBIC: Final = np.linalg.inv(np.vander(NODES, increasing=True))
EXTREMES: Final = 0.5 - 0.5 * np.cos(np.pi * np.arange(N_COEFFICIENTS + 1) / N_COEFFICIENTS)
"""Where its error is largest."""

TONES: Final = const("float64", 2)
F64: Final = "float64[::1]"


@kernel(f"Tuple((boolean, float64, float64))({TONES}, int64, int64)")
def envelope(tones: Floats, start: int, stop: int) -> tuple[bool, float, float]:
    """Find the course of the squared amplitude that all tones of a segment share.

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


@kernel("UniTuple(float64, 2)(float64, float64, float64, float64, float64)")
def slow_part(u: float, a: float, b: float, drift: float, bend: float) -> tuple[float, float]:
    """Amplitude and phase of a tone beside its tooth at a fraction ``u`` of the segment.

    Args:
        u: From 0 to 1.
        a: Amplitude at the start.
        b: Amplitude at the end.
        drift: How far it leaves the tooth with its first frequency, in cycles.
        bend: How far it does with its chirp.
    """
    amplitude = math.sqrt(max(0.0, a * a + (b * b - a * a) * u))
    re, im = turn(drift * u + bend * u * u)
    return amplitude * re, amplitude * im


@kernel(f"float64(float64, float64, float64, float64, {F64}, {F64})")
def fit_cubic(a: float, b: float, drift: float, bend: float, re: Floats, im: Floats) -> float:
    """Fit a cubic to :func:`slow_part`.

    Args:
        a: See there.
        b: See there.
        drift: See there.
        bend: See there.
        re: Result, float64 (4,), coefficient of each power of u.
        im: Their imaginary part.

    Returns:
        Its largest error.
    """
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


@kernel(f"UniTuple(float64, 2)({TONES}, int64, int64, int32, int32, float64, float64)")
def off_tooth(
    tones: Floats, k: int, anchor: int, tooth: int, anchor_tooth: int, step: float, length: float
) -> tuple[float, float]:
    """How far tone ``k`` leaves its tooth of its group's comb, in cycles: by its frequency, by its chirp.

    Args:
        tones: float64 (5, n_tones).
        k: The tone.
        anchor: The group's first tone, which defines its frequency and chirp.
        tooth: The tone's tooth.
        anchor_tooth: That of the group's first tone.
        step: Spacing of the teeth, in cycles per sample.
        length: Length of the segment, in samples.
    """
    apart = tones[START, k] - tones[START, anchor] - step * (tooth - anchor_tooth)
    sweep = (tones[END, k] - tones[START, k]) - (tones[END, anchor] - tones[START, anchor])
    return apart * length, 0.5 * sweep * length


@kernel(f"boolean({TONES}, int64, int64, float64, float64, float64, int64, int32[::1], int8[::1])")
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


@kernel(f"int64({TONES}, int64, int64, float64, float64, int32[::1], int8[::1])")
def choose(
    tones: Floats, start: int, stop: int, length: float, step: float, tooth: Ints, group: Bytes
) -> int:
    """Choose between COMB, BLENDED and DIRECT for a segment whose tones have all found a group."""
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
