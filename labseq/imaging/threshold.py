"""A region of interest and a threshold per site: the paper's way to find the atoms."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.comparing import ComparingDetector, ComparingLike
from labseq.imaging.known_sites import ContextLike, KnownSites
from labseq.imaging.regions import checked_image
from labseq.model import Frame


class ThresholdLike(ComparingLike, Protocol):
    """Settings of :class:`ThresholdDetector`; SI and pixels."""

    @property
    def shape(self) -> Literal["square", "disc"]:
        """Shape of the region of interest."""
        ...

    @property
    def offset(self) -> float:
        """Counts of a dark pixel."""
        ...


class ThresholdDetector(ComparingDetector):
    """Sums a region of interest around each site and compares with a threshold.

    There is an atom on site (i, j) if the counts of its region, less the offset
    of each pixel, exceed T_ij (paper, "Experimental Setup"). The confidence is
    ``tanh(|counts - T_ij| / width)``: for two classes whose log-odds grow linearly
    with the counts, that is the probability of being right, scaled to 0..1.

    Where the sites are is said by the file in ``sites``, else by the calibration of
    sites in use, else by the geometry in the settings; the thresholds by the
    calibration of thresholds in use, else by the settings.

    Args:
        settings: See :class:`ThresholdLike`. A threshold given as text is the path
            of a .npy file of floats (n_rows, n_cols), read here.
        context: Grid, calibrations and name; a ``labseq.Context``.

    Raises:
        LimitError: A region of interest reaches over the edge of the frame, or the
            thresholds do not have one value per site.
        ConfigError: A file cannot be read, or the calibrated thresholds are no counts.
    """

    signal_unit = "counts"

    def __init__(self, settings: ThresholdLike, context: ContextLike) -> None:
        super().__init__(settings, context)
        self._pixels = _region_pixels(settings, self._known, self._corners)
        self._dark = len(self._pixels) * settings.offset

    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """Counts over the offset, summed over each region, float64 (n_rows, n_cols).

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = checked_image(frame, self._known, self._name)
        counts = image.take(self._pixels).sum(axis=0, dtype=np.uint32)
        return counts.reshape(self._thresholds.shape) - self._dark


def _region_pixels(
    settings: ThresholdLike, known: KnownSites, corners: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Flat indices of the regions' pixels, (pixels of a region, n_sites): summed along rows of memory."""
    dy, dx = np.indices((settings.region, settings.region)).reshape(2, -1, 1)
    if settings.shape == "disc":
        half = settings.region // 2
        inside = (dy - half) ** 2 + (dx - half) ** 2 <= (settings.region / 2) ** 2
        dy, dx = dy[inside, None], dx[inside, None]
    return (corners[:, 0] + dy) * known.frame[1] + corners[:, 1] + dx
