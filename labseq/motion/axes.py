"""Tone frequencies of the sites: combs, offsets, amplitudes and limits.

Positions are along the axis in the atom plane, from the grid's centre. The axis of the column tones is a1,
and that of the row tones is a2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import MotionSpec, RfSpec, SiteGrid
from labseq.model.grid import mean_step_hz

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CombFit:
    """The equally spaced comb nearest to the tones of an axis, and how far they are from it.

    Attributes:
        frequency_hz: float64 (n_sites,), frequencies of the comb at the sites.
        error_m: float64 (n_sites,), distance of each tweezer on the comb from its place with its own
            frequency, in the atom plane, in metres.
    """

    frequency_hz: Floats
    error_m: Floats

    @property
    def worst_m(self) -> float:
        """Greatest distance of a tone from the comb, in metres."""
        return float(np.abs(self.error_m).max(initial=0.0))


def fit_comb(site_hz: Floats, spacing_m: float) -> CombFit:
    """Find the comb with the least squared distance to the tones of an axis.

    Args:
        site_hz: float64 (n_sites,), frequency of each site.
        spacing_m: Distance between neighbouring sites, in metres.

    Example:
        >>> fit = fit_comb(np.array([98e6, 100.012e6, 102e6]), spacing_m=4.5e-6)
        >>> [round(error * 1e9) for error in fit.error_m]
        [9, -18, 9]
    """
    n_sites = len(site_hz)
    if n_sites < 3:
        return CombFit(site_hz, np.zeros(n_sites))
    site = np.arange(n_sites) - (n_sites - 1) / 2
    step_hz = float(site @ site_hz / (site @ site))
    comb_hz = site_hz.mean() + step_hz * site
    off_hz = comb_hz - site_hz
    if np.abs(off_hz).max() <= 1e-6:  # only rounding
        return CombFit(site_hz, np.zeros(n_sites))
    return CombFit(comb_hz, off_hz / step_hz * spacing_m)


AxisIndex = Literal[0, 1]

AXES: Final = ("row", "column")

ROUNDING: Final = 1e-9
"""Relative amount by which rounding of sums can exceed a limit."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Frequencies and amplitudes of an axis at its sites, and its limits.

    Attributes:
        site_hz: float64 (n_sites,), frequency of each site, on a comb if a comb is near enough.
        step_hz: Mean step from site to site. An axis with a single site has the step of the other axis.
        comb_error_m: float64 (n_sites,), how far tones were moved to be on the comb, in the atom plane. Zeros
            if they were not moved.
        amplitude: float64 (n_sites,), amplitude of each site's tone, as a fraction of full scale.
        is_uneven: True if the amplitudes differ from site to site.
        phase: float64 (n_sites,), preassigned phase of each site's tone, in cycles.
        max_tones: Most tones at once.
        limits: float64 (6,), see :func:`labseq.motion.tone_kernels.first_excess`.
    """

    site_hz: Floats
    step_hz: float
    comb_error_m: Floats
    amplitude: Floats
    is_uneven: bool
    phase: Floats
    max_tones: int
    limits: Floats


@lru_cache(maxsize=16)
def drive(grid: SiteGrid, motion: MotionSpec, axis: AxisIndex) -> Drive:
    """Compute the frequencies, amplitudes and limits of an axis.

    Args:
        grid: The grid of sites.
        motion: How the tweezers move.
        axis: 0 for the rows' tones, 1 for the columns'.

    Raises:
        LimitError: The number of preassigned amplitudes is not the number of sites.
    """
    rf = motion.rf
    all_hz = (grid.row_frequency_hz, grid.column_frequency_hz)
    step_hz = mean_step_hz(all_hz[axis], all_hz[1 - axis])
    comb = fit_comb(all_hz[axis], grid.spacing_m)
    snapped = comb.worst_m <= rf.snap_within_m
    site_hz = np.array(comb.frequency_hz if snapped else all_hz[axis])
    max_tones = (motion.max_row_tones, motion.max_column_tones)[axis]
    amplitude = _amplitudes(rf, axis, grid.shape[axis], max_tones)
    for array in (site_hz, amplitude):
        array.flags.writeable = False  # the kernels' signatures require it
    return Drive(
        site_hz=site_hz,
        step_hz=step_hz,
        comb_error_m=comb.error_m if snapped else np.zeros_like(comb.error_m),
        amplitude=amplitude,
        is_uneven=bool(amplitude.min() < amplitude.max()),
        phase=preassigned_phases(*grid.shape, rf.phase_seed)[axis],
        max_tones=max_tones,
        limits=_limits(rf, axis, np.sign(step_hz)),
    )


@lru_cache(maxsize=16)
def preassigned_phases(n_rows: int, n_cols: int, seed: int = RfSpec().phase_seed) -> tuple[Floats, Floats]:
    """Random phase of each row's and each column's tone at pick-up, in cycles.

    Random phases keep the tones of an axis from adding up ("RF intermodulation" in
    the paper). A tone keeps its phase whatever the size of the grid.
    """
    rows, columns = np.random.SeedSequence(seed).spawn(2)
    return np.random.default_rng(rows).random(n_rows), np.random.default_rng(columns).random(n_cols)


def _amplitudes(rf: RfSpec, axis: AxisIndex, n_sites: int, max_tones: int) -> Floats:
    preassigned = (rf.row_amplitudes, rf.column_amplitudes)[axis]
    if not preassigned:
        return np.full(n_sites, 1.0 / max_tones)
    if len(preassigned) != n_sites:
        raise LimitError(
            f"the number of preassigned {AXES[axis]} amplitudes",
            len(preassigned),
            f"{n_sites}, one per {AXES[axis]}",
        )
    return np.array(preassigned)


def _limits(rf: RfSpec, axis: AxisIndex, direction: float) -> Floats:
    low_hz, high_hz = (rf.row_band_hz, rf.column_band_hz)[axis]
    most = min(1.0, rf.max_peak_v / rf.full_scale_v)
    squares = rf.max_mean_power_w / rf.full_scale_power_w
    above, below = 1 + ROUNDING, 1 - ROUNDING
    return np.array(
        [
            low_hz * below,
            high_hz * above,
            rf.min_spacing_hz * below,
            direction,
            most * above,
            squares * above,
        ]
    )
