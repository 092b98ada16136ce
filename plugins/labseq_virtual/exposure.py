"""An exposure: which atoms shine, and which are lost while they do."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from labseq.model import Occupancy, SiteGrid
from labseq_virtual.images import Images
from labseq_virtual.settings import WorldSettings


class Exposure:
    """Takes frames of the atoms.

    Args:
        grid: The grid of sites.
        settings: Losses and image.
        seed: Seed of the machine's own disorder.
    """

    def __init__(self, grid: SiteGrid, settings: WorldSettings, seed: int) -> None:
        self._settings = settings
        self.images = Images(settings.image, grid, seed)
        self._light_hz = -math.log1p(-settings.imaging_loss) / settings.imaging_loss_exposure

    def take(
        self, occupied: Occupancy, exposure_s: float, random: np.random.Generator
    ) -> tuple[NDArray[np.uint16], Counter[str]]:
        """Take a frame; the imaging light heats some atoms out, and they shine until they are lost.

        Args:
            occupied: bool (n_rows, n_cols), sites that hold an atom; changed in place.
            exposure_s: Exposure time, in seconds.
            random: Random numbers of the shot.

        Returns:
            The frame, uint16 (height, width), read-only, and how many atoms were lost to imaging and vacuum.
        """
        row, col = np.nonzero(occupied)
        rate_hz = self._light_hz + 1.0 / self._settings.lifetime
        life_s = random.exponential(1.0 / rate_hz, len(row))
        shining = np.minimum(life_s / exposure_s, 1.0)
        image = self.images.take(row, col, shining, exposure_s, random)
        image.flags.writeable = False
        lost = life_s < exposure_s
        occupied[row[lost], col[lost]] = False
        n_lost = int(np.count_nonzero(lost))
        n_by_light = int(random.binomial(n_lost, self._light_hz / rate_hz))
        return image, Counter(imaging=n_by_light, vacuum=n_lost - n_by_light)
