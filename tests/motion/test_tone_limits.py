from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from labseq.motion.tone_kernels import (
    AMPLITUDES,
    BAND,
    END_AMPLITUDE,
    END_HZ,
    N_FIELDS,
    POWER,
    SPACING,
    START_AMPLITUDE,
    START_HZ,
    WITHIN,
    first_excess,
    greatest_sum,
)

LIMITS = np.array([80.0, 120.0, 2.0, 1.0, 1.0, 0.3])
AMPLITUDE = st.floats(0, 0.5)


def tones(*each: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Tones of one segment: frequency and amplitude at its start, and at its end."""
    values = np.zeros((N_FIELDS, len(each)))
    values[[START_HZ, START_AMPLITUDE, END_HZ, END_AMPLITUDE]] = np.array(each).reshape(-1, 4).T
    return values


def excess(*each: tuple[float, float, float, float]) -> tuple[int, int, float]:
    return first_excess(np.array([0, len(each)], np.int32), tones(*each), LIMITS)


@given(st.lists(st.tuples(AMPLITUDE, AMPLITUDE), max_size=6))
def test_the_greatest_sum_of_amplitudes_is_that_of_a_close_look(pairs: list[tuple[float, float]]) -> None:
    values = tones(*((0.0, start, 0.0, end) for start, end in pairs))
    u = np.linspace(0.0, 1.0, 2001)[:, None]
    start, end = values[START_AMPLITUDE] ** 2, values[END_AMPLITUDE] ** 2
    seen = float(np.sqrt(start + (end - start) * u).sum(axis=1).max())
    assert greatest_sum(values, 0, len(pairs), 0.0) == pytest.approx(seen, abs=2e-3)
    assert greatest_sum(values, 0, len(pairs), 0.0) >= seen - 1e-9
    assert greatest_sum(values, 0, len(pairs), 9.0) >= seen - 1e-9


def test_one_tone_that_fades_into_another_is_louder_in_between() -> None:
    assert greatest_sum(tones((0, 1, 0, 0), (0, 0, 0, 1)), 0, 2, 1.0) == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        ([], (WITHIN, -1, 0.0)),
        ([(80, 0.3, 120, 0.3), (100, 0.3, 122, 0.3)], (BAND, 1, 122.0)),
        ([(80, 0.3, 118, 0.3), (100, 0.3, 120, 0.3)], (WITHIN, -1, 0.0)),
        ([(79, 0.3, 90, 0.3)], (BAND, 0, 79.0)),
        ([(math.nan, 0.3, 90, 0.3)], (BAND, 0, math.nan)),
        ([(90, 0.3, 90, 0.3), (91, 0.3, 100, 0.3)], (SPACING, 1, 1.0)),
        ([(90, 0.3, 100, 0.3), (100, 0.3, 90, 0.3)], (SPACING, 1, -10.0)),
        ([(90, 0.1, 90, 0.7), (100, 0.1, 100, 0.4)], (AMPLITUDES, 0, 1.1)),
        ([(90, math.nan, 90, 0.7)], (AMPLITUDES, 0, math.nan)),
        ([(90, 0.1, 90, 0.6)], (POWER, 0, 0.36)),
    ],
)
def test_the_first_excess(
    each: list[tuple[float, float, float, float]], expected: tuple[int, int, float]
) -> None:
    assert excess(*each) == pytest.approx(expected, nan_ok=True)


def test_frequencies_may_fall_from_tone_to_tone() -> None:
    values, falling = tones((100, 0.1, 100, 0.1), (90, 0.1, 90, 0.1)), LIMITS.copy()
    falling[3] = -1.0
    offsets = np.array([0, 2], np.int32)
    assert first_excess(offsets, values, falling)[0] == WITHIN
    assert first_excess(offsets, values, LIMITS)[0] == SPACING
