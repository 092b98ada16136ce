"""What all detectors do that compare a signal of each site with a threshold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.known_sites import ContextLike, known_sites
from labseq.imaging.regions import RegionsLike, region_corners
from labseq.imaging.thresholds import PerSite, known_thresholds
from labseq.model import Frame, Occupancy


class ComparingLike(RegionsLike, Protocol):
    """Settings of :class:`ComparingDetector`."""

    @property
    def threshold(self) -> PerSite:
        """Signal above which there is an atom."""
        ...

    @property
    def width(self) -> float:
        """Distance from the threshold at which the confidence is tanh(1) = 0.76."""
        ...


class ComparingDetector(ABC):
    """Base of detectors: there is an atom where the signal exceeds the site's threshold.

    Args:
        settings: See :class:`ComparingLike`.
        context: Grid, calibrations and name; a ``labseq.Context``.

    Raises:
        LimitError: A region reaches over the edge of the frame, or the thresholds do
            not have one value per site.
        ConfigError: A file cannot be read, or the calibrated thresholds are of another unit.
    """

    signal_unit: ClassVar[str]

    def __init__(self, settings: ComparingLike, context: ContextLike) -> None:
        self._name = context.name or "detector"
        self._width = settings.width
        self._known = known_sites(settings, context)
        self._corners = region_corners(self._known, settings.region)
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

    @abstractmethod
    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """What is compared, float64 (n_rows, n_cols)."""
