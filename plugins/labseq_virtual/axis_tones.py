"""The tones of an axis in the world's own terms: places, powers, light."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import AxisTones, MotionSpec, SiteGrid

Floats = NDArray[np.float64]

MIXING: Final = 0.5
"""Distance of two tones, in sites, below which their tweezers are one."""
AT_REST: Final = 1e-6
"""Motion in a segment, in sites, below which a tweezer stands still."""

START, END, POWER_START, POWER_END, ON_START, ON_END = range(6)
"""Columns of a table of tones: places at start and end in sites, powers over those meant, light (1, 0)."""
DARK, NEW, EMPTY, HELD = range(4)
"""What a crossing of two tones is: without light, just come on, without an atom, with one."""


def tone_table(axis: AxisTones, start: Floats, end: Floats, full: Floats, on_amplitude: float) -> Floats:
    """The tones of all segments, float64 (n_tones, 6), with the columns above.

    Args:
        axis: The axis of a program.
        start: float64 (n_tones,), places at the start of the tones' segments, in sites.
        end: float64 (n_tones,), places at the end.
        full: float64 (n_sites,), amplitude that is meant to give the full depth.
        on_amplitude: Amplitude above which a tone makes light.
    """
    sites = np.arange(len(full))
    table = np.empty((len(start), 6))
    table[:, START], table[:, END] = start, end
    table[:, POWER_START] = (axis.start_amplitude / np.interp(start, sites, full)) ** 2
    table[:, POWER_END] = (axis.end_amplitude / np.interp(end, sites, full)) ** 2
    table[:, ON_START], table[:, ON_END] = (
        axis.start_amplitude > on_amplitude,
        axis.end_amplitude > on_amplitude,
    )
    return table


def full_amplitudes(grid: SiteGrid, motion: MotionSpec) -> tuple[Floats, Floats]:
    """Amplitudes of the tones that are meant to give the full depth: rows' and columns', one per site."""
    rf = motion.rf
    given = (rf.row_amplitudes, rf.column_amplitudes)
    most = (motion.max_row_tones, motion.max_column_tones)
    rows, cols = (np.array(given[axis] or [1 / most[axis]] * n) for axis, n in enumerate(grid.shape))
    return rows, cols
