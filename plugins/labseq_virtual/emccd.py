"""The EMCCD camera: from photoelectrons to counts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_virtual.em_register import Register, power_of_two
from labseq_virtual.law import CountDistribution
from labseq_virtual.view import View

FULL_SCALE: Final = 65535
"""Counts at which the converter of 16 bit ends."""

MAX_WORK: Final = 2**23
"""Outputs of the register times counts that the read noise reaches, above which no table is made."""

MAX_ELECTRONS: Final = 300
"""Mean electrons of a dark pixel above which none is made; fewer never fill a well."""


@dataclass(frozen=True)
class Output:
    """What comes behind the register.

    Attributes:
        well: Electrons that the register holds.
        read_noise: Electrons r.m.s.
        electrons_per_adu: Electrons per count.
        offset: Counts of a dark pixel.
    """

    well: float
    read_noise: float
    electrons_per_adu: float
    offset: float

    def counts(self, electrons: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Counts of electrons behind the register, not yet rounded."""
        counts = np.minimum(electrons, self.well) + self.read_noise * rng.standard_normal(len(electrons))
        return counts / self.electrons_per_adu + self.offset


class Emccd:
    """An EMCCD camera.

    The electrons of a pixel (photoelectrons, and the clock-induced charge of the sensor) pass the EM
    register, then come read noise, offset and an analogue-to-digital converter of 16 bit. Pixels
    without an atom's light all have one law, which is worked out once for an exposure time and
    drawn from a table; the others are followed step by step.

    Args:
        settings: Constants of the camera, and how it is read.
    """

    quantum_efficiency: Final = 1.0
    """The photoelectrons of the settings are this camera's."""

    def __init__(self, settings: View) -> None:
        self.binning = settings.binning
        self._settings = settings
        gain, spurious = settings.em_gain, settings.register_clock_induced_charge
        self.register = Register(settings.register_stages, gain, spurious)
        self._output = Output(
            settings.register_well, settings.read_noise, settings.electrons_per_adu, settings.offset
        )

    def warm(self) -> None:
        """Work out the tables for the exposure of the settings."""
        _ = self.register.one
        _dark_law(self.register, self._output, self._dark_electrons(self._settings.exposure))

    def read(
        self, light: NDArray[np.int32], exposure_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Draw the counts of a frame.

        Args:
            light: int32 (height, width), photoelectrons of the atoms on each pixel.
            exposure_s: Exposure time, in seconds.
            rng: Random numbers of the shot.

        Returns:
            uint16 (height, width).
        """
        dark_electrons = self._dark_electrons(exposure_s)
        dark = _dark_law(self.register, self._output, dark_electrons)
        image = np.empty(light.size, np.uint16)
        if dark is None:
            lit = slice(None)
        else:
            dark.draw(image, rng)
            lit = np.flatnonzero(light > 0)
        n_electrons = light.ravel()[lit].astype(np.int64)
        n_electrons += rng.poisson(dark_electrons, len(n_electrons))
        n_electrons = np.minimum(n_electrons, round(self._settings.full_well))
        counts = self._output.counts(self.register.multiply(n_electrons, rng), rng)
        image[lit] = np.clip(np.rint(counts), 0, FULL_SCALE)
        return image.reshape(light.shape)

    def _dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of a pixel without an atom's light."""
        settings = self._settings
        per_pixel = settings.background * exposure_s / settings.exposure + settings.clock_induced_charge
        return per_pixel * settings.binning**2


@lru_cache(maxsize=64)
def _dark_law(register: Register, output: Output, mean_electrons: float) -> CountDistribution | None:
    """Law of the counts of a pixel without an atom's light; None where a table would be too long."""
    most = mean_electrons + register.spurious
    n_values = power_of_two((most + 9 * (2 * most) ** 0.5 + 45) * register.gain)
    spread = output.read_noise / output.electrons_per_adu
    reach = int(np.ceil(6.5 * spread)) + 1
    if n_values * reach > MAX_WORK or mean_electrons > MAX_ELECTRONS:
        return None
    p = np.maximum(register.output(mean_electrons, n_values), 0.0)
    p = p[: np.flatnonzero(p > 1e-15)[-1] + 1]
    value = np.minimum(np.arange(len(p)), output.well) / output.electrons_per_adu + output.offset
    nearest = np.rint(value).astype(np.int64)
    law = np.zeros(FULL_SCALE + 1)
    for beside in range(-reach, reach + 1):
        count = nearest + beside
        share = _rounded(count - value, spread) * p
        law += np.bincount(np.clip(count, 0, FULL_SCALE), share, len(law))
    return CountDistribution.of(law)


def _rounded(distance: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Probability that a normal number about 0 is rounded to a count at a distance."""
    from scipy.special import ndtr

    if spread == 0:
        return (np.abs(distance) <= 0.5).astype(float)
    return ndtr((distance + 0.5) / spread) - ndtr((distance - 0.5) / spread)
