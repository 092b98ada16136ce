"""What each axis of the mobile tweezers is driven with: tones of the sites, and limits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import MotionSpec, RfSpec, SiteGrid
from labseq.motion.calibration import fit_comb

Floats = NDArray[np.float64]
AxisIndex = Literal[0, 1]

AXES: Final = ("row", "column")

SINGLE_SITE_STEP_HZ: Final = 1.6e6
"""Step from the only site of a 1 x 1 grid to an ejection slot."""

ROUNDING: Final = 1e-9
"""By how much of itself a value may exceed its limit: what rounding of sums can do, and no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What an axis plays at its sites, and how far it may go.

    Attributes:
        site_hz: float64 (n_sites,), frequency of each site; on a comb if that is near enough.
        step_hz: Mean step from site to site; that of the other axis where there is a single one.
        comb_error_m: float64 (n_sites,), how far tones were moved to be on the comb, in the atom
            plane; zeros if they were not moved.
        amplitude: float64 (n_sites,), amplitude of each site's tone, as a fraction of full scale.
        phase: float64 (n_sites,), preassigned phase of each site's tone, in cycles.
        max_tones: Most tones at once.
        limits: float64 (6,), see :func:`labseq.kernels.tone_limits.first_excess`.
    """

    site_hz: Floats
    step_hz: float
    comb_error_m: Floats
    amplitude: Floats
    phase: Floats
    max_tones: int
    limits: Floats


@lru_cache(maxsize=16)
def drive(grid: SiteGrid, motion: MotionSpec, axis: AxisIndex) -> Drive:
    """Work out what an axis is driven with.

    Args:
        grid: The grid of sites.
        motion: How the tweezers move.
        axis: 0 for the rows' tones, 1 for the columns'.

    Raises:
        LimitError: Amplitudes are preassigned, but not one to each site.
    """
    rf = motion.rf
    all_hz = (grid.row_frequency_hz, grid.column_frequency_hz)
    step_hz = _step_hz(all_hz[axis], all_hz[1 - axis])
    comb = fit_comb(all_hz[axis], grid.spacing_m)
    snapped = comb.worst_m <= rf.snap_within_m
    max_tones = (motion.max_row_tones, motion.max_column_tones)[axis]
    return Drive(
        site_hz=comb.frequency_hz if snapped else all_hz[axis],
        step_hz=step_hz,
        comb_error_m=comb.error_m if snapped else np.zeros_like(comb.error_m),
        amplitude=_amplitudes(rf, axis, grid.shape[axis], max_tones),
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
    given = (rf.row_amplitudes, rf.column_amplitudes)[axis]
    if not given:
        return np.full(n_sites, 1.0 / max_tones)
    if len(given) != n_sites:
        raise LimitError(
            f"the number of preassigned {AXES[axis]} amplitudes",
            len(given),
            f"{n_sites}: one per {AXES[axis]}",
        )
    return np.array(given)


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


def _step_hz(site_hz: Floats, other_hz: Floats) -> float:
    for values in (site_hz, other_hz):
        if len(values) > 1:
            return float(values[-1] - values[0]) / (len(values) - 1)
    return SINGLE_SITE_STEP_HZ
