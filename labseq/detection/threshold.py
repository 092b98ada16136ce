"""The threshold detector."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.detection.sites import (
    ContextLike,
    KnownSites,
    RegionsLike,
    checked_image,
    known_sites,
    region_corners,
)
from labseq.errors import ConfigError, LimitError
from labseq.model import Frame, Occupancy

PerSite: TypeAlias = float | str | Path | Sequence[Sequence[float]]
"""One number for all sites, one for each, or the path of a .npy file with one for each."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownThresholds:
    """The thresholds.

    Attributes:
        values: float64 (n_rows, n_cols), in the detector's unit.
        source: Who says so, in words.
    """

    values: NDArray[np.float64]
    source: str


def known_thresholds(threshold: PerSite, unit: str, context: ContextLike) -> KnownThresholds:
    """The thresholds by the calibration in use, else by the settings.

    Args:
        threshold: The setting.
        unit: What the detector compares: "counts" or "log-odds".
        context: Grid and calibrations.

    Raises:
        LimitError: Not one finite value per site.
        ConfigError: The file cannot be read, or the calibration's ``origin`` names another unit.
    """
    entry = context.calibrations.get("thresholds")
    if entry is None:
        source = "the detector's settings" if not isinstance(threshold, str | Path) else str(threshold)
        return KnownThresholds(site_thresholds(threshold, context.grid.shape), source)
    theirs = entry.origin.get("unit", unit)
    if theirs != unit:
        raise ConfigError(
            f"the calibration of thresholds {entry.id} is in {theirs}, and the detector compares {unit}; "
            "calibrate the thresholds with this detector, or take another calibration, or `off`"
        )
    return KnownThresholds(entry.values["thresholds"], f"the calibration of thresholds {entry.id}")


def site_thresholds(threshold: PerSite, shape: tuple[int, int]) -> NDArray[np.float64]:
    """One threshold per site, float64 (n_rows, n_cols).

    Raises:
        LimitError: Not one finite value per site.
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
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"the detector's thresholds cannot be read from '{path}': {reason}; "
            "expected a .npy file of one float per site"
        ) from error


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


class BlindDetector:
    """Takes any frame and sees no atoms: it needs to know neither the sites nor the camera.

    Args:
        settings: None.
        context: The grid.
    """

    def __init__(self, settings: object, context: ContextLike) -> None:
        del settings
        self._shape = context.grid.shape

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """See nothing.

        Returns:
            An empty occupancy, bool (n_rows, n_cols), and no confidence, float32 (n_rows, n_cols).
        """
        del frame
        return np.zeros(self._shape, np.bool_), np.zeros(self._shape, np.float32)
