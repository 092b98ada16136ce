"""Tone programs out of a few numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labseq.model import AxisTones, ToneProgram

STEP_HZ = 1.6e6

Segment = tuple[float, Sequence[tuple[float, float, float, float, float]]]


def program_of(*segments: Segment, course: int = 0, still: bool = True) -> ToneProgram:
    """A program from (duration in s, [(start, end in Hz, start, end amplitude, phase)]) on the row axis.

    The column axis plays the same, or nothing if ``still``.
    """
    tones = np.array([tone for _, tones in segments for tone in tones]).reshape(-1, 5)
    offsets = np.cumsum([0, *(len(tones) for _, tones in segments)]).astype(np.int32)
    row = AxisTones(offsets, *tones.T)
    column = AxisTones(np.zeros_like(offsets), *np.empty((5, 0))) if still else row
    n = len(segments)
    duration_s = np.array([duration_s for duration_s, _ in segments])
    kinds, batches = np.full(n, 2, np.int8), np.arange(n, dtype=np.int32)
    return ToneProgram(row, column, duration_s, kinds, batches, np.full(n, course, np.int8))


def site(index: float) -> float:
    return 84.8e6 + STEP_HZ * index
