"""A region of interest and a threshold per site: the paper's way to find the atoms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.imaging.sites import site_pixels
from labseq.model import Frame, Occupancy, SiteGrid


class ContextLike(Protocol):
    """What the detector needs of a ``labseq.Context``."""

    @property
    def name(self) -> str:
        """Role in the profile."""
        ...

    @property
    def grid(self) -> SiteGrid:
        """The grid of sites."""
        ...


class ThresholdLike(Protocol):
    """Settings of :class:`ThresholdDetector`; SI and pixels."""

    @property
    def frame(self) -> tuple[int, int]:
        """(height, width) of the frames that the coordinates belong to."""
        ...

    @property
    def centre_px(self) -> tuple[float, float]:
        """(y, x) of the grid's centre."""
        ...

    @property
    def pixel_size(self) -> float:
        """Size of a pixel in the atom plane, in metres."""
        ...

    @property
    def angle(self) -> float:
        """Rotation of the grid, in radians, clockwise on the screen."""
        ...

    @property
    def region(self) -> int:
        """Width of the region of interest, odd."""
        ...

    @property
    def shape(self) -> Literal["square", "disc"]:
        """Its shape."""
        ...

    @property
    def offset(self) -> float:
        """Counts of a dark pixel."""
        ...

    @property
    def threshold(self) -> float | str | Path | Sequence[Sequence[float]]:
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
        thresholds = _thresholds(settings.threshold, context.grid.shape)
        self._levels = thresholds + n_pixels * settings.offset

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Find the atoms.

        Returns:
            The occupancy, bool (n_rows, n_cols), and the confidence per site,
            float32 (n_rows, n_cols), 0 at the threshold and 1 for certainty.

        Raises:
            DeviceError: The frame is not of the size that the sites belong to.
        """
        image = frame.image
        if image.shape != self._frame_shape or image.dtype != np.uint16:
            height, width = self._frame_shape
            raise DeviceError(
                self._name,
                f"the frame is {image.dtype} {image.shape}; the sites are known on uint16 frames of "
                f"({height}, {width}); set `detector.frame` and the coordinates for this camera, or crop it "
                "as it was when they were found",
            )
        counts = image.take(self._pixels).sum(axis=0, dtype=np.uint32)
        distance = counts.reshape(self._grid_shape) - self._levels
        confidence = np.tanh(np.abs(distance) / self._width).astype(np.float32)
        return distance > 0.0, confidence


def _region_pixels(settings: ThresholdLike, grid: SiteGrid) -> NDArray[np.intp]:
    """Flat indices of the regions' pixels, (pixels of a region, n_sites): summed along rows of memory."""
    height, width = settings.frame
    centres = site_pixels(grid, settings.pixel_size, settings.centre_px, settings.angle)
    nearest = np.rint(centres).astype(np.intp).reshape(-1, 2)
    half = settings.region // 2
    outside = np.any((nearest < half) | (nearest + half >= (height, width)), axis=1)
    if outside.any():
        row, col = divmod(int(np.argmax(outside)), grid.n_cols)
        y, x = nearest[np.argmax(outside)]
        raise LimitError(
            f"the region of interest of site ({row}, {col})",
            f"rows {y - half} to {y + half} and columns {x - half} to {x + half} of the frame",
            f"a frame of {height} x {width} pixels",
            "check `centre_px`, `pixel_size`, `angle`, `region` and `frame` of the detector",
        )
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1]
    if settings.shape == "disc":
        inside = dy**2 + dx**2 <= (settings.region / 2) ** 2
        dy, dx = dy[inside], dx[inside]
    return (nearest[:, 0] + dy.reshape(-1, 1)) * width + nearest[:, 1] + dx.reshape(-1, 1)


def _thresholds(
    threshold: float | str | Path | Sequence[Sequence[float]], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """One threshold per site, float64 (n_rows, n_cols)."""
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
