"""For the tests of the pylon plugin: a world that remembers what it showed, and cameras that look at it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
from labseq_pylon.camera import PylonCamera
from labseq_pylon.library import load_pypylon
from labseq_pylon.settings import PylonSettings
from numpy.typing import NDArray

from labseq.model import SiteGrid
from labseq.plugin import Context, Frame, SensorMode
from labseq.roles import WHOLE_SENSOR
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation


class NoisyWorld(RecordingSimulation):
    """Every frame is noise over the whole range of 16 bits.

    Attributes:
        shown: The frames, in order.
    """

    def __init__(self, calls: Calls, sensor_shape: tuple[int, int] = (96, 128)) -> None:
        super().__init__(calls, sensor_shape)
        self._rng = np.random.default_rng(1)
        self.shown: list[NDArray[np.uint16]] = []

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        self.shown.append(self._rng.integers(0, 2**16, frame.image.shape).astype(np.uint16))
        return Frame(self.shown[-1], exposure_s, t_start_s)


class Rig:
    """A camera in a noisy world, on a virtual clock; not open.

    Args:
        camera: The setting `camera`.
        sensor_shape: (height, width) of the simulated sensor.
        settings: Further settings of the camera.
    """

    def __init__(
        self, camera: str | None = "simulated", sensor_shape: tuple[int, int] = (96, 128), **settings: Any
    ) -> None:
        self.clock = FakeClock()
        self.world = NoisyWorld(Calls(self.clock), sensor_shape)
        self.context = Context("camera", SiteGrid(), clock=self.clock, simulation=self.world)
        given = {"camera": camera, **settings}
        self.camera = PylonCamera(PylonSettings.model_validate(given), self.context)

    def take(self, n_frames: int, exposure_s: float = 0.01) -> list[Frame]:
        """Trigger and read, one frame after the other."""
        self.camera.arm(n_frames, exposure_s, "software")
        frames: list[Frame] = []
        for _ in range(n_frames):
            self.camera.trigger()
            frames.append(self.camera.read(1.0))
        return frames

    @property
    def pylon(self) -> Any:
        """pylon's own camera."""
        return self.camera._camera


@contextmanager
def rig(camera: str | None = "simulated", **settings: Any) -> Generator[Rig]:
    """A camera in a noisy world, open."""
    made = Rig(camera, **settings)
    made.camera.open()
    try:
        yield made
    finally:
        made.camera.close()


def serial_numbers() -> list[str]:
    """Those of the cameras that pylon shows to everybody."""
    infos: Any = load_pypylon("test").pylon.TlFactory.GetInstance().EnumerateDevices()
    return [info.GetSerialNumber() for info in infos]
