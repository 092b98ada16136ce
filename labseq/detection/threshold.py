"""The threshold detector, and the base class of detectors that compare a signal with a threshold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from labseq.detection.sites import (
    UNREADABLE,
    SiteSettings,
    Thresholds,
    checked_image,
    known_sites,
    read_npy,
    region_corners,
)
from labseq.errors import ConfigError, LimitError
from labseq.model import Frame, Occupancy
from labseq.roles import Context


class ComparingDetector(ABC):
    """Base of detectors that report an atom where the signal exceeds the site's threshold.

    The sites come from the file in ``sites``, else from the calibration of sites in use, else from the
    geometry in the settings. The thresholds come from the calibration of thresholds in use, else from the
    settings.

    Args:
        settings: Positions of the sites.
        threshold: Threshold of each site, unless a calibration of thresholds is in use.
        width: Distance from the threshold at which the confidence is tanh(1) = 0.76.
        context: Grid, calibrations and name.

    Raises:
        LimitError: A region extends over the edge of the frame, or the thresholds do
            not have one value per site.
        ConfigError: A file cannot be read, or the calibrated thresholds have another unit.
    """

    signal_unit: ClassVar[str]

    def __init__(self, settings: SiteSettings, threshold: Thresholds, width: float, context: Context) -> None:
        self._name = context.name or "detector"
        self._width = width
        self._known = known_sites(settings, context)
        self._corners = region_corners(self._known, settings.region)
        self.thresholds, self._thresholds_source = known_thresholds(threshold, self.signal_unit, context)

    @property
    def sites_px(self) -> NDArray[np.float64]:
        """(y, x) of each site in pixels, float64 (n_rows, n_cols, 2)."""
        return self._known.positions_px

    def describe(self) -> Mapping[str, str]:
        """Where the detector's sites and thresholds come from."""
        return {"sites": self._known.source, "thresholds": self._thresholds_source}

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32], NDArray[np.float64]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), the confidence per site, float32 (n_rows, n_cols), 0 at the
            threshold and 1 for certainty, and the signals that were compared with the thresholds.

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        signals = self.signals(frame)
        distance = signals - self.thresholds
        confidence = np.tanh(np.abs(distance) / self._width).astype(np.float32)
        return distance > 0.0, confidence, signals

    @abstractmethod
    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """The signals that are compared with the thresholds, float64 (n_rows, n_cols)."""


def known_thresholds(threshold: Thresholds, unit: str, context: Context) -> tuple[NDArray[np.float64], str]:
    """The thresholds of the calibration in use, else of the settings.

    Returns:
        float64 (n_rows, n_cols), in the detector's unit, and where they come from, for messages.

    Raises:
        LimitError: A site does not have exactly one finite value.
        ConfigError: The file cannot be read, or the calibration's ``origin`` names another unit.
    """
    entry = context.calibrations.get("thresholds")
    if entry is None:
        source = "the detector's settings" if not isinstance(threshold, str | Path) else str(threshold)
        return site_thresholds(threshold, context.grid.shape), source
    theirs = entry.origin.get("unit", unit)
    if theirs != unit:
        raise ConfigError(
            f"the calibration of thresholds {entry.id} is in {theirs}, but the detector compares {unit}; "
            "calibrate the thresholds with this detector, or use another calibration or `off`"
        )
    return entry.values["thresholds"], f"the calibration of thresholds {entry.id}"


def site_thresholds(threshold: Thresholds, shape: tuple[int, int]) -> NDArray[np.float64]:
    """One threshold per site, float64 (n_rows, n_cols).

    Raises:
        LimitError: A site does not have exactly one finite value.
        ConfigError: The file cannot be read.
    """
    if isinstance(threshold, str | Path):
        values, source = _load(Path(threshold)), f"the thresholds in {threshold}"
    else:
        values, source = threshold, "the detector's thresholds"
    try:
        array = np.asarray(values, np.float64)
    except ValueError:  # rows of different lengths
        array = np.empty(0)
    if array.ndim == 0:
        return np.full(shape, array)
    if array.shape != shape or not np.isfinite(array).all():
        raise LimitError(
            f"the shape of {source}",
            array.shape if array.shape != shape else "right, but not every value is finite",
            f"one finite number for each of {shape[0]} x {shape[1]} sites",
        )
    return array


