"""Frames, and the modes and limits of cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model.grid import read_only
from labseq.units import format_quantity

BLOCK: Final = 32
"""Number of rows that are transposed at once."""

Flip: TypeAlias = Literal["none", "rows", "columns", "both"]


@dataclass(frozen=True, slots=True)
class Orientation:
    """The orientation of an image relative to the frame from the sensor.

    Attributes:
        transpose: Whether rows and columns are exchanged, before the flip.
        flip: The order that is then reversed: "none", "rows" (upside down), "columns" (left to right), or
            "both".
    """

    transpose: bool = False
    flip: Flip = "none"

    def apply(self, frame: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The image (rows, columns), which is a view of the sensor's frame unless it is transposed.

        Example:
            >>> Orientation(transpose=True, flip="rows").apply(np.array([[1, 2], [3, 4]], np.uint16)).tolist()
            [[2, 4], [1, 3]]
        """
        axes = {"none": (), "rows": (0,), "columns": (1,), "both": (0, 1)}[self.flip]
        if self.transpose:  # blocks stay in the processor's cache, which is four times as fast
            turned = np.empty(frame.shape[::-1], frame.dtype)
            for first in range(0, len(frame), BLOCK):
                turned[:, first : first + BLOCK] = frame[first : first + BLOCK].T
            frame = turned
        return np.flip(frame, axes)

    def shape(self, frame_shape: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) of the image of a frame of (height, width) pixels."""
        height, width = frame_shape
        return (width, height) if self.transpose else (height, width)


@dataclass(frozen=True, slots=True)
class SensorMode:
    """How a sensor is exposed and read.

    Attributes:
        region: (y, x, height, width) of the part of the sensor that is read, in sensor pixels. None for the
            whole sensor.
        binning: Sensor pixels per pixel of a frame, along each axis.
        em_gain: Mean gain of the EM register. None if the camera sets no gain.
        shutter_open: Whether light reaches the sensor.
    """

    region: tuple[int, int, int, int] | None = None
    binning: int = 1
    em_gain: float | None = None
    shutter_open: bool = True

    def frame_shape(self, sensor_shape: tuple[int, int]) -> tuple[int, int]:
        """(height, width) of the frames that a sensor of this size delivers."""
        height, width = sensor_shape if self.region is None else self.region[2:]
        return height // self.binning, width // self.binning


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """Facts about a camera that are known from its settings, before it is opened.

    Attributes:
        readout_s: Time from the end of an exposure until the frame can be read, in seconds.
        max_exposure_s: Longest exposure, in seconds.
        frame_shape: (height, width) of its images, in their orientation. None if not known.
        em_gain: Mean gain of the EM register in an exposure. 1 for a camera without EM register.
        triggers: Possible triggers, of "software", "internal", "external", "external_start" and "bulb".
        min_exposure_s: Shortest exposure, in seconds. 0 if not known.
        arm_s: Time that arming for a series takes, in seconds. 0 if not known.
        line_trigger: The trigger that a line of the timing box gives.
        cycle_s: With "external_start", time between the starts of successive exposures, in seconds.
    """

    readout_s: float = 0.0
    max_exposure_s: float = float("inf")
    frame_shape: tuple[int, int] | None = None
    em_gain: float = 1.0
    triggers: tuple[str, ...] = ("software",)
    min_exposure_s: float = 0.0
    arm_s: float = 0.0
    line_trigger: str = "external"
    cycle_s: float = 0.0

    def check_exposure(self, exposure_s: float, camera: str = "camera") -> None:
        """Refuse an exposure that the camera cannot make.

        Raises:
            LimitError: The exposure is too short or too long.
        """
        if exposure_s > 0 and self.min_exposure_s <= exposure_s <= self.max_exposure_s:
            return
        came, low, high = (
            format_quantity(s, "time") for s in (exposure_s, self.min_exposure_s, self.max_exposure_s)
        )
        limit = f"{low} to {high}" if self.min_exposure_s else f"more than 0 and at most {high}"
        raise LimitError(f"{camera}: exposure", came, limit, "choose another exposure")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure, in the orientation that the profile sets.

    Attributes:
        image: uint16 (height, width), in camera counts (ADU), pixel (y, x).
        exposure_s: Exposure time, in seconds.
        t_start_s: Start of the exposure on the session's clock, in seconds.
        camera: Name of the camera.
        number: Index in its series as counted by the camera, from 0.
        device_time_s: The camera's own time stamp, in seconds with an arbitrary zero. nan if it gives none.
    """

    image: NDArray[np.uint16]
    exposure_s: float
    t_start_s: float
    camera: str = "camera"
    number: int = 0
    device_time_s: float = math.nan

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if image.dtype != np.uint16:  # raw data are never converted silently
            raise ValueError(f"a frame is uint16, not {image.dtype}")
        object.__setattr__(self, "image", read_only(image, np.uint16, (-1, -1), "image"))
