"""How far the sites have moved on the camera, from averaged frames."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.model import Frame

Floats = NDArray[np.float64]

FURTHEST_PX: Final = 3.0
N_STEPS: Final = 12


class Shift(NamedTuple):
    """A common shift of all sites.

    Attributes:
        dy: Downwards, in pixels.
        dx: To the right.
        error: Standard error along each axis; inf if no site is lit, and the shift is then 0.
    """

    dy: float
    dx: float
    error: float


def measure_shift(image: NDArray[Any], positions_px: Floats, spot_px: float) -> Shift:
    """Measure how far the spots stand beside their calibrated places, all together.

    The light around each site is weighed by a Gaussian as wide as the spot; the
    weight's middle, the same for all sites, is moved until the mean moment about
    it is 0. There a background counts for nothing. Sites that are dark, or three
    times as bright as the others, are left out.

    Args:
        image: (height, width), one frame of the size that the sites belong to.
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site.
        spot_px: Width of the spots (1 sigma).

    Returns:
        The shift, good for 2 pixels, and 3 at most.
    """
    sites = positions_px.reshape(-1, 2)
    half = int(np.ceil(FURTHEST_PX + 2.5 * spot_px))
    span = np.arange(-half, half + 1)
    middles = np.rint(sites).astype(np.int64)
    y, x = (np.clip(middles[:, axis, None] + span, 0, image.shape[axis] - 1) for axis in (0, 1))
    patches = image[y[:, :, None], x[:, None, :]].astype(np.float64)
    patches -= np.median(patches[:, [0, -1]])
    offsets = middles[:, :, None] + span - sites[:, :, None]
    shift, error = np.zeros(2), np.inf
    for _ in range(N_STEPS):
        light, moments = _moments(patches, offsets - shift[:, None], spot_px)
        lit = _lit(light)
        total = light[lit].sum()
        if not total > 0:
            return Shift(0.0, 0.0, float("inf"))
        step = 2 * moments[lit].sum(axis=0) / total  # a weight as wide as the spot goes half way
        error = 2 * float(np.sqrt((moments[lit] ** 2).sum() / 2)) / total
        shift = np.clip(shift + np.clip(step, -1.0, 1.0), -FURTHEST_PX, FURTHEST_PX)
        if np.abs(step).max() < 1e-3:
            break
    return Shift(float(shift[0]), float(shift[1]), error)


def _moments(patches: Floats, offsets: Floats, spot_px: float) -> tuple[Floats, Floats]:
    """Weighted light of each site, (n_sites,), and its first moments along y and x, (n_sites, 2)."""
    weights = np.exp(-0.5 * (offsets / spot_px) ** 2)
    along_y, along_x = weights[:, 0], weights[:, 1]
    columns = np.matmul(along_y[:, None, :], patches)[:, 0]
    rows = np.matmul(patches, along_x[:, :, None])[:, :, 0]
    moment_y = (rows * along_y * offsets[:, 0]).sum(axis=1)
    moment_x = (columns * along_x * offsets[:, 1]).sum(axis=1)
    return (columns * along_x).sum(axis=1), np.stack([moment_y, moment_x], axis=1)


def _lit(light: Floats) -> NDArray[np.bool_]:
    dark, bright = np.quantile(light, [0.02, 0.97])
    lit = light > (dark + bright) / 2
    return lit & (light < 3 * np.median(light[lit])) if lit.any() else lit


class FrameAverage:
    """Adds frames up.

    Args:
        camera: Name of the camera, for messages.

    Example:
        >>> import numpy as np
        >>> average = FrameAverage()
        >>> for counts in (100, 200):
        ...     average.add(Frame(np.full((2, 3), counts, np.uint16), 0.045, 0.0))
        >>> average.n_frames, average.image[0].tolist()
        (2, [150.0, 150.0, 150.0])
    """

    def __init__(self, camera: str = "camera") -> None:
        self._camera = camera
        self._sum: NDArray[np.float64] | None = None
        self.n_frames = 0

    @property
    def image(self) -> NDArray[np.float64]:
        """Mean counts, float64 (height, width).

        Raises:
            DeviceError: There is no frame yet.
        """
        if self._sum is None:
            raise DeviceError(self._camera, "no frame was taken, so that there is no average")
        return self._sum / self.n_frames

    def add(self, frame: Frame) -> None:
        """Add a frame.

        Raises:
            DeviceError: It is of another size than those before.
        """
        if self._sum is None:
            self._sum = np.zeros(frame.image.shape)
        if frame.image.shape != self._sum.shape:
            raise DeviceError(
                self._camera,
                f"frame {self.n_frames} has {frame.image.shape} pixels, those before {self._sum.shape}; "
                "leave the camera's crop as it is during a calibration",
            )
        self._sum += frame.image
        self.n_frames += 1
