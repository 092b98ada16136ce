"""Images for the simulated camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_genicam.aravis.pixels import MONO
from labseq_genicam.counterpart.description import GAIN_STEP
from labseq_genicam.counterpart.messages import Exposure

LARGEST: Final = {MONO["Mono8"]: 2**8 - 1, MONO["Mono10"]: 2**10 - 1, MONO["Mono12"]: 2**12 - 1}
"""Greatest value of a pixel, by pixel format."""


@dataclass(frozen=True, slots=True)
class Request:
    """An exposure that the camera begins.

    Attributes:
        n: Its number, from 0.
        exposure_s: Exposure time, in seconds.
        gain: The camera's gain; 0 unless it was set.
        x: First column of the region, in binned pixels.
        y: First row of the region, in binned pixels.
        width: Number of columns, in binned pixels.
        height: Number of rows, in binned pixels.
        binning: Pixels that are added up, vertically and horizontally.
    """

    n: int
    exposure_s: float
    gain: float
    x: int
    y: int
    width: int
    height: int
    binning: tuple[int, int]


def made(
    expose: Callable[[Request], NDArray[np.uint16]], exposure: Exposure
) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """Make the pixels of a frame, as the camera sends them.

    Args:
        expose: Makes its image.
        exposure: What the camera told of it.

    Returns:
        uint16 or, for Mono8, uint8 (height, width), little-endian.

    Raises:
        ValueError: The image is not uint16 (height, width) of the region.
        Exception: Whatever ``expose`` raises.
    """
    request = Request(
        exposure.n,
        exposure.exposure_us * 1e-6,
        exposure.gain * GAIN_STEP,
        exposure.x,
        exposure.y,
        exposure.width,
        exposure.height,
        (exposure.binning_y, exposure.binning_x),
    )
    image = expose(request)
    shape = (request.height, request.width)
    if image.shape != shape or image.dtype != np.uint16:
        text = f"the image of exposure {request.n} is {image.dtype} {image.shape}; expected uint16 {shape}"
        raise ValueError(text)
    largest = LARGEST.get(exposure.pixel_format)
    if largest is not None:
        image = np.minimum(image, np.uint16(largest))
    return np.ascontiguousarray(image, np.uint8 if exposure.pixel_format == MONO["Mono8"] else "<u2")
