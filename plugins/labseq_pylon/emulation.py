"""pylon's emulated camera, as the counterpart: it takes its pictures from files.

The emulated camera exposes on a software trigger, cuts the region out of a picture, converts its
pixels to the pixel format, and sends a buffer that pylon receives as it does any camera's. It reads the
n-th file of a folder when it takes the n-th frame of a series, and no sooner; so a file that is written
before the trigger is what that exposure sees. A file that was read is not read again in the same series.
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
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, Frame, Series, SimulatedSensor, Trigger
from labseq_pylon.finding import EMULATION
from labseq_pylon.library import Sdk
from labseq_pylon.nodes import Nodes
from labseq_pylon.settings import BITS, PixelFormat, PylonSettings

VARIABLE: Final = "PYLON_CAMEMU"
_LOCK: Final = threading.Lock()


class EmulatedCamera:
    """Feeds pylon's emulated camera with the exposures of the simulated world.

    Args:
        settings: Region, binning, read-out time.
        context: Clock and simulated world.

    Raises:
        ConfigError: There is no simulated world, it does not know its sensor, or the region is beyond that.
    """

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        world = settings.simulated_world(context)
        self._world = world
        self._sensor = SimulatedSensor(world, context.clock)
        self._clock = context.clock
        self._mode = settings.mode
        self._readout_s = settings.readout
        self._folder: Path | None = None
        self._remove: Callable[[], object] = lambda: None
        self._layer: Any = None  # keeps the device alive
        self._nodes: Nodes | None = None
        self._bits = 16
        self._trigger: Trigger = "software"
        self._n_exposed = self._n_waited_for = 0

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the simulated sensor."""
        return self._world.sensor_shape

    @property
    def waits_for_wire(self) -> bool:
        """Whether the series has the external trigger, whose line nothing pulls."""
        return self._trigger == "external"

    @property
    def runs_by_itself(self) -> bool:
        """Whether the series has the internal trigger, and the next exposure was not begun yet."""
        return self._trigger == "internal" and self._n_exposed == self._n_waited_for

    def warm(self) -> None:
        """Work out what all frames have in common."""
        self._world.prepare_sensor(self._mode)

    def device(self, sdk: Sdk) -> Any:
        """An emulated camera, pylon's device; several drivers may have the same, each its own one.

        Raises:
            DeviceError: pylon has none.
        """
        with sdk.doing("make an emulated camera"), shown():
            factory = sdk.pylon.TlFactory.GetInstance()
            layer: Any = factory.CreateTl(EMULATION)
            if layer is None or not (infos := layer.EnumerateDevices()):
                raise DeviceError(sdk.name, "this pylon has no emulated camera; install `pypylon` anew")
            self._layer = layer
            return layer.CreateDevice(infos[0])

    def set_up(self, nodes: Nodes) -> None:
        """Let an open emulated camera read files, of the simulated sensor's size where it goes so low."""
        for name, size in zip(("HeightMax", "WidthMax"), self.sensor_shape, strict=True):
            node = nodes.get((name,), "size")
            nodes.set_integer(node, "size", max(size, node.Min))
        nodes.choose(("TestImageSelector",), "test image", "Off")
        self._folder = Path(mkdtemp(prefix="labseq-pylon-"))
        self._remove = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._nodes = nodes

    def arm(self, series: Series, pixel_format: PixelFormat) -> None:
        """Get ready for a series, before the camera is started.

        The camera's own exposure is as long as that of the series, on a virtual clock as short as it can
        be. (It has a node ``ExposureTime`` too, which is checked and read back, but has no effect.)
        """
        assert self._nodes is not None
        nodes, self._bits, self._trigger = self._nodes, BITS[pixel_format], series.trigger
        self._n_exposed = self._n_waited_for = 0
        for number in range(series.n_frames):
            self._path(number).touch()
        nodes.get(("ImageFilename",), "image file").SetValue(str(self._path(0).parent))
        nodes.choose(("ImageFileMode",), "image file", "On")
        node = nodes.get(("ExposureTimeAbs",), "exposure")
        node.SetValue(
            node.Min if self._clock.virtual else min(max(1e6 * series.exposure_s, node.Min), node.Max)
        )
        self._sensor.arm(series, self._mode, self._readout_s)

    def expose(self) -> bool:
        """Begin an exposure on the session's clock, and put what it sees where the camera will look.

        Returns:
            Whether there was one left in the series.

        Raises:
            DeviceError: The world is further in time already.
        """
        frame = self._sensor.expose()
        if frame is None:
            return False
        self._path(self._n_exposed).write_bytes(tiff(self._picture(frame.image)))
        self._n_exposed += 1
        return True

    def wait(self, timeout_s: float) -> Frame | None:
        """Wait on the session's clock until the next frame could be read; None if that is later."""
        frame = self._sensor.take(timeout_s)
        self._n_waited_for += frame is not None
        return frame

    def drop(self, number: int) -> None:
        """Forget the picture of a frame that was taken."""
        self._path(number).write_bytes(b"")

    def clear(self) -> None:
        """Forget the series."""
        self._sensor.clear()

    def close(self) -> None:
        """Remove the files."""
        self._nodes = self._layer = None
        self._folder = None
        self._remove()

    def _path(self, number: int) -> Path:
        assert self._folder is not None
        return self._folder / f"{number:06d}.tif"

    def _picture(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The whole sensor, with a frame where the camera will cut its region, in the upper bits."""
        height, width = (size // self._mode.binning for size in self.sensor_shape)
        y, x = (start // self._mode.binning for start in (self._mode.region or (0, 0))[:2])
        picture = np.zeros((height, width), np.uint16)
        counts = np.minimum(image, 2**self._bits - 1) << (16 - self._bits)
        picture[y : y + image.shape[0], x : x + image.shape[1]] = counts
        return picture


def tiff(image: NDArray[np.uint16]) -> bytes:
    """An image as a TIFF file: one strip, not compressed.

    Args:
        image: uint16 (height, width).
    """
    height, width = image.shape
    tags = {
        256: width,
        257: height,
        258: 16,  # bits
        259: 1,  # not compressed
        262: 1,  # 0 is black
        273: 0,  # where the pixels begin, see below
        277: 1,  # one sample per pixel
        278: height,  # rows per strip
        279: image.nbytes,
    }
    tags[273] = 8 + 2 + 12 * len(tags) + 4
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    header = struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4)
    return header + image.astype("<u2").tobytes()


@contextmanager
def shown() -> Generator[None]:
    """Let pylon show emulated cameras; otherwise they never stand among real ones."""
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
