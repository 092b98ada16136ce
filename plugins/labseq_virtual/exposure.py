"""An exposure: which atoms shine, and which are lost while they do."""

from __future__ import annotations

import importlib
import math
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import WHOLE_SENSOR, Occupancy, SensorMode, SiteGrid
from labseq_virtual.images import Images
from labseq_virtual.settings import WorldSettings
from labseq_virtual.view import View


class SensorMixin:
    """The part of a world that tells of its sensor; implements ``labseq.ReportsSensor``."""

    _exposure: Exposure

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor in pixels."""
        return self._exposure.sensor_shape

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to that of the whole sensor without binning."""
        return self._exposure.readout_fraction(mode)

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Work out what all frames of a mode have in common, and load the kernels."""
        importlib.import_module("labseq_virtual._kernels_image")
        self._exposure.prepare(mode)


class Exposure:
    """Takes frames of the atoms.

    Args:
        grid: The grid of sites.
        settings: Losses and image.
        seed: Seed of the machine's own disorder.
    """

    def __init__(self, grid: SiteGrid, settings: WorldSettings, seed: int) -> None:
        self._settings = settings
        self._grid = grid
        self._seed = seed
        self._images: dict[SensorMode, Images] = {}
        self._light_hz = -math.log1p(-settings.imaging_loss) / settings.imaging_loss_exposure

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor in pixels."""
        return self._settings.image.frame

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to that of the whole sensor without binning.

        Raises:
            LimitError: The sensor cannot be used so.
        """
        return View.of(self._settings.image, mode).readout_fraction

    def prepare(self, mode: SensorMode) -> None:
        """Work out what all frames of a mode have in common.

        Raises:
            LimitError: The sensor cannot be used so.
        """
        self._images_of(mode).warm()

    def take(
        self,
        occupied: Occupancy,
        exposure_s: float,
        random: np.random.Generator,
        mode: SensorMode = WHOLE_SENSOR,
        lit: float = 1.0,
    ) -> tuple[NDArray[np.uint16], Counter[str]]:
        """Take a frame; the imaging light heats some atoms out, and they shine until they are lost.

        It does so behind a closed shutter too, which keeps it from the sensor only.

        Args:
            occupied: bool (n_rows, n_cols), sites that hold an atom; changed in place.
            exposure_s: Exposure time, in seconds.
            random: Random numbers of the shot.
            mode: How the sensor is exposed and read.
            lit: Fraction of the exposure with imaging light; without any there is no stray light either.

        Returns:
            The frame, uint16 (height, width), read-only, and how many atoms were lost to imaging and vacuum.
        """
        images = self._images_of(mode if lit > 0 else replace(mode, shutter_open=False))
        row, col = np.nonzero(occupied)
        light_hz = self._light_hz * lit
        rate_hz = light_hz + 1.0 / self._settings.lifetime
        life_s = random.exponential(1.0 / rate_hz, len(row))
        shining = np.minimum(life_s / exposure_s, 1.0) * lit
        image = images.take(row, col, shining, exposure_s, random)
        image.flags.writeable = False
        lost = life_s < exposure_s
        occupied[row[lost], col[lost]] = False
        n_lost = int(np.count_nonzero(lost))
        n_by_light = int(random.binomial(n_lost, light_hz / rate_hz))
        return image, Counter(imaging=n_by_light, vacuum=n_lost - n_by_light)

    def _images_of(self, mode: SensorMode) -> Images:
        """The same machine in each mode: a region is exactly that part of the sensor."""
        if mode not in self._images:
            self._images[mode] = Images(self._settings.image, self._grid, self._seed, mode)
        return self._images[mode]
