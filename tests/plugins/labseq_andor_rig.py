"""For the tests of the Andor plugin: a world that remembers what it showed, and a camera that looks at it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
from labseq_andor.camera import AndorCamera
from labseq_andor.settings import AndorSettings
from labseq_andor_sim import SimulatedAndorLibrary, SimulatedCamera
from numpy.typing import NDArray

from labseq.model import SiteGrid
from labseq.plugin import Clock, Context, Frame, SensorMode
from labseq.roles import WHOLE_SENSOR, Trigger
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation


class NoisyWorld(RecordingSimulation):
    """Every frame is noise over the whole range of 16 bits.

    Attributes:
        shown: The frames, in order.
        modes: How the sensor was exposed for each.
    """

    def __init__(self, calls: Calls, sensor_shape: tuple[int, int]) -> None:
        super().__init__(calls, sensor_shape)
        self._rng = np.random.default_rng(1)
        self.shown: list[NDArray[np.uint16]] = []
        self.modes: list[SensorMode] = []

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        self.shown.append(self._rng.integers(0, 2**16, frame.image.shape).astype(np.uint16))
        self.modes.append(mode)
        return Frame(self.shown[-1], exposure_s, t_start_s)


class Rig:
    """A camera in a noisy world; not open.

    Args:
        sensor_shape: (height, width) of the simulated sensor.
        clock: A virtual one if it is not given.
        settings: Settings of the camera.

    Attributes:
        sim: The simulated camera.
    """

    def __init__(
        self, sensor_shape: tuple[int, int] = (96, 128), clock: Clock | None = None, **settings: Any
    ) -> None:
        virtual = FakeClock()
        self.clock = clock or virtual
        self.world = NoisyWorld(Calls(virtual), sensor_shape)
        self.context = Context("camera", SiteGrid(), clock=self.clock, simulation=self.world)
        given = {"camera": "simulated", **settings}
        self.camera = AndorCamera(AndorSettings.model_validate(given), self.context)
        assert isinstance(self.camera.library, SimulatedAndorLibrary)
        self.library = self.camera.library
        self.sim: SimulatedCamera = self.library.camera

    def take(self, n_frames: int, exposure_s: float = 0.01, trigger: Trigger = "software") -> list[Frame]:
        """Trigger and read, one frame after the other."""
        self.camera.arm(n_frames, exposure_s, trigger)
        frames: list[Frame] = []
        for _ in range(n_frames):
            if trigger == "software":
                self.camera.trigger()
            elif trigger == "external":
                assert self.sim.trigger()
            frames.append(self.camera.read(1.0))
        return frames


@contextmanager
def rig(
    sensor_shape: tuple[int, int] = (96, 128), clock: Clock | None = None, **settings: Any
) -> Generator[Rig]:
    """A camera in a noisy world, open."""
    made = Rig(sensor_shape, clock, **settings)
    made.camera.open()
    try:
        yield made
    finally:
        made.camera.close()
