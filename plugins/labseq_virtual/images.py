"""What the virtual camera sees of the atoms: optics and sensor together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq import RandomStream, SiteGrid
from labseq_virtual.emccd import Emccd
from labseq_virtual.image_settings import ImageSettings
from labseq_virtual.optics import photoelectrons, site_brightness, site_spots
from labseq_virtual.qcmos import Qcmos


class Images:
    """Draws frames of atoms on the sites.

    Args:
        settings: Constants of optics and camera.
        grid: The sites.
        seed: Seed of what differs from site to site and from pixel to pixel.
    """

    def __init__(self, settings: ImageSettings, grid: SiteGrid, seed: int) -> None:
        rng = RandomStream(seed, "simulation.image").machine()
        self._settings = settings
        self._spots = site_spots(settings, grid)
        self._brightness = site_brightness(settings, self._spots, rng)
        self._sensor = Emccd(settings) if settings.sensor == "emccd" else Qcmos(settings, rng)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of the frames."""
        _, _, height, width = self._settings.region
        return height // self._settings.binning, width // self._settings.binning

    @property
    def readout_fraction(self) -> float:
        """Time to read a frame, relative to that of the whole sensor without binning.

        An EMCCD reads its pixels one after the other, a qCMOS camera its rows.
        """
        height, width = self._settings.frame
        rows, cols = self._settings.region[2:]
        if self._settings.sensor == "qcmos":
            return rows / height
        return rows * cols / (height * width * self._settings.binning**2)

    def warm(self) -> None:
        """Work out what all frames have in common."""
        self._sensor.warm()

    def take(
        self,
        row: NDArray[np.int64],
        col: NDArray[np.int64],
        shining: NDArray[np.float64],
        exposure_s: float,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """Draw a frame.

        Args:
            row: int64 (n_atoms,), row of each atom's site.
            col: int64 (n_atoms,), its column.
            shining: float64 (n_atoms,), how long each atom shines, as a fraction of the exposure.
            exposure_s: Exposure time, in seconds.
            rng: Random numbers of the shot.

        Returns:
            uint16 (height, width), in counts.
        """
        settings = self._settings
        full = settings.photoelectrons * self._sensor.quantum_efficiency * exposure_s / settings.exposure
        mean = full * shining * self._brightness[row, col]
        light = photoelectrons(settings, self._spots[row, col], mean, rng, self._sensor.binning)
        return self._sensor.read(light, exposure_s, rng)
