"""Kernels that share one chirp among the tones of an equally spaced comb.

Frequencies are in cycles per sample, times in samples, phases in cycles. Tones of a
group start on teeth of one comb and share one chirp: tone k has the phase

    phi_k + (nu + m_k mu) x + gamma x^2 / 2

at x samples from the start of the segment. In a strip, from x_0 on, x = x_0 + j, the sum of the group is

    Re[P(j) exp 2 pi i (psi + (nu + gamma x_0) j) exp(pi i gamma j^2)]
    P(j) = sum_k a_k exp 2 pi i (phi_k + m_k mu j)

P repeats itself after the comb's period, which is M samples with M mu whole. It is computed once for as long
as the tones stay together, because from segment to segment only psi and the start of P change. P times the
wave, whose frequency is constant in the strip, is the table of the strip. The table is one period long, and
its phase changes from period to period. The last factor is the same in all strips of tones of one speed, and
is kept. All this is computed in float64 and multiplied in float32. A parked group costs two operations per
sample, and a moving group six.

The loops have slices, are split and contain no conditions because the compiler uses vector instructions only
where an index cannot be negative and few arrays are written to.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel
from labseq.motion.render_group_kernels import envelope, fit_cubic, next_of_group, off_tooth, segment_of
from labseq.motion.render_kernels import (
    BLENDED,
    BLOCK,
    CHIRP,
    CHUNK,
    END_AMPLITUDE,
    F32,
    F64,
    FIRST_TOOTH,
    FREQUENCY,
    FULL_SCALE,
    LANES,
    N_CHIRPS,
    N_COEFFICIENTS,
    N_KEPT,
    NUMBER,
    ON_TOOTH,
    PERIOD,
    PHASE,
    PHASE_SINCE,
    SINCE,
    START_AMPLITUDE,
    STEADY,
    STEP,
    STRIP,
    WORDS,
    Complex,
    Words,
    apply_envelope,
    axis_of,
    is_there,
    repeat,
    space_of,
    store,
    turn,
)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


COMPLEX: Final = "UniTuple(float64, 2)"

CHIRP_GRID: Final = 2.0**62


@helper_kernel("UniTuple(float64, 2)(float64, float64, float64, float64)", fused=True)
def times(a_re: float, a_im: float, b_re: float, b_im: float) -> Complex:
    """Product of two complex numbers."""
    return a_re * b_re - a_im * b_im, a_re * b_im + a_im * b_re


@helper_kernel(f"UniTuple(float64, 2)(float64, {F64}, {F64})", fused=True)
def fill_powers(cycles: float, re: Floats, im: Floats) -> Complex:
    """Fill in exp(2 pi i cycles r), r = 0 ... n - 1, for n a power of 2, and return the value for r = n."""
    x, y = turn(cycles)
    re[0], im[0] = 1.0, 0.0
    done = 1
    while done < len(re):
        from_re, from_im, to_re, to_im = re[:done], im[:done], re[done:], im[done:]
        for r in range(done):
            to_re[r] = from_re[r] * x - from_im[r] * y
        for r in range(done):
            to_im[r] = from_re[r] * y + from_im[r] * x
        x, y = times(x, y, x, y)
        done *= 2
    return x, y


@helper_kernel(f"void({F64}, {F64}, {F64}, {F64}, int64)", fused=True)
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


@helper_kernel(f"void(float64, int64, {F32}, {F32}, float64[:, ::1])", fused=True)
def fill_chirp(chirp: float, n: int, re: Singles, im: Singles, lanes: Floats) -> None:
    """Fill in exp(pi i chirp j^2), j = 0 ... n - 1.

    ``re`` and ``im`` are float32 (>= n + LANES,), ``lanes`` is scratch, float64 (4, >= LANES).
    """
    now_re, now_im, by_re, by_im = lanes[0, :LANES], lanes[1, :LANES], lanes[2, :LANES], lanes[3, :LANES]
    step_re, step_im = turn(0.5 * chirp)
    more_re, more_im = turn(chirp)
    x, y = 1.0, 0.0
    for r in range(LANES):
        now_re[r], now_im[r] = x, y
        x, y = times(x, y, step_re, step_im)
        step_re, step_im = times(step_re, step_im, more_re, more_im)
    fill_powers(chirp * LANES, by_re, by_im)
    a, b, step_re, step_im = 1.0, 0.0, *turn(0.5 * chirp * LANES * LANES)
    more_re, more_im = turn(chirp * LANES * LANES)
    for q in range((n + LANES - 1) // LANES):
        out_re, out_im = re[q * LANES :], im[q * LANES :]
        for r in range(LANES):
            out_re[r] = np.float32(a * now_re[r] - b * now_im[r])
        for r in range(LANES):
            out_im[r] = np.float32(a * now_im[r] + b * now_re[r])
        a, b = times(a, b, step_re, step_im)
        step_re, step_im = times(step_re, step_im, more_re, more_im)
        multiply(now_re, now_im, by_re, by_im, LANES)


@helper_kernel(f"int64(float64, float32[:, :, ::1], {F64}, float64[:, ::1])")
def find_chirp(chirp: float, chirps: Singles, keys: Floats, lanes: Floats) -> int:
    """Find exp(pi i chirp j^2) for a strip, which many segments share, or fill it in.

    Args:
        chirp: Chirp, in cycles per sample squared. Rounded to a grid that makes no difference in a strip.
        chirps: float32 (N_CHIRPS, 2, >= STRIP + LANES), the cached chirps. Updated.
        keys: float64 (N_CHIRPS + 1,), each cached chirp, and how many were filled in. Updated.
        lanes: Scratch of :func:`fill_chirp`.

    Returns:
        Its index in ``chirps``.
    """
    chirp = np.rint(chirp * CHIRP_GRID) / CHIRP_GRID
    for at in range(N_CHIRPS):
        if keys[at] == chirp:
            return at
    at = int(keys[N_CHIRPS]) % N_CHIRPS
    fill_chirp(chirp, STRIP, chirps[at, 0], chirps[at, 1], lanes)
    keys[at] = chirp
    keys[N_CHIRPS] += 1.0
    return at


@helper_kernel(f"void({F32}, int64, {F32}, {F32}, int64, int64, {COMPLEX}, {COMPLEX})", fused=True)
def add_parked(
    acc: Singles,
    n: int,
    re: Singles,
    im: Singles,
    offset: int,
    period: int,
    now: Complex,
    by: Complex,
) -> None:
    """Add a group at rest, multiplied by ``now``, to ``n`` samples, with arguments as in :func:`add_moving`.

    ``offset`` is the place of the first sample in the table.
    """
    x, y = now
    for q in range((n + CHUNK - 1) // CHUNK):
        out, t_re, t_im = acc[q * CHUNK :], re[offset:], im[offset:]
        now_re, now_im = np.float32(x), np.float32(y)
        for r in range(CHUNK):
            out[r] += t_re[r] * now_re - t_im[r] * now_im
        offset += CHUNK
        if offset >= period:
            offset -= period
            x, y = times(x, y, by[0], by[1])


@helper_kernel(f"void({F32}, int64, {F32}, {F32}, int64, {COMPLEX}, {F32}, {F32})", fused=True)
def add_moving(
    acc: Singles,
    n: int,
    re: Singles,
    im: Singles,
    period: int,
    by: Complex,
    chirp_re: Singles,
    chirp_im: Singles,
) -> None:
    """Add a moving group to ``n`` samples, rounded up to whole chunks.

    Args:
        acc: The samples. Updated.
        n: Number of samples.
        re: Real part of the table, float32 (>= min(period, n) + CHUNK,).
        im: Its imaginary part.
        period: Its period.
        by: Factor from period to period.
        chirp_re: Real part of the chirp, float32 (>= n + CHUNK,).
        chirp_im: Its imaginary part.
    """
    x, y, offset = 1.0, 0.0, 0
    for q in range((n + CHUNK - 1) // CHUNK):
        at = q * CHUNK
        out, t_re, t_im, c_re, c_im = acc[at:], re[offset:], im[offset:], chirp_re[at:], chirp_im[at:]
        now_re, now_im = np.float32(x), np.float32(y)
        for r in range(CHUNK):
            w_re, w_im = now_re * c_re[r] - now_im * c_im[r], now_re * c_im[r] + now_im * c_re[r]
            out[r] += t_re[r] * w_re - t_im[r] * w_im
        offset += CHUNK
        if offset >= period:
            offset -= period
            x, y = times(x, y, by[0], by[1])


@helper_kernel(
    f"void(float32[:, ::1], int64, int64, {COMPLEX}, float64, float64, float32[:, ::1])", fused=True
)
def blend(
    tables: Singles, n: int, period: int, by: Complex, u: float, per_sample: float, blended: Singles
) -> None:
    """Blend tables by a cubic in the time since the start of the segment, for ``n`` samples of a strip.

    Args:
        tables: float32 (N_ROWS, ...), real and imaginary part of the coefficient of each power.
        n: Number of samples, rounded up to whole chunks.
        period: Period of the tables.
        by: Their factor from period to period.
        u: Fraction of the segment that has passed at the first sample.
        per_sample: Increase of ``u`` from sample to sample.
        blended: Result, float32 (2, >= n + CHUNK).
    """
    x, y, offset = 1.0, 0.0, 0
    slope = np.float32(per_sample)
    for q in range((n + CHUNK - 1) // CHUNK):
        first, now_re, now_im = np.float32(u + per_sample * (q * CHUNK)), np.float32(x), np.float32(y)
        re, im = blended[0, q * CHUNK :], blended[1, q * CHUNK :]
        for part, out in ((0, re), (1, im)):
            c0, c1 = tables[part, offset:], tables[part + 2, offset:]
            c2, c3 = tables[part + 4, offset:], tables[part + 6, offset:]
            for r in range(CHUNK):
                t = first + slope * np.float32(r)
                out[r] = c0[r] + t * (c1[r] + t * (c2[r] + t * c3[r]))
        for r in range(CHUNK):
            a, b = re[r], im[r]
            re[r] = a * now_re - b * now_im
            im[r] = a * now_im + b * now_re
        offset += CHUNK
        if offset >= period:
            offset -= period
            x, y = times(x, y, by[0], by[1])


@helper_kernel(f"void({WORDS}, int64, int64, int64, boolean, int64)")
def add_to_sums(words: Words, i: int, k: int, anchor: int, shared: bool, n_sums: int) -> None:
    """Add tone ``k`` of segment ``i`` to the sums over a period, one for each power of the time.

    ``anchor`` is the first tone of its group.
    """
    axis, space, step = axis_of(words), space_of(words), words.view(np.float64)[STEP]
    tones, tooth, re, im = axis.tones, int(axis.tooth[k]), space.cubic[0], space.cubic[1]
    a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
    if shared:
        a = b = max(a, b)
    if n_sums == 1:
        re[0], im[0] = a, 0.0
    else:
        drift, bend = off_tooth(tones, k, anchor, tooth - axis.tooth[anchor], step, axis.length[i])
        fit_cubic(a, b, drift, bend, re, im)
    x, y = turn(tones[PHASE, k] + step * tooth * axis.delta[i])
    row = 2 * (tooth - words[FIRST_TOOTH])
    for power in range(n_sums):
        w_re = FULL_SCALE * (x * re[power] - y * im[power])
        w_im = FULL_SCALE * (x * im[power] + y * re[power])
        re_sum, im_sum = space.total[2 * power], space.total[2 * power + 1]
        add_tooth(axis.teeth[row], axis.teeth[row + 1], w_re, w_im, re_sum, im_sum)


@helper_kernel("int64(int64[:, ::1], int64, int64)")
def find_sums(keys: Words, number: int, anchor: int) -> int:
    """Place of the sums of a group in the workspace, by its first tone, or -1 if they are not there."""
    for at in range(N_KEPT):
        if keys[at, 0] == number and keys[at, 1] == anchor:
            return at
    return -1


@helper_kernel(f"void({WORDS}, int64)")
def find_all_sums(words: Words, i: int) -> None:
    """Fill in the sums of the groups of segment ``i`` that are not in the workspace."""
    axis, keys, number = axis_of(words), space_of(words).sum_keys, words[NUMBER]
    table = axis.origin[axis.offsets[i] : axis.offsets[i + 1]]
    for anchor in table:
        at = find_sums(keys, number, anchor) if anchor >= 0 else -1
        if at >= 0:
            keys[at, 2] = i
    for anchor in table:
        if anchor < 0 or find_sums(keys, number, anchor) >= 0:
            continue
        at = keys[N_KEPT, 0]
        while keys[at, 0] == number and keys[at, 2] == i:  # the segment also needs it
            at = (at + 1) % N_KEPT
        keys[at, 0], keys[at, 1], keys[at, 2] = number, anchor, i
        keys[N_KEPT, 0] = (at + 1) % N_KEPT
        fill_sums(words, anchor, at)


@helper_kernel(f"void({WORDS}, int64, int64)")
def fill_sums(words: Words, anchor: int, at: int) -> None:
    """Fill in the sums of the group whose first tone is ``anchor`` at place ``at`` of the workspace.

    They cover two periods or more from the first sample of its segment.
    """
    axis, space, period = axis_of(words), space_of(words), words[PERIOD]
    i = segment_of(axis, anchor)
    k, stop, n_sums = anchor, axis.offsets[i + 1], N_COEFFICIENTS if axis.path[i] == BLENDED else 1
    space.total[: 2 * n_sums, :period] = 0.0
    shared, _, _ = envelope(axis.tones, axis.offsets[i], stop)
    while k < stop:
        add_to_sums(words, i, k, anchor, shared, n_sums)
        k = next_of_group(axis.group, axis.group[anchor], k + 1, stop)
    for row in range(2 * n_sums):
        once, twice, total = space.sums[at, row], space.sums[at, row, period:], space.total[row]
        for j in range(period):
            once[j] = np.float32(total[j])
        for j in range(min(period, STRIP) + 2 * CHUNK):
            twice[j] = once[j]


@helper_kernel(f"void({WORDS}, int64, int64, int64, int64, float64, float64, float64)", fused=True)
def fill_table(
    words: Words, at: int, n_sums: int, first: int, n: int, sign: float, phase: float, frequency: float
) -> None:
    """Multiply sums by exp 2 pi i (phase + frequency j), j = 0 ... n - 1, and conjugate if ``sign`` is -1.

    Args:
        words: Words of axis and workspace. The workspace's table is the result.
        at: Number of the sums in the workspace.
        n_sums: Number of sums.
        first: Place where j is 0.
        n: Number of samples. There is room for CHUNK more.
        sign: 1 or -1.
        phase: Phase, in cycles.
        frequency: Frequency, in cycles per sample.
    """
    space = space_of(words)
    sums, tables, lane_re, lane_im = space.sums[at], space.table, space.lanes[0], space.lanes[1]
    by_re, by_im = fill_powers(sign * frequency, lane_re, lane_im)
    wave_re, wave_im = space.wave[0], space.wave[1]
    for r in range(CHUNK):
        wave_re[r] = np.float32(lane_re[r])
    for r in range(CHUNK):
        wave_im[r] = np.float32(lane_im[r])
    x, y = turn(sign * phase)
    side = np.float32(sign)
    for q in range((n + CHUNK - 1) // CHUNK):
        start = q * CHUNK
        a, b = np.float32(x), np.float32(y)
        for row in range(0, 2 * n_sums, 2):
            re, im = sums[row, first + start :], sums[row + 1, first + start :]
            out_re, out_im = tables[row, start:], tables[row + 1, start:]
            for r in range(CHUNK):
                w_re, w_im = a * wave_re[r] - b * wave_im[r], a * wave_im[r] + b * wave_re[r]
                out_re[r] = re[r] * w_re - side * im[r] * w_im
                out_im[r] = re[r] * w_im + side * im[r] * w_re
        x, y = times(x, y, by_re, by_im)


STILL: Final = 1e-13
"""Frequency that makes no difference in a strip, in cycles per sample."""


@helper_kernel(f"void({WORDS}, int64, int64, int64, float64, float64, float64, float64, float64)")
def add_group(
    words: Words,
    n: int,
    at: int,
    offset: int,
    phase: float,
    frequency: float,
    chirp: float,
    u: float,
    per_sample: float,
) -> None:
    """Add a group to ``n`` samples of a strip.

    Args:
        words: Words of axis and workspace.
        n: Number of samples.
        at: Number of its sums in the workspace.
        offset: Place of the first sample in them.
        phase: Phase of its wave at the first sample, in cycles.
        frequency: Frequency, in cycles per sample.
        chirp: Chirp, in cycles per sample squared.
        u: Fraction of the segment that has passed at the first sample.
        per_sample: Increase of ``u`` from sample to sample, or 0 if the group is not blended.
    """
    space, period = space_of(words), words[PERIOD]
    acc, n_sums = space.samples, 1 if per_sample == 0.0 else N_COEFFICIENTS
    if chirp == 0.0 and abs(frequency) < STILL and per_sample == 0.0:
        now = turn(phase + 0.5 * frequency * n)
        add_parked(acc, n, space.sums[at, 0], space.sums[at, 1], offset, period, now, (1.0, 0.0))
        return
    # the conjugate has the same real part, so a chirp serves both directions
    sign = math.copysign(1.0, chirp)
    fill_table(words, at, n_sums, offset, min(period, n) + CHUNK, sign, phase, frequency)
    re, im, by = space.table[0], space.table[1], turn(sign * frequency * period)
    if per_sample != 0.0:
        blend(space.table, n, period, by, u, per_sample, space.blended)
        re, im, period, by = space.blended[0], space.blended[1], n + CHUNK, (1.0, 0.0)
    if chirp == 0.0:
        add_parked(acc, n, re, im, 0, period, (1.0, 0.0), by)
        return
    c = find_chirp(abs(chirp), space.chirps, space.chirp_keys, space.lanes)
    add_moving(acc, n, re, im, period, by, space.chirps[c, 0], space.chirps[c, 1])


@helper_kernel(f"void({WORDS}, int64, int64, int64)")
def fill_strip(words: Words, i: int, start: int, n: int) -> None:
    """Fill in ``n`` samples of segment ``i`` from ``start`` on, with steady tones after the envelope."""
    axis, space = axis_of(words), space_of(words)
    waves, acc, length = axis.waves, space.samples, axis.length[i]
    x, slope = start + axis.delta[i], (axis.squares[1, i] - axis.squares[0, i]) / length
    per_sample = 1.0 / length if axis.path[i] == BLENDED else 0.0
    acc[:n] = np.float32(0.0)
    for steady in (0.0, 1.0):
        if steady == 1.0 and slope != 0.0:
            apply_envelope(acc, n, axis.squares[0, i] + slope * x, slope)
        for k in range(axis.offsets[i], axis.offsets[i + 1]):
            if axis.origin[k] < 0 or waves[STEADY, k] != steady:
                continue
            frequency, chirp = waves[FREQUENCY, k], waves[CHIRP, k]
            phase = waves[PHASE_SINCE, k] + x * (frequency + 0.5 * chirp * x)
            offset = (int(waves[SINCE, k]) + start) % words[PERIOD]
            at = find_sums(space.sum_keys, words[NUMBER], axis.origin[k])
            add_group(words, n, at, offset, phase, frequency + chirp * x, chirp, x * per_sample, per_sample)


@helper_kernel(f"boolean({WORDS}, int64)")
def has_period(words: Words, i: int) -> bool:
    """True if all blocks of a segment are equal (steady tones parked on the comb, in whole cycles)."""
    axis, block = axis_of(words), words[BLOCK]
    waves = axis.waves
    for k in range(axis.offsets[i], axis.offsets[i + 1]):
        cycles = waves[FREQUENCY, k] * block
        if axis.origin[k] >= 0 and not (
            waves[STEADY, k] == 1.0
            and waves[CHIRP, k] == 0.0
            and abs(cycles - np.rint(cycles)) * axis.length[i] <= ON_TOOTH * block
        ):
            return False
    return axis.path[i] != BLENDED


@helper_kernel(f"void({WORDS}, int64, int64, int16[::1])")
def render_comb(words: Words, i: int, skip: int, out: NDArray[np.int16]) -> None:
    """Render a part of segment ``i``, on the comb or blended, from sample ``skip`` of the segment on.

    It is computed strip by strip, each from its start, so that a sample does not depend on which part is
    rendered.
    """
    axis, space, number, block = axis_of(words), space_of(words), words[NUMBER], words[BLOCK]
    n_samples = axis.first[i + 1] - axis.first[i]
    find_all_sums(words, i)
    if has_period(words, i):
        if not is_there(space.strip, number, i, -1):
            fill_strip(words, i, 0, block)
            store(space.repeated, block, space.samples, 0)
        repeat(out, skip, space.repeated, block)
        return
    for s in range(skip // STRIP, (skip + len(out) - 1) // STRIP + 1):
        start, end = max(0, skip - s * STRIP), min(STRIP, skip + len(out) - s * STRIP)
        if not is_there(space.strip, number, i, s):  # the part that follows needs the rest
            fill_strip(words, i, s * STRIP, min(STRIP, n_samples - s * STRIP))
        store(out[s * STRIP + start - skip :], end - start, space.samples, start)
