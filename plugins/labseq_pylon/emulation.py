"""pylon's emulated camera as the simulator: it takes its pictures from files.

The emulated camera exposes on a software trigger, cuts the region out of a picture, converts its pixels to
the pixel format, and sends a buffer that pylon receives as it does any camera's. It reads the n-th file of a
folder when it takes the n-th frame of a series, and not before; so a file that is written before the trigger
is what that exposure sees. A file that was read is not read again in the same series.
"""

from __future__ import annotations

import os
import shutil
import struct
import threading
import weakref
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, Trigger, wait_for
from labseq.plugin.camera import ExposureResult, Series, SimulatedSensor
from labseq.plugin.lines import trigger_line
from labseq_pylon.acquisition import Acquisition
from labseq_pylon.connection import EMULATION, CameraConnection
from labseq_pylon.library import Nodes, Sdk
from labseq_pylon.settings import BITS, PixelFormat, PylonSettings

VARIABLE: Final = "PYLON_CAMEMU"
"""Environment variable with the number of emulated cameras that pylon lists."""

MAX_WAIT_S: Final = 5.0
"""How long the emulated camera may take, in real time, for a frame that is due on the session's clock, and
until it accepts a trigger: on a busy computer it is slow."""

_LOCK: Final = threading.Lock()


class EmulatedCamera(CameraConnection):
    """Gives the exposures of the simulation to pylon's emulated camera."""

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._world, self._shape = settings.simulated_world(context)
        self.sensor_shape = self._shape
        self.ready_s = MAX_WAIT_S
        self._sensor = SimulatedSensor(self._world, context.clock)
        self._mode = settings.mode
        self._readout_s = settings.readout
        self._folder: Path | None = None
        self._remove: Callable[[], object] = lambda: None
        self._layer: Any = None  # keeps the device alive
        self._nodes: Nodes | None = None
        self._bits = 16
        self._trigger: Trigger = "software"
        self._n_exposed = self._n_frames = 0
        self._is_wired = trigger_line(context.lines, "camera") is not None

    def warm(self) -> None:
        """Compute what all frames have in common."""
        self._world.prepare_sensor(self._mode)

    def device(self, sdk: Sdk) -> Any:
        """Create an emulated camera; each driver gets its own."""
        with sdk.doing("create an emulated camera"), listed():
            layer: Any = sdk.pylon.TlFactory.GetInstance().CreateTl(EMULATION)
            if layer is None or not (infos := layer.EnumerateDevices()):
                raise DeviceError(sdk.name, "this pylon has no emulated camera; reinstall `pypylon`")
            self._layer = layer
            return layer.CreateDevice(infos[0])

    def set_up(self, nodes: Nodes) -> tuple[int, int]:
        """Make the camera read files of the simulated sensor's size, or of its minimum size."""
        for name, size in zip(("HeightMax", "WidthMax"), self._shape, strict=True):
            node = nodes.get("size", name)
            nodes.set_integer(node, "size", max(size, node.Min))
        nodes.choose("TestImageSelector", "test image", "Off")
        self._folder = Path(mkdtemp(prefix="labseq-pylon-"))
        self._remove = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._nodes = nodes
        return self._shape

    def trigger_of(self, series: Series) -> Trigger:
        """The internal trigger and edges of lines are made by software, when there is a picture to take."""
        is_real = series.trigger not in ("software", "internal") and not self._is_wired
        return series.trigger if is_real else "software"

    def arm(self, series: Series, pixel_format: PixelFormat, acquisition: Acquisition) -> None:
        """Get ready for a series, before the camera is started.

        The camera's own exposure is as long as that of the series; on a virtual clock it is as short as
        possible. (Its node ``ExposureTime`` is checked and read back, but has no effect.)
        """
        assert self._nodes is not None
        nodes, self._bits, self._trigger = self._nodes, BITS[pixel_format], series.trigger
        self._n_exposed, self._n_frames = 0, series.n_frames
        for number in range(series.n_frames):
            self._path(number).touch()
        nodes.get("image file", "ImageFilename").SetValue(str(self._path(0).parent))
        nodes.choose("ImageFileMode", "image file", "On")
        node = nodes.get("exposure", "ExposureTimeAbs")
        own_us = min(max(1e6 * series.exposure_s, node.Min), node.Max)
        node.SetValue(node.Min if self._clock.virtual else own_us)
        if series.trigger not in ("software", "internal"):
            self._sensor.follow_line(partial(self.fire, acquisition))
        arm_s, cycle_s = self._settings.arming_time, self._settings.cycle_time or 0.0
        self._sensor.arm(series, self._mode, self._readout_s, arm_s=arm_s, cycle_s=cycle_s)

    def fire(
        self, acquisition: Acquisition, t_s: float | None = None, exposure_s: float | None = None
    ) -> None:
        """Expose, now or at ``t_s`` of the clock, write the picture to the next file, and trigger it."""
        if self._n_exposed == self._n_frames:
            return
        acquisition.wait_until_ready()
        frame = self._sensor.expose(t_start_s=t_s, exposure_s=exposure_s)
        if frame is not None:
            self._path(self._n_exposed).write_bytes(tiff(self._picture(frame.image)))
            self._n_exposed += 1
            acquisition.trigger()

    def wait(self, acquisition: Acquisition, timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until the next frame is due, then in real time until it has come."""
        if self._trigger not in ("software", "internal") and not self._is_wired:
            return super().wait(acquisition, timeout_s)
        start_s = self._clock.now()
        self._sensor.expose_next(partial(self.fire, acquisition), timeout_s)
        frame = self._sensor.take(max(0.0, timeout_s - (self._clock.now() - start_s)))
        if frame is None:
            return None
        taken = wait_for(acquisition.poll, MAX_WAIT_S, self._clock)
        if taken is None:
            return None
        self._path(taken.number).write_bytes(b"")
        return replace(taken, t_start_s=frame.t_start_s)

    def clear(self) -> None:
        """Forget the series."""
        self._n_frames = self._n_exposed
        self._sensor.clear()

    @contextmanager
    def closing(self) -> Generator[None]:
        """The camera must be listed while it is closed, or pylon leaves its pipes open."""
        with listed():
            yield

    def close(self) -> None:
        """Remove the files."""
        self._nodes = self._layer = self._folder = None
        self._remove()

    def _path(self, number: int) -> Path:
        assert self._folder is not None
        return self._folder / f"{number:06d}.tif"

    def _picture(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """A picture of the whole sensor with a frame in its region, in the upper bits; zeros elsewhere."""
        height, width = (size // self._mode.binning for size in self._shape)
        y, x = (start // self._mode.binning for start in (self._mode.region or (0, 0))[:2])
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
