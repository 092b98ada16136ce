"""The pixels around the sites, the frames that they stand on, and what is known of each site."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.imaging.sites import site_pixels
from labseq.model import Frame, SiteGrid

PerSite: TypeAlias = float | str | Path | Sequence[Sequence[float]]
"""One number for all sites, one for each, or the path of a .npy file with one for each."""


class ContextLike(Protocol):
    """What a detector needs of a ``labseq.Context``."""

    @property
    def name(self) -> str:
        """Role in the profile."""
        ...

    @property
    def grid(self) -> SiteGrid:
        """The grid of sites."""
        ...


class RegionsLike(Protocol):
    """Where the sites are on the frames, and how wide a square of pixels each has; SI and pixels."""

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
        """Width of the square of pixels, odd."""
        ...


def sites_on_frame(settings: RegionsLike, grid: SiteGrid) -> NDArray[np.float64]:
    """(y, x) of each site in pixels, float64 (n_sites, 2), row by row."""
    return site_pixels(grid, settings.pixel_size, settings.centre_px, settings.angle).reshape(-1, 2)


def region_corners(settings: RegionsLike, grid: SiteGrid) -> NDArray[np.int64]:
    """(y, x) of the first pixel of each site's square, int64 (n_sites, 2), row by row.

    The square is centred on the pixel nearest to the site.

    Raises:
        LimitError: A square reaches over the edge of the frame.
    """
    height, width = settings.frame
    corners = np.rint(sites_on_frame(settings, grid)).astype(np.int64) - settings.region // 2
    outside = np.any((corners < 0) | (corners + settings.region > (height, width)), axis=1)
    if outside.any():
        row, col = divmod(int(np.argmax(outside)), grid.n_cols)
        y, x = corners[np.argmax(outside)]
        last = settings.region - 1
        raise LimitError(
            f"the region of interest of site ({row}, {col})",
            f"rows {y} to {y + last} and columns {x} to {x + last} of the frame",
            f"a frame of {height} x {width} pixels",
            "check `centre_px`, `pixel_size`, `angle`, `region` and `frame` of the detector",
        )
    return corners


def checked_image(frame: Frame, shape: tuple[int, int], name: str) -> NDArray[np.uint16]:
    """The image of a frame of the size that the sites belong to.

    Raises:
        DeviceError: It is of another size or dtype; ``name`` is the detector's.
    """
    image = frame.image
    if image.shape != shape or image.dtype != np.uint16:
        height, width = shape
        raise DeviceError(
            name,
            f"the frame is {image.dtype} {image.shape}; the sites are known on uint16 frames of "
            f"({height}, {width}); set `detector.frame` and the coordinates for this camera, or crop it "
            "as it was when they were found",
        )
    return image


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
