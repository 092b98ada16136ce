"""Cameras through the C library Aravis: GigE Vision and USB3 Vision, with any Python.

Nothing is loaded until a camera is looked for or opened.
"""

from labseq_genicam.aravis.camera import Camera, Region
from labseq_genicam.aravis.discovery import FoundCamera, find_cameras
from labseq_genicam.aravis.errors import AravisError, LibraryMissingError, PixelFormatError
from labseq_genicam.aravis.stream import Buffer, Statistics, Stream, StreamOptions

__all__ = [
    "AravisError",
    "Buffer",
    "Camera",
    "FoundCamera",
    "LibraryMissingError",
    "PixelFormatError",
    "Region",
    "Statistics",
    "Stream",
    "StreamOptions",
    "find_cameras",
]
