"""Pixel formats."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Final

from labseq_genicam.aravis.errors import AravisError, PixelFormatError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MONO: Final = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono14": 0x01100025,
    "Mono16": 0x01100007,
}
"""Codes of the formats that are read here, by name, after the Pixel Format Naming Convention of GenICam."""

NAMES: Final = {code: name for name, code in MONO.items()}
"""Names of those formats, by code."""


def unpacked(
    address: int, n_bytes: int, pixel_format: int, shape: tuple[int, int], padding: int = 0
) -> NDArray[np.uint16]:
    """Copy an image out of memory.

    Args:
        address: Where it begins.
        n_bytes: Its size, in bytes.
        pixel_format: Code of its pixel format.
        shape: Height and width, in pixels.
        padding: Bytes that follow each line.

    Returns:
        The image, uint16 (height, width).

    Raises:
        PixelFormatError: The format is none of :data:`MONO`.
        AravisError: There are fewer bytes than the image has.
    """
    import numpy as np  # here, since the process of the simulated camera does without

    if pixel_format not in NAMES:
        raise PixelFormatError(pixel_format)
    height, width = shape
    dtype = np.dtype(np.uint8 if pixel_format == MONO["Mono8"] else "<u2")
    n_line = width * dtype.itemsize
    stride = n_line + padding
    if height * stride > n_bytes:
        text = f"a frame of {height} x {width} pixels has {n_bytes} bytes; expected {height * stride}"
        raise AravisError(text, "size")
    raw = np.ctypeslib.as_array((ctypes.c_uint8 * (height * stride)).from_address(address))
    lines = raw.reshape(height, stride)[:, :n_line]
    return np.ascontiguousarray(lines).view(dtype).astype(np.uint16)  # always a copy
