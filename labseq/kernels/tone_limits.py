"""Kernels that hold the tones of an axis against what its AOD and amplifier bear."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.tone_build import END_AMPLITUDE, END_HZ, START_AMPLITUDE, START_HZ

Floats = NDArray[np.float64]
Offsets = NDArray[np.int32]

WITHIN: Final = 0
BAND: Final = 1
SPACING: Final = 2
AMPLITUDES: Final = 3
POWER: Final = 4

HALVINGS: Final = 40
VALUES: Final = "float64[:, ::1]"


@kernel(f"UniTuple(float64, 2)({VALUES}, int64, int64, float64)")
def amplitudes_at(values: Floats, first: int, last: int, u: float) -> tuple[float, float]:
    """Sum of the amplitudes of some tones at a fraction of their segment, and the sign of its slope."""
    total = slope = 0.0
    for i in range(first, last):
        start, end = values[START_AMPLITUDE, i] ** 2, values[END_AMPLITUDE, i] ** 2
        now = np.sqrt(start + (end - start) * u)
        total += now
        if now > 0.0:
            slope += (end - start) / now
    return total, slope


@kernel(f"float64({VALUES}, int64, int64, float64)")
def greatest_sum(values: Floats, first: int, last: int, limit: float) -> float:
    """The greatest sum that amplitudes reach in a segment; exact only where it exceeds ``limit``.

    Amplitudes squared are linear in time, so the sum is concave: where some rise and others
    fall, it may be greatest in between, where its slope is 0.
    """
    at_start = at_end = bound = 0.0
    for i in range(first, last):
        start, end = values[START_AMPLITUDE, i], values[END_AMPLITUDE, i]
        at_start += start
        at_end += end
        bound += max(start, end)
    if bound <= limit:
        return bound
    most = max(at_start, at_end)
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        u = 0.5 * (low + high)
        total, slope = amplitudes_at(values, first, last, u)
        most = max(most, total)
        if slope > 0.0:
            low = u
        else:
            high = u
    return most


@kernel(f"Tuple((int64, int64, float64))({const('int32', 1)}, {VALUES}, {const('float64', 1)})")
def first_excess(offsets: Offsets, values: Floats, limits: Floats) -> tuple[int, int, float]:
    """Find the first tone of an axis that breaks a limit.

    Frequencies all follow the same course in a segment, so the distance of two tones is
    least at its start or its end, unless they pass one another; then its sign changes.
    The power is linear in time, so it is greatest at the start or the end.

    Args:
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        values: float64 (5, n_tones), see :mod:`labseq.kernels.tone_build`.
        limits: float64 (6,): lowest and highest frequency, least spacing, 1 or -1 where
            frequencies rise or fall from tone to tone, greatest sum of the amplitudes, greatest
            sum of their squares.

    Returns:
        The limit (WITHIN: none is broken), the tone, which is a segment's first where all
        its tones are at fault, and the value that came.
    """
    low_hz, high_hz, spacing_hz, direction = limits[0], limits[1], limits[2], limits[3]
    for segment in range(len(offsets) - 1):
        first, last = offsets[segment], offsets[segment + 1]
        power_start = power_end = 0.0
        for i in range(first, last):
            for end in (START_HZ, END_HZ):
                hz = values[end, i]
                if not low_hz <= hz <= high_hz:
                    return BAND, i, hz
                if i > first:
                    gap = direction * (hz - values[end, i - 1])
                    if not gap >= spacing_hz:
                        return SPACING, i, gap
            power_start += values[START_AMPLITUDE, i] ** 2
            power_end += values[END_AMPLITUDE, i] ** 2
        total = greatest_sum(values, first, last, limits[4])
        if not total <= limits[4]:
            return AMPLITUDES, first, total
        power = max(power_start, power_end)
        if not power <= limits[5]:
            return POWER, first, power
    return WITHIN, -1, 0.0
