"""The mean of many frames, of which one is held at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.model import Frame


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
