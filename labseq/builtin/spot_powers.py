"""The power of each static tweezer, fitted on frames of a camera that looks at their light."""

from __future__ import annotations

from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.detection.lattice import find_lattice
from labseq.detection.spots import KnownSpots, without_hot_pixels
from labseq.errors import DeviceError
from labseq.model import Frame, SiteGrid

Floats = NDArray[np.float64]

MISSING: Final = 0.2
"""Power of a spot, relative to the median, below which it counts as missing."""

MIN_CONTRAST: Final = 100
"""Counts above the median from which equal counts of several pixels mean that they are saturated."""

NAMED: Final = 5
"""Maximum number of sites that a message names."""


class SpotPowers:
    """Fits the power of each spot on frames of one camera.

    The first frame gives the place of every spot and the shape that all have in common, a Gaussian. With
    these fixed, the powers and the stray light between the spots are fitted on each frame by least squares.
    An error of the shape changes all powers by the same factor.

    Args:
        grid: The grid of sites, which must be on the frame as a whole; see :func:`find_lattice`.
        camera: Name of the camera, for messages.
    """

    def __init__(self, grid: SiteGrid, camera: str) -> None:
        self._grid, self._camera = grid, camera
        self._known: KnownSpots | None = None

    def fit(self, frame: Frame) -> Floats:
        """The power of each spot, float64 (n_rows, n_cols), in counts.

        Raises:
            DeviceError: A spot is saturated or missing, or the spots are no lattice such as the grid's.
        """
        self._refuse_saturated(frame.image)
        known = self._known = self._known or self._find(frame)
        power = known.fit(without_hot_pixels(frame.image))
        faint = power < MISSING * np.median(power)
        if faint.any():
            self._refuse_missing(faint.reshape(self._grid.shape))
        return power.reshape(self._grid.shape)

    def _refuse_saturated(self, image: NDArray[np.uint16]) -> None:
        """Raise if a pixel has the largest count of 8 to 16 bits, or if several share the largest one."""
        highest, n_sites = int(image.max()), self._grid.n_rows * self._grid.n_cols
        n_equal = int(np.count_nonzero(image == highest))
        is_full = highest >= 0xFF and highest & (highest + 1) == 0
        is_flat = n_equal > max(4, n_sites // 50) and highest > np.median(image) + MIN_CONTRAST
        if is_full or is_flat:
            pixels = "1 pixel is" if n_equal == 1 else f"{n_equal} pixels are"
            self._refuse(f"{pixels} saturated ({highest} counts); shorten the exposure")

    def _find(self, frame: Frame) -> KnownSpots:
        try:
            found = find_lattice(frame.image, self._grid)
        except DeviceError as error:
            self._refuse(str(error).partition(": ")[2])
        if not found.found.all():
            self._refuse_missing(~found.found)
        places = found.positions_px + found.residuals_px
        return KnownSpots(found.frame, places.reshape(-1, 2), found.spot_px)

    def _refuse_missing(self, missing: NDArray[np.bool_]) -> NoReturn:
        sites = [f"({row}, {col})" for row, col in np.argwhere(missing).tolist()]
        more = ", ..." if len(sites) > NAMED else ""
        what = f"{len(sites)} of {missing.size} spots are missing or not on the lattice of the others"
        self._refuse(
            f"{what}: {', '.join(sites[:NAMED])}{more}; are all tones on, and is nothing in the way?"
        )

    def _refuse(self, why: str) -> NoReturn:
        raise DeviceError(self._camera, f"no powers from its frame of the static tweezers: {why}")
