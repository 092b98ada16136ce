"""The pixels around the sites, and the frames that they stand on."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError, LimitError
from labseq.imaging.known_sites import GeometryLike, KnownSites
from labseq.model import Frame


class RegionsLike(GeometryLike, Protocol):
    """Where the sites are on the frames, and how wide a square of pixels each has; SI and pixels."""

    @property
    def region(self) -> int:
        """Width of the square of pixels, odd."""
        ...


def region_corners(known: KnownSites, region: int) -> NDArray[np.int64]:
    """(y, x) of the first pixel of each site's square, int64 (n_sites, 2), row by row.

    The square is centred on the pixel nearest to the site.

    Args:
        known: Where the sites are.
        region: Width of the squares, odd.

    Raises:
        LimitError: A square reaches over the edge of the frame.
    """
    height, width = known.frame
    corners = np.rint(known.positions_px.reshape(-1, 2)).astype(np.int64) - region // 2
    outside = np.any((corners < 0) | (corners + region > (height, width)), axis=1)
    if outside.any():
        first = int(np.argmax(outside))
        row, col = divmod(first, known.positions_px.shape[1])
        y, x = corners[first]
        last = region - 1
        raise LimitError(
            f"the region of interest of site ({row}, {col}), by {known.source},",
            f"rows {y} to {y + last} and columns {x} to {x + last} of the frame",
            f"a frame of {height} x {width} pixels",
            f"{known.remedy}; or take a smaller `region`",
        )
    return corners


def checked_image(frame: Frame, known: KnownSites, name: str) -> NDArray[np.uint16]:
    """The image of a frame of the size that the sites belong to.

    Raises:
        DeviceError: It is of another size or dtype; ``name`` is the detector's.
    """
    image = frame.image
    if image.shape != known.frame or image.dtype != np.uint16:
        height, width = known.frame
        raise DeviceError(
            name,
            f"the frame is {image.dtype} {image.shape}; by {known.source} the sites are on uint16 frames of "
            f"({height}, {width}); {known.remedy}",
        )
    return image
