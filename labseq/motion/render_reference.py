"""Defines the samples of a tone program in a few lines of numpy.

This is slow. Tests and benchmark compare :func:`labseq.render` with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.model import AxisTones, FrequencyCourse, ToneProgram


def render_reference(
    program: ToneProgram, sample_rate_hz: float, start: int = 0, stop: int | None = None
) -> NDArray[np.float64]:
    """Compute samples in float64, before rounding.

    Args:
        start: First sample.
        stop: The sample after the last. By default the end of the program.

    Returns:
        float64 (2, stop - start), 32767 at full scale. Channel 0 plays the row tones.
    """
    starts = np.concatenate([[0.0], np.cumsum(program.duration_s)]) * sample_rate_hz
    first = np.rint(starts).astype(np.int64)
    stop = int(first[-1]) if stop is None else stop
    out = np.zeros((2, stop - start))
    for i in range(program.n_segments):
        low, high = max(start, int(first[i])), min(stop, int(first[i + 1]))
        if low >= high:
            continue
        time_s = (np.arange(low, high) - starts[i]) / sample_rate_hz
        for channel, axis in enumerate((program.row, program.column)):
            out[channel, low - start : high - start] = segment_reference(program, axis, i, time_s)
    return out


def segment_reference(
    program: ToneProgram, axis: AxisTones, i: int, time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum the tones of one segment of an axis at times since its start."""
    tones = slice(axis.offsets[i], axis.offsets[i + 1])
    duration_s = program.duration_s[i]
    u = time_s / duration_s
    whole = duration_s * integral(int(program.course[i]), u)
    out = np.zeros(len(time_s))
    for start_hz, end_hz, a, b, phase_rad in zip(
        axis.start_hz[tones],
        axis.end_hz[tones],
        axis.start_amplitude[tones],
        axis.end_amplitude[tones],
        axis.phase_rad[tones],
        strict=True,
    ):
        cycles = (start_hz * time_s) % 1.0 + ((end_hz - start_hz) * whole) % 1.0
        amplitude = np.sqrt(np.maximum(0.0, a**2 + (b**2 - a**2) * u))
        out += 32767.0 * amplitude * np.cos(phase_rad + 2 * np.pi * cycles)
    return out


def integral(course: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral of a :class:`labseq.model.FrequencyCourse` from 0 to u."""
    if course == FrequencyCourse.MINIMUM_JERK:
        return 2.5 * u**4 - 3.0 * u**5 + u**6
    if course == FrequencyCourse.CONSTANT_JERK:
        return u**3 - 0.5 * u**4
    return 0.5 * u**2
