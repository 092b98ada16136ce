"""A region of interest and a threshold per site: the paper's way to find the atoms."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.regions import (
    ContextLike,
    PerSite,
    RegionsLike,
    checked_image,
    region_corners,
    site_thresholds,
)
from labseq.model import Frame, Occupancy, SiteGrid


class ThresholdLike(RegionsLike, Protocol):
    """Settings of :class:`ThresholdDetector`; SI and pixels."""

    @property
    def shape(self) -> Literal["square", "disc"]:
        """Shape of the region of interest."""
        ...

    @property
    def offset(self) -> float:
        """Counts of a dark pixel."""
        ...

    @property
    def threshold(self) -> PerSite:
        """Counts over the offset, summed over the region, above which there is an atom."""
        ...

    @property
    def width(self) -> float:
        """Counts from the threshold at which the confidence is tanh(1) = 0.76."""
        ...


class ThresholdDetector:
    """Sums a region of interest around each site and compares with a threshold.

    There is an atom on site (i, j) if the counts of its region, less the offset
    of each pixel, exceed T_ij (paper, "Experimental Setup"). The confidence is
    ``tanh(|counts - T_ij| / width)``: for two classes whose log-odds grow linearly
    with the counts, that is the probability of being right, scaled to 0..1.

    Args:
        settings: See :class:`ThresholdLike`. A threshold given as text is the path
            of a .npy file of floats (n_rows, n_cols), read here.
        context: Grid and name; a ``labseq.Context``.

    Raises:
        LimitError: A region of interest reaches over the edge of the frame, or the
            thresholds do not have one value per site.
        ConfigError: The thresholds' file cannot be read.
    """

    def __init__(self, settings: ThresholdLike, context: ContextLike) -> None:
        self._name = context.name or "detector"
        self._frame_shape = settings.frame
        self._width = settings.width
        self._pixels = _region_pixels(settings, context.grid)
        n_pixels = self._pixels.shape[0]
        self._grid_shape = context.grid.shape
        thresholds = site_thresholds(settings.threshold, context.grid.shape)
        self._levels = thresholds + n_pixels * settings.offset

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site,
            float32 (n_rows, n_cols), 0 at the threshold and 1 for certainty.

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = checked_image(frame, self._frame_shape, self._name)
        counts = image.take(self._pixels).sum(axis=0, dtype=np.uint32)
        distance = counts.reshape(self._grid_shape) - self._levels
        confidence = np.tanh(np.abs(distance) / self._width).astype(np.float32)
        return distance > 0.0, confidence


def _region_pixels(settings: ThresholdLike, grid: SiteGrid) -> NDArray[np.int64]:
    """Flat indices of the regions' pixels, (pixels of a region, n_sites): summed along rows of memory."""
    corners = region_corners(settings, grid)
    dy, dx = np.indices((settings.region, settings.region)).reshape(2, -1, 1)
    if settings.shape == "disc":
        half = settings.region // 2
        inside = (dy - half) ** 2 + (dx - half) ** 2 <= (settings.region / 2) ** 2
        dy, dx = dy[inside, None], dx[inside, None]
    return (corners[:, 0] + dy) * settings.frame[1] + corners[:, 1] + dx
