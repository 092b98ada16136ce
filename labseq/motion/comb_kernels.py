"""Kernels that look for an equally spaced comb among the tones of an axis."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, helper_kernel, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

MAX_TEETH: Final = 64

MAX_TONES: Final = 4 * MAX_TEETH
"""Maximum number of frequencies in the search for a comb."""

TOLERANCE_HZ: Final = 100.0
"""Tones closer than this to a tooth count as on it in the search for a comb, in Hz."""

ENOUGH: Final = 2 / 3
"""A comb's spacing has to fit this fraction of the largest number of gaps that any spacing fits."""

MIN_SPACING_HZ: Final = 5e4
"""Least spacing of a comb in the search, in Hz."""

GRAIN_HZ: Final = 10.0
"""Step of the spacings tried in the search, in Hz."""

CONST: Final = const("float64", 1)

MAX_GAPS: Final = 24
"""Maximum number of different gaps that are looked at."""


@helper_kernel("UniTuple(int64, 2)(float64[:, ::1], int64, float64)")
def insert(values: Floats, n: int, hz: float) -> tuple[int, int]:
    """Count a value, to 1 Hz, among ``n`` rising ones.

    Args:
        values: float64 (2, n_most), values and how often each came. Updated. A new value without room is left
            out.
        n: Number of values.

    Returns:
        The new number of values, one more than there is room for if it was left out, and its place.
    """
    hz = np.rint(hz)
    at = int(np.searchsorted(values[0, :n], hz))
    if at < n and values[0, at] == hz:
        values[1, at] += 1.0
        return n, at
    if n < values.shape[1]:
        for i in range(n, at, -1):
            values[0, i], values[1, i] = values[0, i - 1], values[1, i - 1]
        values[0, at], values[1, at] = hz, 1.0
    return n + 1, at


@kernel(f"int64({CONST}, float64[:, ::1])")
def count_tones(start_hz: Floats, values: Floats) -> int:
    """Collect the different frequencies of some tones, to 1 Hz, in rising order.

    Returns their number, or -1 if they are more than ``values``, float64 (2, n_most), can hold.
    """
    n = 0
    for k in range(len(start_hz)):
        n, _ = insert(values, n, start_hz[k])
        if n > values.shape[1]:
            return -1
    return n


@kernel(f"int64({CONST}, {CONST}, {const('int32', 1)}, float64[:, ::1])")
def count_gaps(start_hz: Floats, end_hz: Floats, offsets: Ints, values: Floats) -> int:
    """Collect the different gaps between neighbours that go the same way in a segment, in rising order.

    Returns their number, at most as many as ``values``, float64 (2, n_most), can hold.
    """
    n, at, latest = 0, 0, -1.0
    for i in range(len(offsets) - 1):
        for k in range(offsets[i] + 1, offsets[i + 1]):
            m, way = k - 1, end_hz[k] - start_hz[k]
            while m >= offsets[i] and abs(end_hz[m] - start_hz[m] - way) > 1.0:
                m -= 1
            gap = abs(start_hz[k] - start_hz[m])
            if m < offsets[i]:
                continue
            if gap == latest:
                values[1, at] += 1.0
                continue
            n, at = insert(values, n, gap)
            n, latest = min(n, values.shape[1]), values[0, min(at, values.shape[1] - 1)]
    return n


@helper_kernel("Tuple((float64, float64))(float64[:, :], float64)")
def count_multiples(gaps: Floats, spacing_hz: float) -> tuple[float, float]:
    """Count the gaps that are a multiple of a spacing, and find the spacing that fits these gaps best."""
    n, gap_hz, multiples = 0.0, 0.0, 0.0
    for i in range(gaps.shape[1]):
        multiple = np.rint(gaps[0, i] / spacing_hz)
        if multiple > 0.0 and abs(gaps[0, i] - multiple * spacing_hz) <= TOLERANCE_HZ:
            n += gaps[1, i]
            gap_hz += gaps[1, i] * gaps[0, i]
            multiples += gaps[1, i] * multiple
    return n, gap_hz / multiples if n > 0.0 else 0.0


@helper_kernel("float64(float64, float64)")
def common_measure(a: float, b: float) -> float:
    """Greatest common divisor of two frequencies, by Euclid's algorithm."""
    while b > MIN_SPACING_HZ:
        a, b = b, abs(a - b * np.rint(a / b))
    return a


@kernel("float64(float64[:, :])")
def common_spacing(gaps: Floats) -> float:
    """Find the largest spacing, in Hz, that divides two thirds of as many gaps as any spacing divides.

    Candidates are the gaps and the common measures of any two. Returns 0 if there is no gap, -1 if
    there are too many for a comb.

    Args:
        gaps: float64 (2, n), gaps and how often each came.
    """
    gaps = gaps[:, gaps[0] > TOLERANCE_HZ]
    n_gaps = gaps.shape[1]
    if n_gaps == 0:
        return 0.0
    if n_gaps >= MAX_TEETH:
        return -1.0
    most, tried, best = 0.0, 0.0, 0.0
    for enough in (False, True):  # first how many fit at most
        for i in range(n_gaps):
            for j in range(i, n_gaps):
                candidate = GRAIN_HZ * np.rint(common_measure(gaps[0, j], gaps[0, i]) / GRAIN_HZ)
                if candidate <= TOLERANCE_HZ or (enough and candidate <= tried):
                    continue
                n, spacing = count_multiples(gaps, candidate)
                if enough and n >= ENOUGH * most:
                    tried, best = candidate, spacing
                most = max(most, n)
    return best


@kernel(f"void({CONST}, {CONST}, {const('int32', 1)}, float64[::1])")
def find_spacing(start_hz: Floats, end_hz: Floats, offsets: Ints, comb_hz: Floats) -> None:
    """Look for a comb of tones that go the same way in a segment, or of all tones if no two do.

    ``comb_hz``, float64 (3,), is its spacing (see :func:`common_spacing`), the lowest tone, and the distance
    of the highest.
    """
    comb_hz[0] = -1.0
    if len(start_hz) == 0:
        return
    comb_hz[1], comb_hz[2] = start_hz.min(), start_hz.max() - start_hz.min()
    gaps = np.empty((2, MAX_GAPS))
    n = count_gaps(start_hz, end_hz, offsets, gaps)
    if n == 0:
        found = np.empty((2, MAX_TONES))
        n = count_tones(start_hz, found) - 1
        if n < 0:
            return
        gaps = np.ones((2, n))
        gaps[0] = found[0, 1 : n + 1] - found[0, :n]
    comb_hz[0] = common_spacing(gaps[:, :n])


@kernel(f"void({CONST}, {CONST}, int64, int64, float64[:, ::1])")
def fill_teeth(cosine: Floats, sine: Floats, numerator: int, first: int, teeth: Floats) -> None:
    """Fill in cosine and sine of each tooth of the comb of 0 Hz, from number ``first``, over a period.

    The result is float64 (2 n_teeth, period). ``cosine`` and ``sine``, float64 (period,), cover one turn in
    steps of 1 / period. ``numerator`` is the number of turns per period from one tooth to the next.
    """
    period = len(cosine)
    for tooth in range(len(teeth) // 2):
        step, at = (first + tooth) * numerator % period, 0
        for j in range(period):
            teeth[2 * tooth, j] = cosine[at]
            teeth[2 * tooth + 1, j] = sine[at]
            at += step
            if at >= period:
                at -= period
