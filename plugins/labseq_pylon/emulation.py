"""pylon's emulated camera as the simulator, which takes its pictures from files.

The emulated camera exposes on a software trigger, cuts the region out of a picture, converts its pixels to
the pixel format, and sends a buffer that pylon receives as it does any camera's. It reads the n-th file of a
folder when it takes the n-th frame of a series, and not before, so a file that is written before the trigger
is the picture of that exposure. A file that was read is not read again in the same series.
"""

from __future__ import annotations

import os
import shutil
import struct
import threading
import weakref
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
from labseq_genicam.features import Nodes
from labseq_genicam.settings import BITS
from labseq_genicam.simulated import MAX_WAIT_S, SimulatedExposures
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, Frame
from labseq.plugin.camera import ExposureResult, Series
from labseq_pylon.connection import EMULATION, PylonConnection
from labseq_pylon.library import Sdk
from labseq_pylon.settings import PylonSettings

VARIABLE: Final = "PYLON_CAMEMU"
"""Environment variable with the number of emulated cameras that pylon lists."""

_LOCK: Final = threading.Lock()


class EmulatedConnection(SimulatedExposures, PylonConnection):
    """Gives the exposures of the simulation to pylon's emulated camera."""

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(settings, context)
        self.ready_s = MAX_WAIT_S  # on a busy computer it is slow
        self._folder: Path | None = None
        self._remove: Callable[[], object] = lambda: None
        self._layer: Any = None  # keeps the device alive
        self._nodes: Nodes | None = None
        self._bits = 16
        self._n_shown = 0

    def device(self, sdk: Sdk) -> Any:
        """Create an emulated camera. Each driver gets its own."""
        with sdk.doing("create an emulated camera"), listed():
            layer: Any = sdk.pylon.TlFactory.GetInstance().CreateTl(EMULATION)
            if layer is None or not (infos := layer.EnumerateDevices()):
                raise DeviceError(sdk.name, "this pylon has no emulated camera; reinstall `pypylon`")
            self._layer = layer
            return layer.CreateDevice(infos[0])

    def open(self) -> Nodes:
        """Open the camera, which reads files of the simulated sensor's size, or of its minimum size."""
        self._nodes = nodes = super().open()
        with self.doing("set its test image"):
            for feature, size in zip(("HeightMax", "WidthMax"), self._shape, strict=True):
                nodes.set(feature, max(size, nodes.bounds(feature, int)[0]))
            nodes.set("TestImageSelector", "Off")
        self._folder = Path(mkdtemp(prefix="labseq-pylon-"))
        self._remove = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        return nodes

    def arm(self, series: Series, period_s: float) -> None:
        """Get ready for a series, before the camera is started.

        The camera's own exposure is as long as the series', on a virtual clock as short as possible. (Its
        node ``ExposureTime`` is checked and read back, but has no effect.)
        """
        assert self._nodes is not None
        nodes, self._n_shown = self._nodes, 0
        for number in range(series.n_frames):
            self._path(number).touch()
        with self.doing("choose its image file"):
            self._bits = BITS[nodes.get("PixelFormat", str)]
            nodes.set("ImageFilename", str(self._path(0).parent))
            nodes.set("ImageFileMode", "On")
            shortest_us, longest_us = nodes.bounds("ExposureTimeAbs", float)
            own_us = min(max(1e6 * series.exposure_s, shortest_us), longest_us)
            nodes.set("ExposureTimeAbs", shortest_us if self._clock.virtual else own_us)
        super().arm(series, period_s)

    def show(self, frame: Frame) -> None:
        """Write the picture to the next file, and trigger the camera."""
        self._path(self._n_shown).write_bytes(tiff(self._picture(frame.image)))
        self._n_shown += 1
        self.fire()

    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next buffer, and empty its file."""
        taken = super().poll(seconds)
        if taken is not None and taken.number < self._n_shown:
            self._path(taken.number).write_bytes(b"")
        return taken

    @contextmanager
    def closing(self) -> Generator[None]:
        """The camera must be listed while it is closed, or pylon leaves its pipes open."""
        with listed():
            yield

    def close(self) -> None:
        """Release the camera, and remove the files."""
        try:
            super().close()
        finally:
            self._nodes = self._layer = self._folder = None
            self._remove()

    def _path(self, number: int) -> Path:
        assert self._folder is not None
        return self._folder / f"{number:06d}.tif"

    def _picture(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """A picture of the sensor with a frame in its region, in the upper bits, and zeros elsewhere."""
        mode = self._settings.mode
        height, width = (size // mode.binning for size in self._shape)
        y, x = (start // mode.binning for start in (mode.region or (0, 0))[:2])
        picture = np.zeros((height, width), np.uint16)
        counts = np.minimum(image, 2**self._bits - 1) << (16 - self._bits)
        picture[y : y + image.shape[0], x : x + image.shape[1]] = counts
        return picture


def tiff(image: NDArray[np.uint16]) -> bytes:
    """An image as an uncompressed TIFF file with one strip."""
    height, width = image.shape
    tags = {
        256: width,
        257: height,
        258: 16,  # bits
        259: 1,  # not compressed
        262: 1,  # 0 is black
        273: 0,  # offset of the pixels, see below
        277: 1,  # one sample per pixel
        278: height,  # rows per strip
        279: image.nbytes,
    }
    tags[273] = 8 + 2 + 12 * len(tags) + 4
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    header = struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4)
    return header + image.astype("<u2").tobytes()


@contextmanager
def listed() -> Generator[None]:
    """Make pylon list emulated cameras within the block, so that they never appear among real ones."""
    with _LOCK:
        before = os.environ.get(VARIABLE)
        os.environ[VARIABLE] = "1"
        try:
            yield
        finally:
            if before is None:
                del os.environ[VARIABLE]
            else:
                os.environ[VARIABLE] = before
