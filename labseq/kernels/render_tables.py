"""Kernels that fill the tables of a comb: see :mod:`labseq.kernels.render_comb`."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Complex = tuple[float, float]

LANES: Final = 32
"""Samples that are worked on together."""

N_CHIRPS: Final = 8
"""Chirps that are kept: to the right, to the left and parked, on two axes, and two to spare."""

FREQUENCY_GRID: Final = 2.0**44
CHIRP_GRID: Final = 2.0**62

F32: Final = "float32[::1]"
F64: Final = "float64[::1]"


@kernel("UniTuple(float64, 2)(float64)")
def turn(cycles: float) -> Complex:
    """Cosine and sine of a phase in cycles."""
    phase = 2.0 * math.pi * (cycles - np.rint(cycles))
    return math.cos(phase), math.sin(phase)


@kernel("UniTuple(float64, 2)(float64, float64, float64, float64)", fused=True)
def times(a_re: float, a_im: float, b_re: float, b_im: float) -> Complex:
    """Product of two complex numbers."""
    return a_re * b_re - a_im * b_im, a_re * b_im + a_im * b_re


@kernel(f"void(float64, {F64}, {F64})")
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


@kernel(f"void({const('float64', 1)}, {const('float64', 1)}, float64, float64, {F64}, {F64})", fused=True)
def add_tooth(
    cosine: Floats, sine: Floats, weight_re: float, weight_im: float, re: Floats, im: Floats
) -> None:
    """Add a tone to the sum over a period.

    Args:
        cosine: float64 (n,), of its tooth over a period.
        sine: float64 (n,).
        weight_re: Amplitude and phase of the tone.
        weight_im: Their imaginary part.
        re: float64 (>= n,), the sum so far; updated.
        im: Its imaginary part.
    """
    for j in range(len(cosine)):
        re[j] += weight_re * cosine[j] - weight_im * sine[j]
        im[j] += weight_re * sine[j] + weight_im * cosine[j]


@kernel(f"void(float64, float64, int64, {F32}, {F32}, float64[:, ::1])", fused=True)
def fill_chirp(frequency: float, chirp: float, n: int, re: Singles, im: Singles, lanes: Floats) -> None:
    """Fill in exp 2 pi i (frequency j + chirp j^2 / 2), j = 0 ... n - 1.

    Args:
        frequency: In cycles per sample.
        chirp: In cycles per sample squared.
        n: How many samples.
        re: Result, float32 (>= n + LANES,).
        im: Its imaginary part.
        lanes: Scratch, float64 (4, >= LANES).
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


@kernel(f"int64(float64, float64, int64, float32[:, :, ::1], {F64}, float64[:, ::1])")
def find_chirp(frequency: float, chirp: float, n: int, chirps: Singles, keys: Floats, lanes: Floats) -> int:
    """Find or fill in exp 2 pi i (frequency j + chirp j^2 / 2), which many segments share.

    Args:
        frequency: In cycles per sample; rounded to a grid that makes no difference in a block.
        chirp: In cycles per sample squared; likewise.
        n: Samples of a block.
        chirps: float32 (N_CHIRPS, 2, >= n + LANES), those that there are; updated.
        keys: float64 (2 N_CHIRPS + 1,), frequency and chirp of each, and how often one was filled in.
        lanes: Scratch, see :func:`fill_chirp`.

    Returns:
        Where in ``chirps`` it is.
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


@kernel(f"void({F64}, {F64}, int64, {F32}, {F32}, int64, {F32}, {F32})", fused=True)
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
