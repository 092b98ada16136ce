"""What the virtual camera sees of the atoms: optics and sensor together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import WHOLE_SENSOR, RandomStream, SensorMode, SiteGrid
from labseq_virtual.emccd import Emccd
from labseq_virtual.image_settings import ImageSettings
from labseq_virtual.optics import photoelectrons, site_brightness, site_spots
from labseq_virtual.qcmos import Qcmos
from labseq_virtual.view import View


class Images:
    """Draws frames of atoms on the sites, all in one mode of the sensor.

    Args:
        settings: Constants of optics and camera.
        grid: The sites.
        seed: Seed of what differs from site to site and from pixel to pixel.
        mode: How the sensor is exposed and read.

    Raises:
        LimitError: The sensor cannot be used so.
    """

    def __init__(
        self, settings: ImageSettings, grid: SiteGrid, seed: int, mode: SensorMode = WHOLE_SENSOR
    ) -> None:
        rng = RandomStream(seed, "simulation.image").machine()
        self._view = view = View.of(settings, mode)
        self._is_lit = mode.shutter_open
        self._spots = site_spots(view, grid)
        self._brightness = site_brightness(view, self._spots, rng)
        self._sensor = Emccd(view) if view.sensor == "emccd" else Qcmos(view, rng)

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
        view = self._view
        full = view.photoelectrons * self._sensor.quantum_efficiency * exposure_s / view.exposure
        mean = full * shining * self._brightness[row, col] * self._is_lit
        light = photoelectrons(view, self._spots[row, col], mean, rng, self._sensor.binning)
        return self._sensor.read(light, exposure_s, rng)
