"""The model of pick-up and drop-off of an atom, and the records of it that the kernels take.

The model uses only depths and positions of the tweezers and does not follow the atoms; its constants are
those of ``settings.py``. Energies are in kelvin. The formulas are in ``tweezer_kernels.py``; the reasons:

1. *Pick-up.* A static well of depth U_s and waist w_s and a mobile one of U_m and w_m at a distance d form
   one well as long as d is below :func:`merging_distance`. Then the atom follows the mobile tweezer if
   that is the deeper one; otherwise it stays.
2. *Heat.* Atoms have a temperature. What pick-up, transport and drop-off do to it, and the atoms that they
   lose, is taken from tables made by moving atoms by Newton's equations (``responses.py``): it depends on the
   ramps, on the distance between both tweezers, on their depths, on the speed and its course. Between moves
   atoms are cooled, or the noise of the intensity heats them.
3. *Hand-over loss.* Pick-up and drop-off together lose ``transport_loss`` at the nominal depths. The loss
   is proportional to U_m / U_s: the deeper the mobile tweezer is relative to the static one, the less
   adiabatic the change (the paper observes this and gives no formula).
4. *Transport loss*: ``transport_loss_per_tone`` for each further tone; and where a mobile tweezer is
   shallower than ``adiabatic_depth``, which scales with the speed squared (the kinetic energy), the
   fraction ``shallow_loss`` of its atoms. Depths scatter with the intermodulation of the tones, so the
   threshold is as wide as that scatter.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, SiteGrid
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]

KELVIN: Final = 1.380649e-23 / (86.909180531 * 1.66053906660e-27)
"""m^2/s^2 per kelvin: energies per mass of 87Rb (AME2020, CODATA 2018)."""


@lru_cache(maxsize=8)
def merging_distance(static_waist_m: float, mobile_waist_m: float) -> tuple[Floats, Floats]:
    """Distance below which a static and a mobile tweezer are one well, as a table.

    Found by counting the minima of the sum of both wells on the line between them.

    Returns:
        Logarithm of the ratio of the mobile to the static depth, float64 (n,), rising, and the
        distances, float64 (n,), in metres.
    """
    log_ratio = np.linspace(math.log(0.3), math.log(30.0), 24)
    distance = np.linspace(0.0, 3.5, 176)[1:] * max(static_waist_m, mobile_waist_m)
    x = np.linspace(0.0, 1.0, 401)[1:] * distance[:, None]  # (n_distances, n_places)
    back = x * np.exp(-2 * x**2 / static_waist_m**2) / static_waist_m**2
    left = distance[:, None] - x
    on = left * np.exp(-2 * left**2 / mobile_waist_m**2) / mobile_waist_m**2
    merged = np.empty(len(log_ratio))
    for k, ratio in enumerate(np.exp(log_ratio)):
        forward = ratio * on > back
        n_minima = np.count_nonzero(forward[:, :-1] & ~forward[:, 1:], axis=1) + ~forward[:, 0]
        parted = np.append(n_minima > 1, True)  # beyond the table at the latest
        merged[k] = distance[max(0, int(np.argmax(parted)) - 1)]
    return log_ratio, merged


def noise_hz(settings: SimulationSettings) -> float:
    """Rate at which noise of the intensity heats an atom in a static tweezer of nominal depth.

    ``pi^2 nu^2 S(2 nu)`` (T. Savard, K. O'Hara, J. Thomas, Phys. Rev. A 56, R1095, 1997), mean over the axes:
    the radial ones count.
    """
    stiffness = 4 * KELVIN * settings.static_depth / settings.static_waist**2
    return 2 / 3 * stiffness / 4 * settings.intensity_noise


def recoil_heat(settings: SimulationSettings) -> float:
    """How much hotter the light of an image keeps the atoms than the cooling alone would, in kelvin.

    Each photon adds a third of the recoil temperature in a harmonic well (R. Grimm, M. Weidemueller,
    Y. Ovchinnikov, Adv. At. Mol. Opt. Phys. 42, 95, 2000), which cooling takes away within ``cooling_time``.
    """
    recoil_k = 0.36196e-6  # of 87Rb on its D2 line (D. Steck, Rubidium 87 D Line Data)
    return settings.scattering_rate * recoil_k / 3 * settings.cooling_time


def pair_survival(settings: SimulationSettings) -> float:
    """Probability that collisions in the cooling light leave one of two atoms in a tweezer, and not none.

    Blue-detuned light takes one or both atoms of a pair (T. Gruenzweig et al., Nat. Phys. 6, 951, 2010).
    Loading ends with such collisions: of n atoms one is left with P(n) = p P(n - 1) + (1 - p) P(n - 2), if p
    is the probability that a collision takes one only; P(0) = 0 and P(1) = 1 give P = 1 / (2 - p) for many
    atoms. So p follows from the loading; below 50 %, where sites stay empty for other reasons, it is 0.
    """
    if settings.pair_survival is not None:
        return settings.pair_survival
    return max(0.0, 2.0 - 1.0 / max(settings.loading, 0.5))


def full_amplitudes(grid: SiteGrid, motion: MotionSpec) -> tuple[Floats, Floats]:
    """Amplitudes that give the full depth, of the row tones and of the column tones, one per site."""
    rf = motion.rf
    given = (rf.row_amplitudes, rf.column_amplitudes)
    most = (motion.max_row_tones, motion.max_column_tones)
    rows, cols = (np.array(given[axis] or [1 / most[axis]] * n) for axis, n in enumerate(grid.shape))
    return rows, cols


def full_volts(grid: SiteGrid, motion: MotionSpec) -> list[Floats]:
    """Peak voltages of the tones that give the full depth: for each axis, one per site."""
    return [motion.rf.full_scale_v * full for full in full_amplitudes(grid, motion)]
