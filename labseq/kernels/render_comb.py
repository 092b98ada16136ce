"""Kernels that sum the tones of a comb at a cost per sample that does not grow with their number.

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

from labseq.kernels.compile import const, kernel
from labseq.kernels.render_tables import F32, F64, LANES, fill_powers, multiply, times, turn

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

FREQUENCY: Final = 0  # of a group's state: nu, gamma, A_b, A_(b+1) / A_b, and what that changes by
CHIRP: Final = 1
NOW: Final = 2
STEP: Final = 4
STEP_OF_STEP: Final = 6
N_STATE: Final = 8


@kernel(f"void({F64}, float64[:, ::1], float64, float64)")
def enter_block(state: Floats, lanes: Floats, x: float, length: float) -> None:
    """Prepare a group for a block.

    Args:
        state: float64 (N_STATE,), its frequency and chirp given.
        lanes: Result, float64 (4, LANES + 1), exp 2 pi i g_b r, and what it is
            multiplied by from block to block.
        x: Start of the block, in samples from the start of the segment.
        length: Length of a block.
    """
    frequency, chirp = state[FREQUENCY], state[CHIRP]
    state[NOW], state[NOW + 1] = turn(frequency * x + 0.5 * chirp * x * x)
    state[STEP], state[STEP + 1] = turn((frequency + chirp * (x + 0.5 * length)) * length)
    state[STEP_OF_STEP], state[STEP_OF_STEP + 1] = turn(chirp * length * length)
    fill_powers(chirp * x, lanes[0], lanes[1])
    fill_powers(chirp * length, lanes[2], lanes[3])


@kernel(f"void({F32}, int64, int64, {F32}, {F32}, {F64})", fused=True)
def add_parked(acc: Singles, n: int, block: int, re: Singles, im: Singles, state: Floats) -> None:
    """Add a group that stands still to ``n`` samples, and bring its state to the block after.

    Args:
        acc: float32 (>= n,), from the start of a block; updated.
        n: How many samples.
        block: Samples of a block.
        re: float32 (>= block,), the group's table.
        im: Its imaginary part.
        state: float64 (N_STATE,), the group's state.
    """
    x, y = state[NOW], state[NOW + 1]
    for b in range((n + block - 1) // block):
        part = acc[b * block :]
        now_re, now_im = np.float32(x), np.float32(y)
        for j in range(min(block, n - b * block)):
            part[j] += re[j] * now_re - im[j] * now_im
        x, y = times(x, y, state[STEP], state[STEP + 1])
    state[NOW], state[NOW + 1] = x, y


@kernel(f"void({F32}, int64, {F32}, {F32}, float64, float64, float64, float64, {F32}, {F32})", fused=True)
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
    """Add a group that moves to ``n`` samples of one block; see :func:`add_moving`."""
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


@kernel(
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
    """Add a group that moves to ``n`` samples, and bring its state to the block after.

    Args:
        acc: See :func:`add_parked`.
        n: See there.
        block: See there.
        re: See there.
        im: See there.
        state: See there.
        lane_re: float64 (LANES + 1,), cosine of g_b r; updated.
        lane_im: Its sine.
        by_re: What they are multiplied by from block to block.
        by_im: Its imaginary part.
        v_re: Scratch, float32 (>= LANES,): the lanes less 1, of which float32 holds more digits.
        v_im: Their imaginary part.
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


@kernel(f"void(float32[:, ::1], int64, float64, {const('float32', 1)}, {F32}, {F32})", fused=True)
def blend(tables: Singles, n: int, u: float, within: Singles, re: Singles, im: Singles) -> None:
    """Blend four tables into one by a cubic in the time since the start of the segment.

    Args:
        tables: float32 (8, >= n), real and imaginary part of the coefficient of each power.
        n: How many samples.
        u: Fraction of the segment that has passed at the start of the block.
        within: float32 (>= n,), fraction of it that passes from there to each sample.
        re: Result, float32 (>= n,).
        im: Its imaginary part.
    """
    first = np.float32(u)
    for part, out in ((0, re), (1, im)):
        c0, c1, c2, c3 = tables[part], tables[part + 2], tables[part + 4], tables[part + 6]
        for j in range(n):
            t = first + within[j]
            out[j] = c0[j] + t * (c1[j] + t * (c2[j] + t * c3[j]))
