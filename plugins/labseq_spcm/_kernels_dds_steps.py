"""How a segment is cut into steps in which frequencies and amplitudes are near enough to linear."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, kernel

Reals = NDArray[np.float64]

TICK_S: Final = 6.4e-9
"""Resolution of the DDS timer."""
MIN_TICKS: Final = 13
"""Shortest time between two blocks: 83.2 ns."""
RAMP_STEPS: Final = 8
"""The depth is within 1 / (4 n^2) of linear: 0.4 % of the full depth."""
COURSE_STEPS: Final = 16
"""The frequency is within 0.3 % of its way."""

TONES: Final = const("float64", 2)
START_HZ, END_HZ, START, END, TURNS = 0, 1, 2, 3, 4
"""Rows of an axis' tones; the phase in turns."""


@kernel("float64(int64, float64)")
def course_at(course: int, u: float) -> float:
    """:meth:`labseq.model.FrequencyCourse.fraction`."""
    if course == 0:
        return u
    if course == 1:
        return u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    v = min(u, 1.0 - u)
    s = 16.0 / 3.0 * v**3 if v <= 0.25 else 1.0 / 6.0 - 2.0 * v + 8.0 * v * v - 16.0 / 3.0 * v**3
    return s if u <= 0.5 else 1.0 - s


@kernel(f"float64({TONES}, int64, float64)")
def amplitude_at(tones: Reals, tone: int, u: float) -> float:
    """Amplitude of a tone whose square goes linearly."""
    start, end = tones[START, tone], tones[END, tone]
    return np.sqrt(start * start + (end * end - start * start) * min(1.0, max(0.0, u)))


@kernel(f"void({TONES}, int64, int64, float64[::1])")
def widest_ramp(tones: Reals, first: int, last: int, widest: Reals) -> None:
    """Keep the amplitudes, start and end, of the tone that changes most."""
    for tone in range(first, last):
        start, end = tones[START, tone], tones[END, tone]
        if abs(end - start) > abs(widest[1] - widest[0]):
            widest[0], widest[1] = start, end


@kernel("int64(float64[::1], int64, float64, float64[::1])")
def cut(widest: Reals, course: int, duration_s: float, knots: Reals) -> int:
    """Where a segment is cut into steps, as fractions of its duration; returns how many steps."""
    start, end = widest[0], widest[1]
    room = duration_s / ((MIN_TICKS + 1) * TICK_S)
    if abs(end - start) > 0.05 * max(start, end):
        n_steps = max(1, min(RAMP_STEPS, int(np.sqrt(room))))
        for k in range(n_steps + 1):
            a = start + (end - start) * k / n_steps
            knots[k] = (a * a - start * start) / (end * end - start * start)
        return n_steps
    n_steps = 1 if course == 0 else max(1, min(COURSE_STEPS, int(room)))
    for k in range(n_steps + 1):
        knots[k] = k / n_steps
    return n_steps
