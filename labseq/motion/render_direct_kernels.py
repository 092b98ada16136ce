"""Kernels that sum tone by tone, for any frequency course.

Frequencies are in cycles per sample, times in samples, phases in cycles. The phase is computed in float64
every :data:`LANES` samples, with its first and second derivative. Between these it is computed in integers of
2^-32 cycles, where whole cycles drop out by themselves.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import helper_kernel, kernel
from labseq.kernels.native import carray, pointer
from labseq.motion.render_comb_kernels import render_comb
from labseq.motion.render_group_kernels import envelope, is_steady
from labseq.motion.render_kernels import (
    DIRECT,
    END,
    END_AMPLITUDE,
    FULL_SCALE,
    LANES,
    N_OUT,
    N_SEGMENTS,
    N_WORDS,
    NUMBER,
    PHASE,
    SILENT,
    START,
    START_AMPLITUDE,
    STRIP,
    WORDS,
    Words,
    apply_envelope,
    axis_of,
    is_there,
    space_of,
    store,
)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Nodes = NDArray[np.int32]

LINEAR: Final = 0  # as labseq.model.FrequencyCourse
MINIMUM_JERK: Final = 1
CONSTANT_JERK: Final = 2

MIDDLE: Final = LANES // 2
TURN: Final = 2.0**32
MOST: Final = 2.0**31 - 1.0
BEND_BITS: Final = 8
"""Extra bits of the second derivative of the phase."""

MAX_CHIRP: Final = 2.0**-17
"""Chirp above which :func:`add_steep` adds a tone, in cycles per sample squared."""

MAX_JERK: Final = 5e-11
"""Change of chirp above which a tone is steep, in cycles per sample cubed, for an error of 1e-8 cycles."""

QUARTER: Final = np.int32(1 << 30)
PER_UNIT: Final = np.float32(2.0**-32)
# sin(2 pi z) for |z| <= 1/4, fitted one coefficient after the other, each rounded first, error below 8e-9
C1: Final = np.float32(6.2831855)
C3: Final = np.float32(-41.341713)
C5: Final = np.float32(81.60403)
C7: Final = np.float32(-76.61017)
C9: Final = np.float32(39.94631)

F32: Final = "float32[::1]"


@helper_kernel("UniTuple(float64, 4)(float64)")
def minimum_jerk(u: float) -> tuple[float, float, float, float]:
    """See :func:`course`."""
    v = u * u
    return (
        v * v * (2.5 - u * (3.0 - u)),
        v * u * (10.0 - u * (15.0 - 6.0 * u)),
        30.0 * v * (1.0 - u) * (1.0 - u),
        60.0 * u * (1.0 - u) * (1.0 - 2.0 * u),
    )


@helper_kernel("UniTuple(float64, 4)(float64)")
def constant_jerk(u: float) -> tuple[float, float, float, float]:
    """See :func:`course`."""
    v = u * u
    return v * u * (1.0 - 0.5 * u), v * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u), 6.0 - 12.0 * u


@kernel("UniTuple(float64, 4)(int64, float64)")
def course(kind: int, u: float) -> tuple[float, float, float, float]:
    """Fraction of its change that a frequency has completed at a fraction ``u`` of the segment.

    Returns:
        Integral of this fraction from 0 to u, the fraction, from 0 to 1, and its first and second derivative.
    """
    if kind == MINIMUM_JERK:
        return minimum_jerk(u)
    if kind == CONSTANT_JERK:
        return constant_jerk(u)
    return 0.5 * u * u, u, 1.0, 0.0


@helper_kernel("boolean(int64, float64, float64)")
def is_steep(kind: int, sweep: float, length: float) -> bool:
    """True if a tone's frequency, which changes by ``sweep``, changes too fast for :func:`add_tone`."""
    chirp = abs(sweep) / length
    if kind == LINEAR:
        return chirp > MAX_CHIRP
    return 2.0 * chirp > MAX_CHIRP or 8.0 * chirp / length > MAX_JERK


@helper_kernel("int32(float64)")
def as_int32(cycles: float) -> int:
    """A phase in 2^-32 cycles, without whole cycles."""
    return np.int32(min(np.rint((cycles - np.rint(cycles)) * TURN), MOST))  # pyright: ignore[reportReturnType]


