"""Kernels that render a segment whose tones stand on the teeth of a comb."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.render_comb import (
    CHIRP,
    FREQUENCY,
    add_moving,
    add_parked,
    blend,
    enter_block,
)
from labseq.kernels.render_paths import (
    BLENDED,
    END,
    END_AMPLITUDE,
    N_COEFFICIENTS,
    ON_TOOTH,
    PHASE,
    START,
    START_AMPLITUDE,
    TONES,
    envelope,
    fit_cubic,
    off_tooth,
)
from labseq.kernels.render_store import apply_envelope, repeat, store
from labseq.kernels.render_tables import add_tooth, fill_table, find_chirp, turn
from labseq.kernels.render_types import (
    AXIS,
    BLENDED_ROW,
    CUBIC_ROW,
    FULL_SCALE,
    ROOM,
    SAMPLES,
    V_ROW,
    WITHIN,
    Axis,
    Room,
    strip_samples,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@kernel(
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


@kernel(f"void({AXIS}, int64, int64, boolean, boolean, {ROOM})")
def fill_group(axis: Axis, i: int, g: int, shared: bool, blended: bool, room: Room) -> None:
    """Fill the tables of a group of segment ``i``."""
    tones, tooth, group, teeth, step, block = axis[0], axis[4], axis[5], axis[6], axis[10], axis[11]
    sums, tables, state = room[0], room[2], room[4]
    length, period, n_tables = axis[9][i], teeth.shape[1], N_COEFFICIENTS if blended else 1
    sums[: 2 * n_tables, :period] = 0.0
    anchor = -1
    for k in range(axis[1][i], axis[1][i + 1]):
        if group[k] == g:
            anchor = k if anchor < 0 else anchor
            add_to_sums(tones, tooth, teeth, k, anchor, axis[8][i], length, step, shared, n_tables, sums)
    state[g, FREQUENCY] = tones[START, anchor] - step * tooth[anchor]
    state[g, CHIRP] = (tones[END, anchor] - tones[START, anchor]) / length
    at = find_chirp(state[g, FREQUENCY], state[g, CHIRP], block, room[5], room[6], room[3][g])
    re, im = room[5][at, 0], room[5][at, 1]
    for row in range(0, 2 * n_tables, 2):
        fill_table(sums[row], sums[row + 1], period, re, im, block, tables[g, row], tables[g, row + 1])


@kernel(f"void({ROOM}, int64, int64, int64)", fused=True)
def add_group(room: Room, g: int, n: int, block: int) -> None:
    """Add a group to the first ``n`` samples of a strip."""
    work, tables, lanes, state = room[1], room[2], room[3], room[4]
    re, im = tables[g, 0], tables[g, 1]
    if state[g, CHIRP] == 0.0:
        add_parked(work[SAMPLES], n, block, re, im, state[g])
    else:
        add_moving(
            work[SAMPLES], n, block, re, im, state[g],
            lanes[g, 0], lanes[g, 1], lanes[g, 2], lanes[g, 3], work[V_ROW], work[V_ROW + 1],
        )  # fmt: skip


@kernel(f"void({ROOM}, int64, int64, int64, float64, float64)")
def add_blended_group(room: Room, g: int, n: int, block: int, u: float, per_block: float) -> None:
    """Add a blended group to the first ``n`` samples of a strip, which starts ``u`` into the segment."""
    work, tables, lanes, state = room[1], room[2], room[3], room[4]
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


@kernel(f"boolean(int64, int64, float64, {ROOM})")
def has_period(n_groups: int, block: int, length: float, room: Room) -> bool:
    """Whether all blocks of a segment are the same: its tones are parked, on whole cycles per block."""
    for g in range(n_groups):
        cycles = room[4][g, FREQUENCY] * block
        if room[4][g, CHIRP] != 0.0 or abs(cycles - np.rint(cycles)) * length > ON_TOOTH * block:
            return False
    return True


@kernel(f"void({AXIS}, int64, int64, int16[::1], {ROOM})")
def render_comb(axis: Axis, i: int, skip: int, out: NDArray[np.int16], room: Room) -> None:
    """Render a stretch of segment ``i``.

    It is worked out strip by strip, each from its start, so that a sample does not depend
    on the stretch.

    Args:
        axis: The axis.
        i: The segment, on the comb or blended.
        skip: Samples of the segment before the stretch.
        out: Result, int16 (n,).
        room: Room to work in.
    """
    _, offsets, _, path, _, _, _, _, delta, lengths, _, block = axis
    work, lanes, state = room[1], room[3], room[4]
    shared, first, last = envelope(axis[0], offsets[i], offsets[i + 1])
    blended, length = path[i] == BLENDED, lengths[i]
    slope = (last - first) / length
    n_groups = axis[5][offsets[i] : offsets[i + 1]].max() + 1
    for g in range(n_groups):
        fill_group(axis, i, g, shared, blended, room)
    if blended:
        for j in range(block):
            work[WITHIN, j] = np.float32(j / length)
    if first == last and not blended and has_period(n_groups, block, length, room):
        work[SAMPLES, :block] = np.float32(0.0)
        for g in range(n_groups):
            enter_block(state[g], lanes[g], delta[i], float(block))
            add_group(room, g, block, block)
        store(room[8], block, work[SAMPLES], 0)
        repeat(out, skip, room[8], block)
        return
    strip = strip_samples(block)
    for s in range(skip // strip, (skip + len(out) - 1) // strip + 1):
        x = s * strip + delta[i]
        start, stop = max(0, skip - s * strip), min(strip, skip + len(out) - s * strip)
        work[SAMPLES, :stop] = np.float32(0.0)
        for g in range(n_groups):
            enter_block(state[g], lanes[g], x, float(block))
            if blended:
                add_blended_group(room, g, stop, block, x / length, block / length)
            else:
                add_group(room, g, stop, block)
        if first != last:
            apply_envelope(work[SAMPLES], stop, first + slope * x, slope)
        store(out[s * strip + start - skip :], stop - start, work[SAMPLES], start)
