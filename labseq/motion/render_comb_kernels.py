"""Kernels that share one chirp among the tones of an equally spaced comb.

Frequencies are in cycles per sample, times in samples, phases in cycles. Tones of a
group start on teeth of one comb and share one chirp: tone k has the phase

    phi_k + (nu + m_k mu) x + gamma x^2 / 2

at x samples from the start of the segment. A block is L samples long, a whole number
of the comb's periods: ``L mu`` is whole. With ``x = b L + j + delta`` the group's sum is

    Re[T(j) A_b exp(2 pi i g_b j)]
    T(j) = sum_k a_k exp 2 pi i (phi_k + m_k mu (j + delta)) exp 2 pi i (nu j + gamma j^2 / 2)
    A_b  = exp 2 pi i (nu (b L + delta) + gamma (b L + delta)^2 / 2)
    g_b  = gamma (b L + delta)

T is the same in all blocks of a segment. The rest is worked out in float64 for every
LANES samples and for the samples within, and multiplied in float32: a parked group
costs two operations per sample, a moving one six.

The loops are written for the compiler: only where an index cannot be negative and few
arrays are written to does it use vector instructions; hence the slices and the split loops.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel
from labseq.motion.render_kernels import (
    AXIS,
    BLENDED,
    BLENDED_ROW,
    CUBIC_ROW,
    END,
    END_AMPLITUDE,
    F32,
    F64,
    FINE,
    FULL_SCALE,
    LANES,
    N_COEFFICIENTS,
    ON_TOOTH,
    PHASE,
    SAMPLES,
    START,
    START_AMPLITUDE,
    STRIP_KEYS,
    TABLES,
    TONES,
    V_ROW,
    WITHIN,
    WORKSPACE,
    Axis,
    Workspace,
    add_tooth,
    apply_envelope,
    envelope,
    fill_powers,
    fill_table,
    find_chirp,
    fit_cubic,
    is_there,
    multiply,
    off_tooth,
    repeat,
    store,
    strip_samples,
    take_tones,
    times,
    turn,
)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

FREQUENCY: Final = 0  # of a group's state: nu, gamma, A_b, A_(b+1) / A_b, and what that changes by
CHIRP: Final = 1
NOW: Final = 2
STEP: Final = 4
STEP_OF_STEP: Final = 6


@helper_kernel(f"void({F64}, float64[:, ::1], float64, float64)")
def enter_block(state: Floats, lanes: Floats, x: float, length: float) -> None:
    """Prepare a group for a block that starts ``x`` samples after the start of the segment.

    Its frequency and chirp are given in ``state``, float64 (N_STATE,). The result ``lanes``, float64
    (4, LANES + 1), is exp 2 pi i g_b r, and what it is multiplied by from block to block.
    """
    frequency, chirp = state[FREQUENCY], state[CHIRP]
    state[NOW], state[NOW + 1] = turn(frequency * x + 0.5 * chirp * x * x)
    state[STEP], state[STEP + 1] = turn((frequency + chirp * (x + 0.5 * length)) * length)
    state[STEP_OF_STEP], state[STEP_OF_STEP + 1] = turn(chirp * length * length)
    fill_powers(chirp * x, lanes[0], lanes[1])
    fill_powers(chirp * length, lanes[2], lanes[3])


@helper_kernel(f"void({F32}, int64, int64, {F32}, {F32}, {F64})", fused=True)
def add_parked(acc: Singles, n: int, block: int, re: Singles, im: Singles, state: Floats) -> None:
    """Add a group at rest to the first ``n`` samples of ``acc``, and advance its state to the next block.

    ``re`` and ``im``, float32 (>= block,), are the group's table.
    """
    x, y = state[NOW], state[NOW + 1]
    for b in range((n + block - 1) // block):
        part = acc[b * block :]
        now_re, now_im = np.float32(x), np.float32(y)
        for j in range(min(block, n - b * block)):
            part[j] += re[j] * now_re - im[j] * now_im
        x, y = times(x, y, state[STEP], state[STEP + 1])
    state[NOW], state[NOW + 1] = x, y


@helper_kernel(
    f"void({F32}, int64, {F32}, {F32}, float64, float64, float64, float64, {F32}, {F32})", fused=True
)
def add_block(
    acc: Singles,
    n: int,
    re: Singles,
    im: Singles,
    x: float,
    y: float,
    jump_re: float,
    jump_im: float,
    v_re: Singles,
    v_im: Singles,
) -> None:
    """Add a moving group to ``n`` samples of one block; see :func:`add_moving`."""
    for q in range(n // LANES):
        at = q * LANES
        now_re, now_im = np.float32(x), np.float32(y)
        for r in range(LANES):
            w_re = now_re + (now_re * v_re[r] - now_im * v_im[r])
            w_im = now_im + (now_re * v_im[r] + now_im * v_re[r])
            acc[at + r] += re[at + r] * w_re - im[at + r] * w_im
        x, y = x * jump_re - y * jump_im, x * jump_im + y * jump_re
    at = n // LANES * LANES
    now_re, now_im = np.float32(x), np.float32(y)
    for r in range(n - at):
        w_re = now_re + (now_re * v_re[r] - now_im * v_im[r])
        w_im = now_im + (now_re * v_im[r] + now_im * v_re[r])
        acc[at + r] += re[at + r] * w_re - im[at + r] * w_im


@helper_kernel(
    f"void({F32}, int64, int64, {F32}, {F32}, {F64}, {F64}, {F64}, {F64}, {F64}, {F32}, {F32})", fused=True
)
def add_moving(
    acc: Singles,
    n: int,
    block: int,
    re: Singles,
    im: Singles,
    state: Floats,
    lane_re: Floats,
    lane_im: Floats,
    by_re: Floats,
    by_im: Floats,
    v_re: Singles,
    v_im: Singles,
) -> None:
    """Add a moving group to the first ``n`` samples of ``acc``, and advance its state to the next block.

    The lanes, float64 (LANES + 1,), are cosine and sine of g_b r, and what they are multiplied by from
    block to block. ``v_re`` and ``v_im`` are scratch: the lanes less 1, of which float32 holds more digits.
    """
    for b in range((n + block - 1) // block):
        for r in range(LANES):
            v_re[r] = np.float32(lane_re[r] - 1.0)
            v_im[r] = np.float32(lane_im[r])
        add_block(
            acc[b * block :], min(block, n - b * block), re, im, state[NOW], state[NOW + 1],
            lane_re[LANES], lane_im[LANES], v_re, v_im,
        )  # fmt: skip
        x, y = state[STEP], state[STEP + 1]
        state[NOW], state[NOW + 1] = times(state[NOW], state[NOW + 1], x, y)
        state[STEP], state[STEP + 1] = times(x, y, state[STEP_OF_STEP], state[STEP_OF_STEP + 1])
        multiply(lane_re, lane_im, by_re, by_im, LANES + 1)


@helper_kernel(f"void(float32[:, ::1], int64, float64, {const('float32', 1)}, {F32}, {F32})", fused=True)
def blend(tables: Singles, n: int, u: float, within: Singles, re: Singles, im: Singles) -> None:
    """Blend four tables into one by a cubic in the time since the start of the segment.

    ``tables``, float32 (8, >= n), are real and imaginary part of the coefficient of each power. ``u``
    is the fraction of the segment that has passed at the start of the block, ``within`` that from
    there to each sample.
    """
    first = np.float32(u)
    for part, out in ((0, re), (1, im)):
        c0, c1, c2, c3 = tables[part], tables[part + 2], tables[part + 4], tables[part + 6]
        for j in range(n):
            t = first + within[j]
            out[j] = c0[j] + t * (c1[j] + t * (c2[j] + t * c3[j]))


Ints = NDArray[np.int32]


@helper_kernel(
    f"void({TONES}, {const('int32', 1)}, {TONES}, int64, int64, float64, float64, float64, boolean, int64,"
    " float64[:, ::1])"
)
def add_to_sums(
    tones: Floats,
    tooth: Ints,
    teeth: Floats,
    k: int,
    anchor: int,
    delta: float,
    length: float,
    step: float,
    shared: bool,
    n_tables: int,
    sums: Floats,
) -> None:
    """Add tone ``k`` to the sums over a period, one for each power of the time.

    ``delta`` and ``length`` are those of its segment, ``anchor`` is the first tone of its group.
    """
    re, im = sums[CUBIC_ROW], sums[CUBIC_ROW + 1]
    a, b = tones[START_AMPLITUDE, k], tones[END_AMPLITUDE, k]
    if shared:
        a = b = max(a, b)
    if n_tables == 1:
        re[0], im[0] = a, 0.0
    else:
        drift, bend = off_tooth(tones, k, anchor, tooth[k], tooth[anchor], step, length)
        fit_cubic(a, b, drift, bend, re, im)
    x, y = turn(tones[PHASE, k] + step * tooth[k] * delta)
    for power in range(n_tables):
        w_re = FULL_SCALE * (x * re[power] - y * im[power])
        w_im = FULL_SCALE * (x * im[power] + y * re[power])
        add_tooth(
            teeth[2 * tooth[k]], teeth[2 * tooth[k] + 1], w_re, w_im, sums[2 * power], sums[2 * power + 1]
        )


@helper_kernel(f"void({AXIS}, int64, int64, boolean, boolean, {WORKSPACE})")
def fill_group(axis: Axis, i: int, g: int, shared: bool, blended: bool, workspace: Workspace) -> None:
    """Fill the tables of a group of segment ``i``."""
    tones, tooth, group, teeth, step, block = axis[0], axis[4], axis[5], axis[6], axis[10], axis[11]
    sums, tables, state = workspace[0], workspace[2], workspace[4]
    length, period, n_tables = axis[9][i], teeth.shape[1], N_COEFFICIENTS if blended else 1
    sums[: 2 * n_tables, :period] = 0.0
    anchor = -1
    for k in range(axis[1][i], axis[1][i + 1]):
        if group[k] == g:
            anchor = k if anchor < 0 else anchor
            add_to_sums(tones, tooth, teeth, k, anchor, axis[8][i], length, step, shared, n_tables, sums)
    state[g, FREQUENCY] = tones[START, anchor] - step * tooth[anchor]
    state[g, CHIRP] = (tones[END, anchor] - tones[START, anchor]) / length
    at = find_chirp(state[g, FREQUENCY], state[g, CHIRP], block, workspace[5], workspace[6], workspace[3][g])
    re, im = workspace[5][at, 0], workspace[5][at, 1]
    for row in range(0, 2 * n_tables, 2):
        fill_table(sums[row], sums[row + 1], period, re, im, block, tables[g, row], tables[g, row + 1])


@helper_kernel(f"void({WORKSPACE}, int64, int64, int64)", fused=True)
def add_group(workspace: Workspace, g: int, n: int, block: int) -> None:
    """Add a group to the first ``n`` samples of a strip."""
    work, tables, lanes, state = workspace[1], workspace[2], workspace[3], workspace[4]
    re, im = tables[g, 0], tables[g, 1]
    if state[g, CHIRP] == 0.0:
        add_parked(work[SAMPLES], n, block, re, im, state[g])
    else:
        add_moving(
            work[SAMPLES], n, block, re, im, state[g],
            lanes[g, 0], lanes[g, 1], lanes[g, 2], lanes[g, 3], work[V_ROW], work[V_ROW + 1],
        )  # fmt: skip


@helper_kernel(f"void({WORKSPACE}, int64, int64, int64, float64, float64)")
def add_blended_group(workspace: Workspace, g: int, n: int, block: int, u: float, per_block: float) -> None:
    """Add a blended group to the first ``n`` samples of a strip, which starts ``u`` into the segment."""
    work, tables, lanes, state = workspace[1], workspace[2], workspace[3], workspace[4]
    re, im = work[BLENDED_ROW], work[BLENDED_ROW + 1]
    for b in range((n + block - 1) // block):
        length = min(block, n - b * block)
        acc = work[SAMPLES, b * block :]
        blend(tables[g], length, u + b * per_block, work[WITHIN], re, im)
        if state[g, CHIRP] == 0.0:
            add_parked(acc, length, block, re, im, state[g])
        else:
            add_moving(
                acc, length, block, re, im, state[g],
                lanes[g, 0], lanes[g, 1], lanes[g, 2], lanes[g, 3], work[V_ROW], work[V_ROW + 1],
            )  # fmt: skip


@helper_kernel(f"boolean(int64, int64, float64, {WORKSPACE})")
def has_period(n_groups: int, block: int, length: float, workspace: Workspace) -> bool:
    """Whether all blocks of a segment are equal: its tones are parked, with whole cycles per block."""
    for g in range(n_groups):
        cycles = workspace[4][g, FREQUENCY] * block
        if workspace[4][g, CHIRP] != 0.0 or abs(cycles - np.rint(cycles)) * length > ON_TOOTH * block:
            return False
    return True


@helper_kernel(f"void({AXIS}, int64, int64, int16[::1], {WORKSPACE})")
def render_comb(axis: Axis, i: int, skip: int, out: NDArray[np.int16], workspace: Workspace) -> None:
    """Render a part of segment ``i``, on the comb or blended, from sample ``skip`` of the segment on.

    It is worked out strip by strip, each from its start, so that a sample does not depend
    on the stretch.
    """
    _, offsets, _, path, _, _, _, _, delta, lengths, _, block, number = axis
    work, lanes, state, keys = workspace[1], workspace[3], workspace[4], workspace[6]
    shared, first, last = envelope(axis[0], offsets[i], offsets[i + 1])
    blended, length = path[i] == BLENDED, lengths[i]
    slope = (last - first) / length
    n_groups = axis[5][offsets[i] : offsets[i + 1]].max() + 1
    if not is_there(keys, TABLES, number, i, 0):  # else the stretch before was of this segment, too
        for g in range(n_groups):
            fill_group(axis, i, g, shared, blended, workspace)
        if blended:
            for j in range(block):
                work[WITHIN, j] = np.float32(j / length)
    if first == last and not blended and has_period(n_groups, block, length, workspace):
        keys[STRIP_KEYS] = -1
        work[SAMPLES, :block] = np.float32(0.0)
        for g in range(n_groups):
            enter_block(state[g], lanes[g], delta[i], float(block))
            add_group(workspace, g, block, block)
        store(workspace[8], block, work[SAMPLES], 0)
        repeat(out, skip, workspace[8], block)
        return
    strip, n_samples = strip_samples(block), axis[7][i + 1] - axis[7][i]
    for s in range(skip // strip, (skip + len(out) - 1) // strip + 1):
        x = s * strip + delta[i]
        start, stop = max(0, skip - s * strip), min(strip, skip + len(out) - s * strip)
        if not is_there(keys, STRIP_KEYS, number, i, s):
            whole = min(strip, n_samples - s * strip)  # a stretch that follows needs the rest
            work[SAMPLES, :whole] = np.float32(0.0)
            for g in range(n_groups):
                enter_block(state[g], lanes[g], x, float(block))
                if blended:
                    add_blended_group(workspace, g, whole, block, x / length, block / length)
                else:
                    add_group(workspace, g, whole, block)
            if first != last:
                apply_envelope(work[SAMPLES], whole, first + slope * x, slope)
        store(out[s * strip + start - skip :], stop - start, work[SAMPLES], start)


MAX_TEETH: Final = 64

MAX_TONES: Final = 4 * MAX_TEETH
"""Maximum number of frequencies in the search for a comb."""

TOLERANCE_HZ: Final = 100.0
"""Tones closer than this to a tooth count as on it in the search for a comb, in Hz."""

GRAIN_HZ: Final = 10.0
"""Step of the spacings tried in the search, in Hz."""

TEETH: Final = "float64[::1]"
CONST: Final = const("float64", 1)


@kernel(f"int64({CONST}, {TEETH})")
def distinct_tones(start_hz: Floats, distinct_hz: Floats) -> int:
    """Collect the different frequencies of some tones, to 1 Hz, in rising order.

    Returns how many there are; -1 if they are more than ``distinct_hz``, float64 (MAX_TONES,), can hold.
    """
    n = 0
    for k in range(len(start_hz)):
        hz = np.rint(start_hz[k])
        at = int(np.searchsorted(distinct_hz[:n], hz))
        if at < n and distinct_hz[at] == hz:
            continue
        if n == len(distinct_hz):
            return -1
        for i in range(n, at, -1):
            distinct_hz[i] = distinct_hz[i - 1]
        distinct_hz[at] = hz
        n += 1
    return n


@helper_kernel(f"Tuple((int64, float64))({CONST}, float64)")
def count_multiples(gaps_hz: Floats, spacing_hz: float) -> tuple[int, float]:
    """Count the gaps that are a multiple of a spacing, and find the spacing that fits those best."""
    n, gap_hz, multiples = 0, 0.0, 0.0
    for gap in gaps_hz:
        multiple = np.rint(gap / spacing_hz)
        if multiple > 0.0 and abs(gap - multiple * spacing_hz) <= TOLERANCE_HZ:
            n += 1
            gap_hz += gap
            multiples += multiple
    return n, gap_hz / multiples if n > 0 else 0.0


@kernel(f"float64({CONST})")
def common_spacing(tones_hz: Floats) -> float:
    """Find the largest spacing, in Hz, of which most gaps between rising frequencies are a multiple.

    Candidates are the gaps and the differences of any two. Returns 0 if there is one tone only, -1 if
    there are too many for a comb.
    """
    gaps_hz = tones_hz[1:] - tones_hz[:-1]
    gaps_hz = gaps_hz[gaps_hz > TOLERANCE_HZ]
    if len(gaps_hz) == 0:
        return 0.0
    if len(gaps_hz) >= MAX_TEETH:
        return -1.0
    most, tried, best = 0, 0.0, 0.0
    for i in range(len(gaps_hz)):
        for j in range(i, len(gaps_hz)):
            apart = gaps_hz[i] if i == j else abs(gaps_hz[i] - gaps_hz[j])
            candidate = GRAIN_HZ * np.rint(apart / GRAIN_HZ)
            if apart <= TOLERANCE_HZ or candidate == tried:
                continue
            n, spacing = count_multiples(gaps_hz, candidate)
            if n > most or (n == most and candidate > tried):
                most, tried, best = n, candidate, spacing
    return best


@kernel(
    f"UniTuple(int64, 2)({CONST}, {CONST}, {CONST}, {CONST}, {CONST}, {const('int32', 1)}, float64,"
    " float64[:, ::1], float64[::1])"
)
def survey(
    start_hz: Floats,
    end_hz: Floats,
    start_amplitude: Floats,
    end_amplitude: Floats,
    phase_rad: Floats,
    offsets: Ints,
    sample_rate_hz: float,
    tones: Floats,
    comb_hz: Floats,
) -> tuple[int, int]:
    """Convert the tones of an axis as :func:`take_tones` does, with its result, and look for a comb.

    ``comb_hz``, float64 (3,), is its spacing (see :func:`common_spacing`), its first tooth, and the distance
    of the last one.
    """
    fault, where = take_tones(
        start_hz, end_hz, start_amplitude, end_amplitude, phase_rad, offsets, sample_rate_hz, tones
    )
    comb_hz[0] = -1.0
    if fault == FINE:
        distinct_hz = np.empty(MAX_TONES)
        n = distinct_tones(start_hz, distinct_hz)
        if n > 0:
            comb_hz[0] = common_spacing(distinct_hz[:n])
            comb_hz[1], comb_hz[2] = start_hz.min(), distinct_hz[n - 1] - distinct_hz[0]
    return fault, where


@kernel(f"void({CONST}, {CONST}, int64, float64[:, ::1])")
def fill_teeth(cosine: Floats, sine: Floats, numerator: int, teeth: Floats) -> None:
    """Fill in cosine and sine of each tooth's distance from the first over a period.

    The result is float64 (2 n_teeth, period). ``cosine`` and ``sine``, float64 (period,), are those of
    one turn in steps of 1 / period; ``numerator`` is the number of turns per period from one tooth to
    the next.
    """
    period = len(cosine)
    for tooth in range(len(teeth) // 2):
        step, at = tooth * numerator % period, 0
        for j in range(period):
            teeth[2 * tooth, j] = cosine[at]
            teeth[2 * tooth + 1, j] = sine[at]
            at += step
            if at >= period:
                at -= period