@helper_kernel(
    "void(int64, float64, float64, float64, float64, float64, int64, int32[::1], int32[::1], int32[::1])"
)
def fill_course(
    kind: int,
    phase: float,
    frequency: float,
    sweep: float,
    length: float,
    x: float,
    n: int,
    phases: Nodes,
    frequencies: Nodes,
    bends: Nodes,
) -> None:
    """Body of :func:`fill_nodes` for a course known at compile time."""
    per_length = 1.0 / length
    third = 0.125 * MIDDLE * MIDDLE * sweep * per_length * per_length
    for q in range(n):
        at = x + MIDDLE + q * LANES
        whole, part, slope, bend = course(kind, at * per_length)
        cycles = phase + frequency * at + sweep * length * whole
        now = frequency + sweep * part + third * bend
        phases[q] = as_int32(cycles)
        frequencies[q] = as_int32(now)
        bends[q] = np.int32(np.rint(sweep * slope * per_length * (0.5 * TURN * (1 << BEND_BITS))))


@helper_kernel("void(float64, float64, float64, float64, int64, int32[::1], int32[::1], int32[::1])")
def fill_linear(
    phase: float,
    frequency: float,
    chirp: float,
    x: float,
    n: int,
    phases: Nodes,
    frequencies: Nodes,
    bends: Nodes,
) -> None:
    """Body of :func:`fill_nodes` for constant speed."""
    for q in range(n):
        at = x + MIDDLE + q * LANES
        phases[q] = as_int32(phase + at * (frequency + 0.5 * chirp * at))
        frequencies[q] = as_int32(frequency + chirp * at)
        bends[q] = np.int32(np.rint(chirp * (0.5 * TURN * (1 << BEND_BITS))))


@helper_kernel("void(int64, float64, float64, float64, float64, float64, int64, int32[:, ::1])")
def fill_nodes(
    kind: int,
    phase: float,
    frequency: float,
    sweep: float,
    length: float,
    x: float,
    n: int,
    nodes: Nodes,
) -> None:
    """Compute phase, frequency and chirp of a tone in the middle of every LANES samples, from ``x`` on.

    The third derivative is made part of the frequency such that its error is least. ``phase`` and
    ``frequency`` are at the start of the segment, ``sweep`` is the change of the frequency. The result is
    int32 (3, >= n), in 2^-32 cycles. The chirp is halved and finer by BEND_BITS.
    """
    a, b, c = nodes[0], nodes[1], nodes[2]
    if kind == MINIMUM_JERK:
        fill_course(MINIMUM_JERK, phase, frequency, sweep, length, x, n, a, b, c)
    elif kind == CONSTANT_JERK:
        fill_course(CONSTANT_JERK, phase, frequency, sweep, length, x, n, a, b, c)
    else:
        fill_linear(phase, frequency, sweep / length, x, n, a, b, c)


@helper_kernel("float32(int32, int32, int32, int64)", fused=True)
def wave(phase: int, frequency: int, bend: int, r: int) -> float:
    """Cosine of a phase, ``r`` samples from its node, by cos(2 pi t) = sin(2 pi (1/4 - |t|))."""
    near = np.int32(r)
    t = np.int32(phase + frequency * near)
    t = np.int32(t + (np.int32(bend * np.int32(near * near)) >> BEND_BITS))
    z = np.float32(np.int32(QUARTER - np.int32(t ^ (t >> 31)))) * PER_UNIT
    w = z * z
    return z * (C1 + w * (C3 + w * (C5 + w * (C7 + w * C9))))  # pyright: ignore[reportReturnType]


@helper_kernel(f"void({F32}, int64, int32[:, ::1], float64)", fused=True)
def add_tone(acc: Singles, n: int, nodes: Nodes, amplitude: float) -> None:
    """Add a tone of constant amplitude to ``n`` times LANES samples."""
    a = np.float32(amplitude)
    for q in range(n):
        phase, frequency, bend = nodes[0, q], nodes[1, q], nodes[2, q]
        for r in range(LANES):
            z = wave(phase, frequency, bend, r - MIDDLE)
            acc[q * LANES + r] += a * z


@helper_kernel(f"void({F32}, int64, int32[:, ::1], float64, float64)", fused=True)
def add_ramped_tone(acc: Singles, n: int, nodes: Nodes, start: float, slope: float) -> None:
    """Add a tone to ``n`` times LANES samples whose squared amplitude changes linearly."""
    by = np.float32(slope)
    for q in range(n):
        phase, frequency, bend = nodes[0, q], nodes[1, q], nodes[2, q]
        first = np.float32(start + slope * (q * LANES))
        for r in range(LANES):
            z = wave(phase, frequency, bend, r - MIDDLE)
            acc[q * LANES + r] += np.sqrt(max(np.float32(0.0), first + by * np.float32(r))) * z


