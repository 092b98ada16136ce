"""Formulas behind the constants of the simulation."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, SiteGrid
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]

KELVIN: Final = 1.380649e-23 / (86.909180531 * 1.66053906660e-27)
"""Conversion of kelvin to energy per mass of 87Rb in m^2/s^2 (AME2020, CODATA 2018)."""
MIN_TONE_DEPTH: Final = 2e-3
"""Fraction of the full depth below which a tone counts as off (ours)."""


def rayleigh_length(waist_m: float, wavelength_m: float) -> float:
    """Distance from the focus over which the area of a Gaussian beam doubles, in metres."""
    return math.pi * waist_m**2 / wavelength_m


def noise_hz(settings: SimulationSettings) -> float:
    """Rate at which noise of the intensity heats an atom in a static tweezer of nominal depth.

    ``pi^2 nu^2 S(2 nu)`` (T. Savard, K. O'Hara, J. Thomas, Phys. Rev. A 56, R1095, 1997), mean over the axes,
    of which only the radial ones count.
    """
    stiffness = 4 * KELVIN * settings.static_depth / settings.static_waist**2
    return 2 / 3 * stiffness / 4 * settings.intensity_noise


def recoil_heat(settings: SimulationSettings) -> float:
    """Temperature rise of the atoms in imaging light, compared with cooling alone, in kelvin.

    Each photon adds a third of the recoil temperature in a harmonic well (R. Grimm, M. Weidemueller,
    Y. Ovchinnikov, Adv. At. Mol. Opt. Phys. 42, 95, 2000), which cooling takes away within ``cooling_time``.
    """
    recoil_k = 0.36196e-6  # of 87Rb on its D2 line (D. Steck, Rubidium 87 D Line Data)
    return settings.scattering_rate * recoil_k / 3 * settings.cooling_time


def pair_survival(settings: SimulationSettings) -> float:
    """Probability that collisions in the cooling light leave one of two atoms in a tweezer, and not none.

    Blue-detuned light takes one or both atoms of a pair (T. Gruenzweig et al., Nat. Phys. 6, 951, 2010).
    Loading ends with such collisions. Of n atoms one is left with P(n) = p P(n - 1) + (1 - p) P(n - 2), if p
    is the probability that a collision takes only one. P(0) = 0 and P(1) = 1 give P = 1 / (2 - p) for many
    atoms. So p follows from the loading. Below 50 %, where sites stay empty for other reasons, it is 0.
    """
    if settings.pair_survival is not None:
        return settings.pair_survival
    return max(0.0, 2.0 - 1.0 / max(settings.loading, 0.5))


def full_amplitudes(grid: SiteGrid, motion: MotionSpec) -> tuple[Floats, Floats]:
    """Amplitudes of the row tones and of the column tones that give the full depth, one per site."""
    rf = motion.rf
    given = (rf.row_amplitudes, rf.column_amplitudes)
    most = (motion.max_row_tones, motion.max_column_tones)
    rows, cols = (np.array(given[axis] or [1 / most[axis]] * n) for axis, n in enumerate(grid.shape))
    return rows, cols


def full_volts(grid: SiteGrid, motion: MotionSpec) -> list[Floats]:
    """Peak voltages of the tones that give the full depth, for each axis, one per site."""
    return [motion.rf.full_scale_v * full for full in full_amplitudes(grid, motion)]
