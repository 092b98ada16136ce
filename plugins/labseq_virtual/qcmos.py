"""The qCMOS camera: from photoelectrons to counts, every pixel with an amplifier of its own."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_virtual.emccd import FULL_SCALE
from labseq_virtual.law import CountDistribution
from labseq_virtual.view import View

Floats = NDArray[np.float32]


class Qcmos:
    """A qCMOS camera.

    Photoelectrons and dark current fill the pixel's well; its own gain, read noise and offset follow,
    then an analogue-to-digital converter of 16 bit. Binned pixels are added up after that.

    Args:
        settings: Constants of the camera, and how it is read.
        rng: Random numbers of the machine, for what differs from pixel to pixel.
    """

    binning: Final = 1
    """Binning before the read-out."""

    def __init__(self, settings: View, rng: np.random.Generator) -> None:
        self.quantum_efficiency = settings.qcmos.quantum_efficiency
        self._settings = settings
        self._rng = rng

    def warm(self) -> None:
        """Draw what differs from pixel to pixel."""
        _ = self._pixels

    def read(
        self, light: NDArray[np.int32], exposure_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Draw the counts of a frame.

        Args:
            light: int32, photoelectrons of the atoms on each pixel of the part that is read.
            exposure_s: Exposure time, in seconds.
            rng: Random numbers of the shot.

        Returns:
            uint16 (height, width), binned.
        """
        adu_per_electron, read_noise, offset = self._pixels
        electrons = np.empty(light.shape, np.int32)
        _poisson(self._dark_electrons(exposure_s)).draw(electrons.ravel(), rng)
        electrons += light
        counts = np.minimum(electrons, round(self._settings.qcmos.full_well)).astype(np.float32)
        counts *= adu_per_electron
        counts += offset
        noise = rng.standard_normal(light.shape, np.float32)
        noise *= read_noise
        counts += noise
        np.clip(np.rint(counts, out=counts), 0, FULL_SCALE, out=counts)
        b = self._settings.binning
        if b > 1:
            height, width = light.shape
            summed = counts.reshape(height // b, b, width // b, b).sum(axis=(1, 3))
            counts = np.minimum(summed, FULL_SCALE)
        return counts.astype(np.uint16)

    @cached_property
    def _pixels(self) -> tuple[Floats, Floats, Floats]:
        """Counts per electron, read noise and offset in counts of each pixel that is read."""
        settings, frame = self._settings.qcmos, self._settings.frame
        normal = self._rng.standard_normal((3, *frame), np.float32)
        top, left, height, width = self._settings.region
        normal = normal[:, top : top + height, left : left + width]
        adu_per_electron = np.maximum(0, 1 + settings.gain_spread * normal[0]) / settings.electrons_per_adu
        spread = settings.read_noise_spread  # the mean square of exp(spread * normal) is exp(2 * spread^2)
        read_noise = settings.read_noise * np.exp(spread * normal[1] - spread**2) * adu_per_electron
        offset = settings.offset + settings.offset_spread * normal[2]
        return adu_per_electron, read_noise, offset

    def _dark_electrons(self, exposure_s: float) -> float:
        """Mean electrons of a pixel without an atom's light."""
        settings = self._settings
        stray = settings.background * settings.qcmos.quantum_efficiency * exposure_s / settings.exposure
        return stray + settings.qcmos.dark_current * exposure_s


@lru_cache(maxsize=16)
def _poisson(mean: float) -> CountDistribution:
    from scipy.special import gammaln, xlogy

    k = np.arange(int(mean + 9 * mean**0.5) + 45)
    return CountDistribution.of(np.exp(xlogy(k, mean) - mean - gammaln(k + 1)))
