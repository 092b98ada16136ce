"""The comb that the tones of an axis stand on, and the sample rates that suit it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import AxisTones, SiteGrid

CLOCK_STEP_HZ: Final = 8
"""Sample rates of the AWG are multiples of this (Spectrum M4i.66xx)."""

MAX_PERIOD: Final = 4096
"""Longest period of a comb, in samples, that is worth its tables."""

BLOCK: Final = 1536
"""Blocks have at least so many samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Comb:
    """The comb of an axis at a sample rate.

    Attributes:
        origin: Frequency of the first tooth, in cycles per sample.
        step: Spacing of the teeth, in cycles per sample; ``step * period`` is whole.
        teeth: float64 (2 n_teeth, period), cosine and sine of each tooth's
            distance from the first; of no length if there is no comb.
        block: Samples that are rendered at a time, a multiple of the period.
    """

    origin: float
    step: float
    teeth: NDArray[np.float64]
    block: int

    @property
    def n_teeth(self) -> int:
        """Number of teeth."""
        return len(self.teeth) // 2


NO_COMB: Final = Comb(0.0, 1.0, np.empty((0, 0)), 1024)


def comb_sample_rate(
    grid: SiteGrid, max_hz: float = 625e6, min_hz: float = 50e6, clock_step_hz: int = CLOCK_STEP_HZ
) -> float:
    """Find the fastest sample rate at which the sites of both axes make a comb of whole samples.

    The sum of tones on a comb of spacing D repeats after fs / D samples. Where that is
    a whole number, on both axes, :func:`labseq.render` is at its fastest.

    Args:
        grid: Its row and column frequencies, equally spaced on each axis.
        max_hz: Fastest sample rate allowed.
        min_hz: Slowest sample rate allowed.
        clock_step_hz: Sample rates are multiples of this.

    Returns:
        The rate in Hz, a whole number of clock steps. If the spacing is no round number
        the teeth miss it by half a clock step divided by fs / D at most, which rendering
        takes into account.

    Raises:
        LimitError: No rate in the range suits both axes.

    Example:
        >>> comb_sample_rate(SiteGrid())
        624000000.0
    """
    steps = [_spacing(grid.row_frequency_hz), _spacing(grid.column_frequency_hz)]
    steps = [step for step in steps if step > 0.0]
    if not steps:
        return max_hz // clock_step_hz * clock_step_hz
    first = max(steps)
    for period in range(int(max_hz / first), int(min_hz / first), -1):
        rate_hz = round(period * first / clock_step_hz) * clock_step_hz
        off = [abs(rate_hz / step - round(rate_hz / step)) * step for step in steps]
        if rate_hz <= max_hz and max(off) <= clock_step_hz:
            return float(rate_hz)
    raise LimitError(
        "the spacing of row and column tones",
        " and ".join(f"{step:.9g} Hz" for step in steps),
        f"what one sample rate from {min_hz:.9g} to {max_hz:.9g} Hz holds a whole number of times",
        "make them equal, or multiples of one another",
    )


def find_comb(axis: AxisTones, sample_rate_hz: float) -> Comb:
    """Find the comb that most tones of an axis stand on, if there is one that suits the sample rate."""
    from labseq.kernels.render_teeth import MAX_TEETH, MAX_TONES, TOLERANCE_HZ, common_spacing, distinct_tones

    tones_hz = np.empty(MAX_TONES)
    n_tones = distinct_tones(axis.start_hz, tones_hz)
    spacing = common_spacing(tones_hz[:n_tones]) if n_tones > 0 else -1.0
    if spacing < 0.0:
        return NO_COMB
    origin = float(axis.start_hz.min()) / sample_rate_hz
    if spacing == 0.0:  # then it may as well be on a tooth of 0 Hz's comb, and repeat itself
        spacing = sample_rate_hz / Fraction(origin).limit_denominator(MAX_PERIOD).denominator
    ratio = Fraction(spacing / sample_rate_hz).limit_denominator(MAX_PERIOD)
    period, step = ratio.denominator, float(ratio)
    span = (tones_hz[n_tones - 1] - tones_hz[0]) / sample_rate_hz
    near = abs(step * sample_rate_hz - spacing) <= TOLERANCE_HZ
    if step <= 0.0 or not near or round(span / step) >= MAX_TEETH:
        return NO_COMB
    n_teeth = round(span / step) + 1
    teeth = _teeth(ratio.numerator, period, 1 << (n_teeth - 1).bit_length())
    return Comb(origin, step, teeth[: 2 * n_teeth], period * math.ceil(BLOCK / period))


@lru_cache(maxsize=8)
def _teeth(numerator: int, period: int, n_teeth: int) -> NDArray[np.float64]:
    """What :attr:`Comb.teeth` holds, kept for the next program."""
    from labseq.kernels.render_teeth import fill_teeth

    angles = 2 * np.pi / period * np.arange(period)
    teeth = np.empty((2 * n_teeth, period))
    fill_teeth(np.cos(angles), np.sin(angles), numerator, teeth)
    teeth.flags.writeable = False
    return teeth


def _spacing(site_hz: NDArray[np.float64]) -> float:
    """Mean spacing of the sites' frequencies; 0 for a single site."""
    if len(site_hz) < 2:
        return 0.0
    return float(site_hz[-1] - site_hz[0]) / (len(site_hz) - 1)
