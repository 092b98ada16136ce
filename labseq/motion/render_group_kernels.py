"""Kernels that group the tones of a segment that share a chirp, and find groups that stay in the next.

For the tones of an axis, and their units, see :mod:`labseq.motion.render_kernels`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import helper_kernel, kernel
from labseq.motion.render_kernels import (
    BLENDED,
    CHIRP,
    COMB,
    DIRECT,
    END,
    END_AMPLITUDE,
    F64,
    FIRST_TOOTH,
    FREQUENCY,
    MAX_GROUPS,
    N_COEFFICIENTS,
    N_SEGMENTS,
    N_TEETH,
    ON_TOOTH,
    PERIOD,
    PHASE,
    PHASE_SINCE,
    SILENT,
    SINCE,
    START,
    START_AMPLITUDE,
    STEADY,
    STEP,
    TONES,
    WORDS,
    Axis,
    Words,
    axis_of,
    turn,
)

Bytes = NDArray[np.int8]
Floats = NDArray[np.float64]

NEAR_TOOTH: Final = 0.05
"""Phase beyond which no cubic can follow a tone, in cycles."""

BLENDING: Final = 1e-7
"""Allowed error of all cubics together, as a fraction of full scale (0.003 of the last digit)."""

BLENDED_COST: Final = 4
"""A blended group takes as long to render as this many single tones, at a period of 390 samples."""

NODES: Final = 0.5 - 0.5 * np.cos(np.pi * (np.arange(N_COEFFICIENTS) + 0.5) / N_COEFFICIENTS)
"""Chebyshev nodes, where a cubic equals the function that it approximates, as fractions of a segment."""

TO_CUBIC: Final = np.linalg.inv(np.vander(NODES, increasing=True))
EXTREMES: Final = 0.5 - 0.5 * np.cos(np.pi * np.arange(N_COEFFICIENTS + 1) / N_COEFFICIENTS)
"""Points at which the error of a cubic is largest."""


@helper_kernel(f"boolean({TONES}, int64)")
def is_steady(tones: Floats, k: int) -> bool:
    """True if the amplitude of a tone stays the same."""
    a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
    return abs(a - b) <= 1e-9 * max(a, b)


@helper_kernel(f"Tuple((boolean, float64, float64))({TONES}, int64, int64)")
def envelope(tones: Floats, start: int, stop: int) -> tuple[bool, float, float]:
    """Find the common course of the squared amplitudes of a segment's unsteady tones.

    Returns:
        True if they share a course, and its values at the start and at the end. The larger is 1.
    """
    first = last = largest = 0.0
    for k in range(start, stop):
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if max(a, b) > largest and not is_steady(tones, k):
            first, last, largest = a, b, max(a, b)
    if largest == 0.0:
        return True, 1.0, 1.0
    for k in range(start, stop):
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if abs(a * last - b * first) > 1e-9 * largest * largest and not is_steady(tones, k):
            return False, 1.0, 1.0
    return True, (first / largest) ** 2, (last / largest) ** 2


@helper_kernel("UniTuple(float64, 2)(float64, float64, float64, float64, float64)")
def slow_part(u: float, a: float, b: float, drift: float, bend: float) -> tuple[float, float]:
    """Amplitude and phase of a tone relative to its tooth at a fraction ``u`` of the segment.

    The amplitude goes from ``a`` to ``b``. In the segment the tone leaves the tooth by ``drift`` cycles due
    to its first frequency, and by ``bend`` cycles due to its chirp.
    """
    amplitude = math.sqrt(max(0.0, a * a + (b * b - a * a) * u))
    re, im = turn(drift * u + bend * u * u)
    return amplitude * re, amplitude * im


@helper_kernel(f"float64(float64, float64, float64, float64, {F64}, {F64})")
def fit_cubic(a: float, b: float, drift: float, bend: float, re: Floats, im: Floats) -> float:
    """Fit a cubic in u to :func:`slow_part`, with 4 coefficients by power, and return its largest error."""
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


@helper_kernel(f"UniTuple(float64, 2)({TONES}, int64, int64, int64, float64, float64)")
def off_tooth(
    tones: Floats, k: int, anchor: int, n_teeth: int, step: float, length: float
) -> tuple[float, float]:
    """Phases by which tone ``k`` leaves its tooth of the group's comb through frequency and chirp, in cycles.

    ``anchor`` is the group's first tone, which defines its frequency and chirp, ``n_teeth`` teeth below. The
    spacing of the teeth, ``step``, is in cycles per sample, the ``length`` of the segment in samples.
    """
    apart = tones[START, k] - tones[START, anchor] - step * n_teeth
    sweep = (tones[END, k] - tones[START, k]) - (tones[END, anchor] - tones[START, anchor])
    return apart * length, 0.5 * sweep * length


@helper_kernel(f"int64({WORDS}, int64, boolean, float64, int64[::1])")
def find_groups(words: Words, i: int, shared: bool, near: float, anchors: NDArray[np.int64]) -> int:
    """Give each tone of segment ``i`` its tooth, and a group of tones that share its chirp.

    Each group has a comb of its own, with the spacing of the axis. Tones may leave their teeth by ``near``
    cycles. If the other tones share an :func:`envelope` (``shared``), steady tones have groups of their own.
    The first tone of each group goes into ``anchors``, int64 (MAX_GROUPS,).

    Returns:
        The number of groups, or 0 if a tone has none.
    """
    axis, step = axis_of(words), words.view(np.float64)[STEP]
    tones, tooth, first, n_groups = axis.tones, axis.tooth, words[FIRST_TOOTH], 0
    for k in range(axis.offsets[i], axis.offsets[i + 1]):
        its = -1
        for g in range(n_groups):
            anchor = int(anchors[g])
            if shared and is_steady(tones, k) != is_steady(tones, anchor):
                continue
            nearest = int(tooth[anchor]) + int(np.rint((tones[START, k] - tones[START, anchor]) / step))
            drift, bend = off_tooth(tones, k, anchor, nearest - tooth[anchor], step, axis.length[i])
            if abs(drift) <= near and abs(bend) <= near:
                its, tooth[k] = g, nearest
                break
        if its < 0:
            if n_groups == MAX_GROUPS:
                return 0
            anchors[n_groups] = k
            its = n_groups
            tooth[k] = np.int32(math.floor(tones[START, k] / step + 0.25))
            n_groups += 1
        if not first <= tooth[k] < first + words[N_TEETH]:
            return 0
        axis.group[k] = its
    return n_groups


@helper_kernel(f"boolean({WORDS}, int64, boolean, int64[::1])")
def can_blend(words: Words, i: int, shared: bool, anchors: NDArray[np.int64]) -> bool:
    """True if cubics follow the tones of a segment, which all have a group, well enough."""
    axis, step, error = axis_of(words), words.view(np.float64)[STEP], 0.0
    tones, re, im = axis.tones, np.empty(N_COEFFICIENTS), np.empty(N_COEFFICIENTS)
    for k in range(axis.offsets[i], axis.offsets[i + 1]):
        anchor = int(anchors[axis.group[k]])
        drift, bend = off_tooth(tones, k, anchor, axis.tooth[k] - axis.tooth[anchor], step, axis.length[i])
        a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
        if shared:
            a = b = max(a, b)
        error += fit_cubic(a, b, drift, bend, re, im)
    return error <= BLENDING


@helper_kernel(f"int64({WORDS}, int64, boolean)")
def choose(words: Words, i: int, shared: bool) -> int:
    """Choose the path of segment ``i``, and find the groups of its tones."""
    axis, loud, moving = axis_of(words), False, False
    n_tones = axis.offsets[i + 1] - axis.offsets[i]
    for k in range(axis.offsets[i], axis.offsets[i + 1]):
        loud = loud or axis.tones[START_AMPLITUDE, k] > 0.0 or axis.tones[END_AMPLITUDE, k] > 0.0
        moving = moving or axis.tones[START, k] != axis.tones[END, k]
    if not loud:
        return SILENT
    if axis.course[i] != 0 and moving:
        return DIRECT
    anchors = np.zeros(MAX_GROUPS, np.int64)
    for near in (0.5 * ON_TOOTH, NEAR_TOOTH):
        n_groups = find_groups(words, i, shared, near, anchors)
        if n_groups > 0 and shared and near < ON_TOOTH:
            return DIRECT if moving and n_groups == n_tones else COMB  # a single tone is faster by itself
        is_worth_it = 0 < BLENDED_COST * n_groups < n_tones
        if is_worth_it and can_blend(words, i, shared, anchors):
            return BLENDED
    return DIRECT


@helper_kernel()
def next_of_group(group: Bytes, g: int, start: int, stop: int) -> int:
    """The first tone of a group from ``start`` on, or ``stop``."""
    k = start
    while k < stop and group[k] != g:
        k += 1
    return k


@helper_kernel()
def segment_of(axis: Axis, k: int) -> int:
    """The segment of tone ``k``."""
    return int(np.searchsorted(axis.offsets, k, "right")) - 1


@helper_kernel(f"Tuple((int64, float64))({WORDS}, int64, int64)")
def since_tone(words: Words, i: int, m: int) -> tuple[int, float]:
    """Samples from the start of the segment of tone ``m`` to the start of segment ``i``, less whole periods.

    Returns:
        These samples, and the cycles by which each tooth turns more than the tooth below from segment to
        segment.
    """
    axis = axis_of(words)
    before = segment_of(axis, m)
    since = (axis.first[i] - axis.first[before]) % words[PERIOD]
    return since, words.view(np.float64)[STEP] * (since + axis.delta[before] - axis.delta[i])


@helper_kernel(f"boolean({WORDS}, int64, int64, int64)")
def has_same_sums(words: Words, i: int, k: int, m: int) -> bool:
    """True if a group of segment ``i`` has the sums of an earlier group, times a wave.

    Their first tones are ``k`` and ``m``.
    """
    axis, (_, per_tooth) = axis_of(words), since_tone(words, i, m)
    tones, tooth, before = axis.tones, axis.tooth, segment_of(axis, m)
    if axis.path[i] != COMB or axis.path[before] != COMB:
        return False
    g, stop, h, stop_before = axis.group[k], axis.offsets[i + 1], axis.group[m], axis.offsets[before + 1]
    further, common = tooth[k] - tooth[m], tones[PHASE, k] - tones[PHASE, m] - tooth[m] * per_tooth
    while k < stop and m < stop_before:
        amplitude = max(tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k])
        amplitude_before = max(tones[START_AMPLITUDE, m], tones[END_AMPLITUDE, m])
        away = tones[PHASE, k] - tones[PHASE, m] - tooth[m] * per_tooth - common
        if tooth[k] - tooth[m] != further or abs(away - np.rint(away)) > ON_TOOTH:
            return False
        if abs(amplitude - amplitude_before) > 1e-9 * amplitude:
            return False
        k, m = next_of_group(axis.group, g, k + 1, stop), next_of_group(axis.group, h, m + 1, stop_before)
    return k == stop and m == stop_before


@helper_kernel(f"void({WORDS}, int64, int64)")
def fill_wave(words: Words, i: int, k: int) -> None:
    """Fill in the factor of the sums of the group whose first tone is ``k``, and take over their teeth."""
    axis = axis_of(words)
    m = axis.origin[k]
    tones, tooth, waves, (since, per_tooth) = axis.tones, axis.tooth, axis.waves, since_tone(words, i, m)
    waves[PHASE_SINCE, k] = tones[PHASE, k] - tones[PHASE, m] - tooth[m] * per_tooth
    waves[FREQUENCY, k] = tones[START, k] - words.view(np.float64)[STEP] * tooth[m]
    waves[CHIRP, k] = (tones[END, k] - tones[START, k]) / axis.length[i]
    waves[SINCE, k], waves[STEADY, k] = since, is_steady(tones, k)
    further, n, stop = tooth[k] - tooth[m], k, axis.offsets[i + 1]
    while n < stop:
        tooth[n] -= further
        n = next_of_group(axis.group, axis.group[k], n + 1, stop)


@helper_kernel(f"void({WORDS}, int64, int64[::1])")
def find_origins(words: Words, i: int, latest: NDArray[np.int64]) -> None:
    """Find the groups of segment ``i`` that stay together from the segment before, and keep its sums.

    ``latest``, int64 (MAX_GROUPS,), is the first tone of each group of the segment before, in the segment
    where its sums were first needed, or -1. It is updated for segment ``i``.
    """
    axis, before = axis_of(words), latest.copy()
    latest[:] = -1
    for k in range(axis.offsets[i], axis.offsets[i + 1]):
        g = axis.group[k]
        axis.origin[k] = -1
        if latest[g] >= 0:
            continue
        latest[g] = k
        for m in before:
            if m >= 0 and latest[g] == k and has_same_sums(words, i, k, m):
                latest[g] = m
        axis.origin[k] = latest[g]
        fill_wave(words, i, k)


@kernel(f"void({WORDS})")
def choose_paths(words: Words) -> None:
    """Decide how each segment of an axis is rendered, and fill in all arrays from the path on."""
    axis, latest = axis_of(words), np.full(MAX_GROUPS, -1)
    for i in range(words[N_SEGMENTS]):
        start, stop = axis.offsets[i], axis.offsets[i + 1]
        shared, axis.squares[0, i], axis.squares[1, i] = envelope(axis.tones, start, stop)
        axis.path[i] = choose(words, i, shared)
        if axis.path[i] == COMB or axis.path[i] == BLENDED:
            find_origins(words, i, latest)