@helper_kernel(f"void({F32}, int64, int64, float64, float64, float64, float64, float64, float64, float64)")
def add_steep(
    acc: Singles,
    n: int,
    kind: int,
    phase: float,
    frequency: float,
    sweep: float,
    length: float,
    x: float,
    start: float,
    slope: float,
) -> None:
    """Add a tone of any steepness to ``n`` samples, all in float64.

    ``start`` and ``slope`` are its squared amplitude at the first sample and the change from sample to
    sample. The other arguments are as in :func:`fill_nodes`.
    """
    for j in range(n):
        at = x + j
        cycles = phase + frequency * at + sweep * length * course(kind, at / length)[0]
        amplitude = math.sqrt(max(0.0, start + slope * j))
        acc[j] += np.float32(amplitude * math.cos(2.0 * math.pi * (cycles - np.rint(cycles))))


@helper_kernel(f"void({WORDS}, int64, int64, float64, int64, boolean)")
def add_direct(words: Words, i: int, k: int, x: float, n: int, shared: bool) -> None:
    """Add tone ``k`` of segment ``i`` to ``n`` samples, the first of them ``x`` samples after its start."""
    axis, space = axis_of(words), space_of(words)
    tones, length, kind = axis.tones, axis.length[i], axis.course[i]
    acc, nodes = space.samples, space.nodes
    a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
    if shared:
        a = b = max(a, b)
    phase, frequency, sweep = tones[PHASE, k], tones[START, k], tones[END, k] - tones[START, k]
    slope = FULL_SCALE**2 * (b * b - a * a) / length
    start = FULL_SCALE**2 * a * a + slope * x
    if is_steep(kind, sweep, length):
        add_steep(acc, n, kind, phase, frequency, sweep, length, x, start, slope)
        return
    n_nodes = (n + LANES - 1) // LANES
    fill_nodes(kind, phase, frequency, sweep, length, x, n_nodes, nodes)
    if a == b:
        add_tone(acc, n_nodes, nodes, FULL_SCALE * a)
    else:
        add_ramped_tone(acc, n_nodes, nodes, start, slope)


@helper_kernel(f"void({WORDS}, int64, int64, int16[::1])")
def render_direct(words: Words, i: int, skip: int, out: NDArray[np.int16]) -> None:
    """Render a part of segment ``i`` tone by tone, with arguments as in :func:`render_comb`."""
    axis, space = axis_of(words), space_of(words)
    tones, offsets, samples = axis.tones, axis.offsets, space.samples
    shared, first, last = envelope(tones, offsets[i], offsets[i + 1])
    slope, n_samples = (last - first) / axis.length[i], axis.first[i + 1] - axis.first[i]
    for s in range(skip // STRIP, (skip + len(out) - 1) // STRIP + 1):
        x = s * STRIP + axis.delta[i]
        start, stop = max(0, skip - s * STRIP), min(STRIP, skip + len(out) - s * STRIP)
        if not is_there(space.strip, words[NUMBER], i, s):
            whole = min(STRIP, n_samples - s * STRIP)
            samples[:whole] = np.float32(0.0)
            for steady in (False, True):
                if steady and first != last:
                    apply_envelope(samples, whole, first + slope * x, slope)
                for k in range(offsets[i], offsets[i + 1]):
                    if is_steady(tones, k) == steady:
                        add_direct(words, i, k, x, whole, shared)
        store(out[s * STRIP + start - skip :], stop - start, samples, start)


@kernel("int64(int64, int64, int64)")
def render_at(address: int, start: int, out_address: int) -> int:
    """Render samples of an axis, with 0 beyond its end.

    Args:
        address: Address of the words of the axis and of a workspace. Word N_OUT is the number of samples.
        start: First sample.
        out_address: Address of the result, int16 (N_OUT,).

    Returns:
        0.
    """
    words = carray(pointer(address), N_WORDS, np.int64)
    axis, out = axis_of(words), carray(pointer(out_address), words[N_OUT], np.int16)
    path, first = axis.path, axis.first
    at, stop, i = start, start + len(out), int(np.searchsorted(first, start, "right")) - 1
    while at < stop and i < words[N_SEGMENTS]:
        until = min(stop, first[i + 1])
        if at < until:
            piece = out[at - start : until - start]
            if path[i] == SILENT:
                piece[:] = 0
            elif path[i] == DIRECT:
                render_direct(words, i, at - first[i], piece)
            else:
                render_comb(words, i, at - first[i], piece)
            at = until
        i += 1
    out[at - start :] = 0
    return 0


@kernel("int64(int64, int64, int64)", for_c=True)
def render_for_c(address: int, start: int, out_address: int) -> int:
    """:func:`render_at`, for code in C."""
    return render_at(address, start, out_address)
