"""A ctypes binding of the C library Aravis for GigE Vision and USB3 Vision cameras, with any Python.

The library is loaded when a camera is first searched or opened. The package imports nothing of labseq, so
that the process of a simulated camera starts fast.
"""

from labseq_aravis.camera import Camera, FoundCamera, find_cameras
from labseq_aravis.library import (
    AravisError,
    LibraryMissingError,
    PixelFormatError,
    library_version,
    load_library,
)
from labseq_aravis.sockets import buffer_size, granted
from labseq_aravis.stream import Buffer, Stream, StreamOptions

__all__ = [
    "AravisError",
    "Buffer",
    "Camera",
    "FoundCamera",
    "LibraryMissingError",
    "PixelFormatError",
    "Stream",
    "StreamOptions",
    "buffer_size",
    "find_cameras",
    "granted",
    "library_version",
    "load_library",
]
