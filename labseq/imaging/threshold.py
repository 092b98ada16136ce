"""A region of interest and a threshold per site: the paper's way to find the atoms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.known_sites import ContextLike, KnownSites, known_sites
from labseq.imaging.regions import RegionsLike, checked_image, region_corners
from labseq.imaging.thresholds import PerSite, known_thresholds
from labseq.model import Frame, Occupancy


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

    signal_unit: Final = "counts"

    def __init__(self, settings: ThresholdLike, context: ContextLike) -> None:
        self._name = context.name or "detector"
        self._width = settings.width
        self._known = known_sites(settings, context)
        self._pixels = _region_pixels(settings, self._known)
        self._dark = len(self._pixels) * settings.offset
        thresholds = known_thresholds(settings.threshold, self.signal_unit, context)
        self._thresholds, self._thresholds_source = thresholds.values, thresholds.source

    @property
    def sites_px(self) -> NDArray[np.float64]:
        """(y, x) of each site in pixels, float64 (n_rows, n_cols, 2)."""
        return self._known.positions_px

    def describe(self) -> Mapping[str, str]:
        """Where its sites and thresholds come from."""
        return {"sites": self._known.source, "thresholds": self._thresholds_source}

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site,
            float32 (n_rows, n_cols), 0 at the threshold and 1 for certainty.

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        distance = self.signals(frame) - self._thresholds
        confidence = np.tanh(np.abs(distance) / self._width).astype(np.float32)
        return distance > 0.0, confidence

    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """Counts over the offset, summed over each region, float64 (n_rows, n_cols).

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = checked_image(frame, self._known, self._name)
        counts = image.take(self._pixels).sum(axis=0, dtype=np.uint32)
        return counts.reshape(self._thresholds.shape) - self._dark


def _region_pixels(settings: ThresholdLike, known: KnownSites) -> NDArray[np.int64]:
    """Flat indices of the regions' pixels, (pixels of a region, n_sites): summed along rows of memory."""
    corners = region_corners(known, settings.region)
    dy, dx = np.indices((settings.region, settings.region)).reshape(2, -1, 1)
    if settings.shape == "disc":
        half = settings.region // 2
        inside = (dy - half) ** 2 + (dx - half) ** 2 <= (settings.region / 2) ** 2
        dy, dx = dy[inside, None], dx[inside, None]
    return (corners[:, 0] + dy) * known.frame[1] + corners[:, 1] + dx