def _load(path: Path) -> NDArray[np.float64]:
    try:
        return read_npy(path)
    except UNREADABLE as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"the detector's thresholds cannot be read from '{path}': {reason}; "
            "expected a .npy file of one float per site"
        ) from error


class ThresholdSettings(SiteSettings):
    """A region of interest and a threshold per site.

    With the defaults, the virtual lab's frames give the paper's mean detection fidelity of 99.946 %.
    """

    shape: Literal["square", "disc"] = Field(default="square", description="shape of the region of interest")
    offset: float = Field(default=500.0, description="counts of a dark pixel")
    threshold: Thresholds = Field(
        default=1630.0,
        description="counts over the offset, summed over the region, above which there is an atom, "
        "unless a calibration of thresholds is in use; one number, rows of numbers (one per site), or "
        "the path of a .npy file with one per site",
    )
    width: PositiveFloat = Field(
        default=130.0,
        description="distance of the counts from the threshold at which the confidence reaches 0.76",
    )


class ThresholdDetector(ComparingDetector):
    """Sums a region of interest around each site and compares with a threshold.

    There is an atom on site (i, j) if the counts of its region, less the offset of each pixel, exceed T_ij
    (paper, "Experimental Setup"). The confidence is ``tanh(|counts - T_ij| / width)``. For two classes whose
    log-odds grow linearly with the counts, it is the probability of being right, scaled to 0..1.

    Args:
        settings: A threshold given as text is the path of a .npy file of floats (n_rows, n_cols).
        context: Grid, calibrations and name.

    Raises:
        LimitError: A region of interest extends over the edge of the frame, or the
            thresholds do not have one value per site.
        ConfigError: A file cannot be read, or the calibrated thresholds are not in counts.
    """

    signal_unit = "counts"

    def __init__(self, settings: ThresholdSettings, context: Context) -> None:
        super().__init__(settings, settings.threshold, settings.width, context)
        self._pixels = self._region_pixels(settings)
        self._dark = len(self._pixels) * settings.offset

    def signals(self, frame: Frame) -> NDArray[np.float64]:
        """Counts over the offset, summed over each region, float64 (n_rows, n_cols).

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = checked_image(frame, self._known, self._name)
        counts = image.take(self._pixels).sum(axis=0, dtype=np.uint32)
        return counts.reshape(self.thresholds.shape) - self._dark

    def _region_pixels(self, settings: ThresholdSettings) -> NDArray[np.int64]:
        """Flat indices of the regions' pixels, int64 (pixels of a region, n_sites)."""
        dy, dx = np.indices((settings.region, settings.region)).reshape(2, -1, 1)
        if settings.shape == "disc":
            half = settings.region // 2
            inside = (dy - half) ** 2 + (dx - half) ** 2 <= (settings.region / 2) ** 2
            dy, dx = dy[inside, None], dx[inside, None]
        return (self._corners[:, 0] + dy) * self._known.frame[1] + self._corners[:, 1] + dx


class BlindDetector:
    """Accepts any frame and detects no atoms, for runs that calibrate the sites.

    Args:
        settings: None.
        context: The grid.
    """

    def __init__(self, settings: object, context: Context) -> None:
        del settings
        self._shape = context.grid.shape

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Detect nothing.

        Returns:
            An empty occupancy, bool (n_rows, n_cols), and no confidence, float32 (n_rows, n_cols).
        """
        del frame
        return np.zeros(self._shape, np.bool_), np.zeros(self._shape, np.float32)
