"""Kernels for the last steps of every block: the envelope, and rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import kernel
from labseq.kernels.render_tables import LANES
from labseq.kernels.render_types import FULL_SCALE

Singles = NDArray[np.float32]


@kernel("void(int16[::1], int64, float32[::1], int64)")
def store(out: NDArray[np.int16], n: int, values: Singles, skip: int) -> None:
    """Round ``values[skip:skip + n]`` to integers; by way of int32, which is four times faster."""
    most = np.float32(FULL_SCALE)
    kept = values[skip:]
    for j in range(n):
        out[j] = np.int16(np.int32(np.rint(min(max(kept[j], -most), most))))


@kernel("void(int16[::1], int64, int16[::1], int64)")
def repeat(out: NDArray[np.int16], skip: int, block: NDArray[np.int16], n: int) -> None:
    """Fill ``out`` with the ``n`` samples of a block again and again, from sample ``skip`` on."""
    at = skip % n
    done = 0
    while done < len(out):
        length = min(n - at, len(out) - done)
        part, again = out[done:], block[at:]
        for j in range(length):
            part[j] = again[j]
        done += length
        at = 0


@kernel("void(float32[::1], int64, float64, float64)", fused=True)
def apply_envelope(values: Singles, n: int, start: float, slope: float) -> None:
    """Multiply by an amplitude whose square changes linearly from sample to sample.

    Args:
        values: float32 (>= n rounded up to a multiple of LANES,), changed in place.
        n: How many.
        start: Squared amplitude at the first; below 0 counts as 0.
        slope: Its change from each to the next.
    """
    by = np.float32(slope)
    for q in range((n + LANES - 1) // LANES):
        at = q * LANES
        first = np.float32(start + slope * at)
        for r in range(LANES):
            values[at + r] *= np.sqrt(max(np.float32(0.0), first + by * np.float32(r)))
