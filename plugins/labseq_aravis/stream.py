"""The stream that receives a camera's frames, and their pixels."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from labseq_aravis.library import AravisError, Library, PixelFormatError
from labseq_aravis.sockets import buffer_size, set_buffer_size

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
"""Codes of the supported formats, by name, after the Pixel Format Naming Convention of GenICam."""


def unpacked(
    address: int, n_bytes: int, pixel_format: int, shape: tuple[int, int], padding: int = 0
) -> NDArray[np.uint16]:
    """Copy an image out of memory.

    Args:
        address: Address of its first byte.
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
    import numpy as np  # the process of a simulated camera starts faster without it

    if pixel_format not in MONO.values():
        raise PixelFormatError(pixel_format)
    height, width = shape
    dtype = np.dtype(np.uint8 if pixel_format == MONO["Mono8"] else "<u2")
    n_line = width * dtype.itemsize
    stride = n_line + padding
    if height * stride > n_bytes:
        text = f"a frame of {height} x {width} pixels has {n_bytes} bytes, not {height * stride}"
        raise AravisError(text, "size")
    raw = np.ctypeslib.as_array((ctypes.c_uint8 * (height * stride)).from_address(address))
    lines = raw.reshape(height, stride)[:, :n_line]
    return np.ascontiguousarray(lines).view(dtype).astype(np.uint16)  # always a copy


STATUS_NAMES: Final = (
    "success",
    "cleared",
    "timeout",
    "missing packets",
    "wrong packet id",
    "size mismatch",
    "filling",
    "aborted",
)
"""Names of the library's ``ArvBufferStatus``, from 0."""


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Options of a GigE stream, without effect for USB. None leaves the library's value.

    Attributes:
        packet_timeout_s: Time after which a missing packet is requested again.
        frame_retention_s: Time without a packet after which an incomplete frame is abandoned.
        resend: Whether missing packets are requested again.
    """

    packet_timeout_s: float | None = None
    frame_retention_s: float | None = None
    resend: bool = True


@dataclass(frozen=True, slots=True)
class Buffer:
    """A received frame, or the reason why it failed.

    Attributes:
        status: "success", or the reason why there is no image, one of :data:`STATUS_NAMES` or "unknown".
        frame_id: Number given by the camera. GigE cameras count 1 to 65535 and again from 1.
        camera_time_ns: Start of its transfer or exposure on the camera's clock, in nanoseconds.
        image: uint16 (height, width), a copy, None unless the status is "success".
    """

    status: str
    frame_id: int
    camera_time_ns: int
    image: NDArray[np.uint16] | None


class Stream:
    """Receives frames in the background. Made by :meth:`Camera.create_stream`."""

    def __init__(self, library: Library, handle: int, is_ethernet: bool, streams: list[Stream]) -> None:
        self._library = library
        self._handle: int | None = handle
        self._is_ethernet = is_ethernet
        self._streams = streams
        streams.append(self)

    def apply(self, options: StreamOptions, payload: int) -> None:
        """Set the options, for frames of ``payload`` bytes."""
        if not self._is_ethernet:
            return
        self._set("packet-resend", int(options.resend))
        for name, time_s in (
            ("packet-timeout", options.packet_timeout_s),
            ("frame-retention", options.frame_retention_s),
        ):
            if time_s is not None:
                self._set(name, round(time_s * 1e6))
        n_bytes = buffer_size(payload)
        self._set("socket-buffer", 0)  # fixed
        self._set("socket-buffer-size", n_bytes)
        # the library does so only when the first packet has come, too late for the others of its frame
        set_buffer_size(self._library.arv_gv_stream_get_port(self._open_handle()), n_bytes)

    def allocate(self, n_buffers: int, payload: int) -> None:
        """Add buffers of ``payload`` bytes each."""
        for _ in range(n_buffers):
            buffer = self._library.arv_buffer_new_allocate(payload)
            self._library.arv_stream_push_buffer(self._open_handle(), buffer)

    def close(self) -> None:
        """Stop receiving and free the buffers. Legal at any time, and repeatedly."""
        if self._handle is not None:
            self._library.g_object_unref(self._handle)
            self._handle = None
            self._streams.remove(self)

    def pop(self, timeout_s: float) -> Buffer | None:
        """Wait for the next frame, complete or not.

        Returns:
            The frame, None if none came in time.
        """
        handle = self._open_handle()
        buffer = self._library.arv_stream_timeout_pop_buffer(handle, max(0, round(timeout_s * 1e6)))
        if buffer is None:
            return None
        try:
            return self._read(buffer)
        finally:
            self._library.arv_stream_push_buffer(handle, buffer)

    def _read(self, buffer: int) -> Buffer:
        lib = self._library
        code = lib.arv_buffer_get_status(buffer)
        status = STATUS_NAMES[code] if 0 <= code < len(STATUS_NAMES) else "unknown"
        return Buffer(
            status,
            lib.arv_buffer_get_frame_id(buffer),
            lib.arv_buffer_get_timestamp(buffer),
            self._image(buffer) if status == "success" else None,
        )

    def _image(self, buffer: int) -> NDArray[np.uint16]:
        lib = self._library
        n_bytes, x_padding, y_padding = ctypes.c_size_t(), ctypes.c_int(), ctypes.c_int()
        address = lib.arv_buffer_get_image_data(buffer, ctypes.byref(n_bytes))
        if not address:
            raise AravisError("a buffer holds no image", "no image")
        lib.arv_buffer_get_image_padding(buffer, ctypes.byref(x_padding), ctypes.byref(y_padding))
        shape = lib.arv_buffer_get_image_height(buffer), lib.arv_buffer_get_image_width(buffer)
        pixel_format = lib.arv_buffer_get_image_pixel_format(buffer)
        return unpacked(address, n_bytes.value, pixel_format, shape, x_padding.value)

    def _set(self, name: str, value: int) -> None:
        self._library.set_property(self._open_handle(), name, value)

    def _open_handle(self) -> int:
        if self._handle is None:
            raise AravisError("the stream is closed; make another stream", "closed")
        return self._handle
