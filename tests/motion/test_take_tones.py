from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.motion import render_kernels
from labseq.motion.render_kernels import (
    END,
    END_AMPLITUDE,
    FINE,
    N_FIELDS,
    PHASE,
    START,
    START_AMPLITUDE,
    SUM,
    take_tones,
)

RATE_HZ = 625e6
OFFSETS = np.array([0, 2, 2, 5], np.int32)


def take(**changes: tuple[int, float]) -> tuple[tuple[int, int], NDArray[np.float64]]:
    """Five tones, of which some values are changed: field -> (tone, value)."""
    names = ("start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad")
    fields = [np.full(5, value) for value in (90e6, 91e6, 0.3, 0.1, 2.0)]
    for name, (tone, value) in changes.items():
        fields[names.index(name)][tone] = value
    start_hz, end_hz, start, end, phase = fields
    tones = np.empty((N_FIELDS, 5))
    return take_tones(start_hz, end_hz, start, end, phase, OFFSETS, RATE_HZ, tones), tones


def test_tones_are_brought_into_cycles_and_samples() -> None:
    fault, tones = take()
    assert fault == (FINE, -1)
    assert tones[START].tolist() == [90e6 / RATE_HZ] * 5
    assert tones[END].tolist() == [91e6 / RATE_HZ] * 5
    assert tones[START_AMPLITUDE].tolist() == [0.3] * 5
    assert tones[END_AMPLITUDE].tolist() == [0.1] * 5
    assert tones[PHASE].tolist() == [2.0 / (2 * np.pi)] * 5


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("start_hz", START),
        ("end_hz", END),
        ("start_amplitude", START_AMPLITUDE),
        ("end_amplitude", END_AMPLITUDE),
        ("phase_rad", PHASE),
    ],
)
def test_what_is_not_finite_is_found(name: str, field: int, value: float) -> None:
    assert take(**{name: (3, value)})[0] == (field, 3)


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("start_hz", -1.0, (START, 1)),
        ("end_hz", RATE_HZ / 2 + 1.0, (END, 1)),
        ("end_hz", RATE_HZ / 2, (FINE, -1)),
        ("start_amplitude", -0.1, (START_AMPLITUDE, 1)),
        ("end_amplitude", 1.1, (END_AMPLITUDE, 1)),
        ("start_amplitude", 0.8, (SUM, 0)),
        ("end_amplitude", 0.9 + render_kernels.ROUNDING / 2, (FINE, -1)),
        ("end_amplitude", 0.9 + 2 * render_kernels.ROUNDING, (SUM, 0)),
        ("phase_rad", -700.0, (FINE, -1)),
    ],
)
def test_limits_are_kept(name: str, value: float, fault: tuple[int, int]) -> None:
    assert take(**{name: (1, value)})[0] == fault


def test_a_sum_is_blamed_on_its_segment() -> None:
    assert take(start_amplitude=(4, 0.5))[0] == (SUM, 2)
