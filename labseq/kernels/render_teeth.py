"""Kernels that find the comb on whose teeth the tones of an axis stand."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.compile import const, kernel

Floats = NDArray[np.float64]

MAX_TEETH: Final = 64

MAX_TONES: Final = 4 * MAX_TEETH
"""Most frequencies among which a comb is looked for."""

TOLERANCE_HZ: Final = 100.0
"""Tones nearer than this to a tooth count as standing on it when the comb is looked for."""

GRAIN_HZ: Final = 10.0
"""Spacings are tried out in steps of this."""

F64: Final = "float64[::1]"
CONST: Final = const("float64", 1)


@kernel(f"int64({CONST}, {F64})")
def distinct_tones(start_hz: Floats, distinct_hz: Floats) -> int:
    """Collect the frequencies of some tones, each once, to 1 Hz, in rising order.

    Args:
        start_hz: float64 (n_tones,).
        distinct_hz: Result, float64 (MAX_TONES,).

    Returns:
        How many there are; -1 if they are more.
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


@kernel(f"Tuple((int64, float64))({CONST}, float64)")
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
    """Find the largest spacing of which most gaps between tones are a multiple.

    Tried are the gaps and the differences of any two.

    Args:
        tones_hz: float64 (n,), rising.

    Returns:
        The spacing in Hz; 0 if there is one tone only, -1 if there are too many for a comb.
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


@kernel(f"void({CONST}, {CONST}, int64, float64[:, ::1])")
def fill_teeth(cosine: Floats, sine: Floats, numerator: int, teeth: Floats) -> None:
    """Fill in the cosine and the sine of each tooth's distance from the first over a period.

    Args:
        cosine: float64 (period,), of one turn in steps of 1 / period.
        sine: float64 (period,).
        numerator: Turns per period from one tooth to the next.
        teeth: Result, float64 (2 n_teeth, period).
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
