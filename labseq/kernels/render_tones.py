"""The kernel that takes the tones of an axis over, and refuses what cannot be played."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel
from labseq.kernels.render_paths import END, END_AMPLITUDE, PHASE, START, START_AMPLITUDE

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

N_FIELDS: Final = 5
SUM: Final = 5
"""Amplitudes that add up to more than full scale, beside the fields of :mod:`labseq.kernels.render_paths`."""
FINE: Final = -1

ROUNDING: Final = 1e-9
"""By how much amplitudes may exceed full scale."""

VALUES: Final = const("float64", 1)


@kernel(
    f"UniTuple(int64, 2)({VALUES}, {VALUES}, {VALUES}, {VALUES}, {VALUES}, {const('int32', 1)}, float64,"
    " float64[:, ::1])"
)
def take_tones(
    start_hz: Floats,
    end_hz: Floats,
    start_amplitude: Floats,
    end_amplitude: Floats,
    phase_rad: Floats,
    offsets: Ints,
    sample_rate_hz: float,
    tones: Floats,
) -> tuple[int, int]:
    """Bring the tones of an axis into the units of rendering.

    Args:
        start_hz: See :class:`labseq.model.AxisTones`, as for the next five.
        end_hz: See there.
        start_amplitude: See there.
        end_amplitude: See there.
        phase_rad: See there.
        offsets: See there.
        sample_rate_hz: Sample rate.
        tones: Result, float64 (5, n_tones), see :mod:`labseq.kernels.render_paths`.

    Returns:
        What is wrong, a field or SUM (FINE: nothing is), and the first tone or segment where it is.
    """
    half_hz, most = 0.5 * sample_rate_hz, 1.0 + ROUNDING
    for i in range(len(offsets) - 1):
        first = last = 0.0
        for k in range(offsets[i], offsets[i + 1]):
            if not 0.0 <= start_hz[k] <= half_hz:
                return START, k
            if not 0.0 <= end_hz[k] <= half_hz:
                return END, k
            if not 0.0 <= start_amplitude[k] <= most:
                return START_AMPLITUDE, k
            if not 0.0 <= end_amplitude[k] <= most:
                return END_AMPLITUDE, k
            if not np.isfinite(phase_rad[k]):
                return PHASE, k
            tones[START, k] = start_hz[k] / sample_rate_hz
            tones[END, k] = end_hz[k] / sample_rate_hz
            tones[START_AMPLITUDE, k] = start_amplitude[k]
            tones[END_AMPLITUDE, k] = end_amplitude[k]
            tones[PHASE, k] = phase_rad[k] / (2.0 * np.pi)
            first += start_amplitude[k]
            last += end_amplitude[k]
        if max(first, last) > most:
            return SUM, i
    return FINE, -1
