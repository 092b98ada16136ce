"""A camera image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.model.arrays import read_only


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What a camera can say of itself before it is opened, from its settings.

    Attributes:
        readout_s: From the end of an exposure until the frame can be read, in seconds.
        max_exposure_s: Longest exposure, in seconds.
        frame_shape: (height, width) of its frames; None if not known.
    """

    readout_s: float = 0.0
    max_exposure_s: float = float("inf")
    frame_shape: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure as the camera delivered it.

    Attributes:
        image: uint16 (height, width), in camera counts (ADU), pixel (y, x).
        exposure_s: Exposure time, in seconds.
        t_start_s: Start of the exposure on the session's clock, in seconds.
        camera: Name of the camera.
    """

    image: NDArray[np.uint16]
    exposure_s: float
    t_start_s: float
    camera: str = "camera"

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if image.dtype != np.uint16:  # never a silent conversion of raw data
            raise ValueError(f"a frame is uint16, not {image.dtype}")
        object.__setattr__(self, "image", read_only(image, np.uint16, (-1, -1), "image"))
