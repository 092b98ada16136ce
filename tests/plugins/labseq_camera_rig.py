"""For the tests of the camera drivers: a simulation that keeps its frames, and a driver that sees it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from labseq_andor.camera import AndorCamera
from labseq_andor.settings import AndorSettings
from labseq_genicam.camera import GenicamCamera
from labseq_genicam.settings import GenicamSettings
from labseq_pylablib.camera import PylablibCamera
from labseq_pylablib.settings import PylablibSettings
from labseq_pylon.camera import PylonCamera
from labseq_pylon.settings import PylonSettings
from numpy.typing import NDArray

from labseq import Frame, LineSpec
from labseq.model import SiteGrid
from labseq.plugin import Clock, Context, SensorMode
from labseq.roles import WHOLE_SENSOR, Trigger
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

DRIVERS: dict[str, tuple[Any, Any]] = {
    "andor": (AndorCamera, AndorSettings),
    "genicam": (GenicamCamera, GenicamSettings),
    "pylablib": (PylablibCamera, PylablibSettings),
    "pylon": (PylonCamera, PylonSettings),
}
"""Driver and settings."""

REQUIRED: dict[str, dict[str, Any]] = {"pylablib": {"interface": "dcam"}}
"""Settings without which a driver has no settings."""

NEEDED = {"genicam": "libaravis", "pylablib": "pylablib", "pylon": "pypylon"}
"""What the simulator of a camera needs beyond the group ``test``."""


def driver_param(name: str, *values: Any) -> Any:
    """A parameter of tests, the name of a driver and further values, with what the driver needs."""
    marks = [pytest.mark.needs(NEEDED[name])] if name in NEEDED else []
    return pytest.param(name, *values, marks=marks)


class NoisyWorld(RecordingSimulation):
    """Every frame is noise over the whole range of 16 bits; a line can be connected to the camera."""

    def __init__(self, clock: Clock, sensor_shape: tuple[int, int]) -> None:
        super().__init__(Calls(clock), sensor_shape)
        self._rng = np.random.default_rng(1)
        self.shown: list[NDArray[np.uint16]] = []
        self.modes: list[SensorMode] = []
        self.exposures: list[tuple[float, float]] = []

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        self.shown.append(self._rng.integers(0, 2**16, frame.image.shape).astype(np.uint16))
        self.modes.append(mode)
        self.exposures.append((t_start_s, exposure_s))
        return Frame(self.shown[-1], exposure_s, t_start_s)


class Rig:
    """A driver in a noisy simulation, on a virtual clock unless another is given; not open.

    With ``is_wired`` a line is connected to the camera's trigger input.
    """

    def __init__(
        self,
        driver: str,
        camera: str | None = "simulated",
        sensor_shape: tuple[int, int] = (96, 128),
        clock: Clock | None = None,
        is_wired: bool = False,
        **settings: Any,
    ) -> None:
        make, model = DRIVERS[driver]
        self.clock: Any = clock or FakeClock()
        self.world = NoisyWorld(self.clock, sensor_shape)
        lines = (LineSpec("shutter", 0, ("image",), triggers="camera"),) if is_wired else ()
        context = Context("camera", SiteGrid(), clock=self.clock, simulation=self.world, lines=lines)
        given = settings if camera is None else {"camera": camera, "arming_time": "0 s", **settings}
        given = REQUIRED.get(driver, {}) | given
        self.camera: Any = make(model.model_validate(given), context)

    @property
    def sim(self) -> Any:
        """The simulated Andor camera."""
        return self.camera.connection.camera

    @property
    def dcam(self) -> Any:
        """The simulated DCAM camera."""
        return self.camera.connection.simulated

    @property
    def genicam(self) -> Any:
        """The simulated GenICam camera, as libaravis has it."""
        return self.camera.connection.camera

    @property
    def pylon(self) -> Any:
        """pylon's own camera."""
        return self.camera.connection.camera

    def take(self, n_frames: int, exposure_s: float = 0.01, trigger: Trigger = "software") -> list[Frame]:
        """Trigger and read, one frame after the other."""
        self.camera.arm(n_frames, exposure_s, trigger)
        frames: list[Frame] = []
        for _ in range(n_frames):
            if trigger == "software":
                self.camera.trigger()
            elif trigger == "external":
                assert self.sim.trigger()
            frames.append(self.camera.read(2.0))
        return frames


@contextmanager
def opened_rig(driver: str, camera: str | None = "simulated", **settings: Any) -> Generator[Rig]:
    """A driver in a noisy simulation, open."""
    made = Rig(driver, camera, **settings)
    made.camera.open()
    try:
        yield made
    finally:
        made.camera.close()


def assert_shown(frames: list[Frame], lab: Rig) -> None:
    """Each frame is what the simulation showed, pixel for pixel, and nothing else was shown."""
    assert len(frames) == len(lab.world.shown)
    for frame, shown in zip(frames, lab.world.shown, strict=True):
        np.testing.assert_array_equal(frame.image, shown)


@st.composite
def sensors(draw: st.DrawFn, pixel_formats: tuple[str, ...]) -> dict[str, Any]:
    """Region, binning and pixel format that go with a sensor of 96 x 128 pixels."""
    binning = draw(st.integers(1, 4))
    region: dict[str, int] = {}
    for start, extent, size in (("y", "height", 96), ("x", "width", 128)):
        n_before = draw(st.integers(0, size // binning - 1))
        region[start] = binning * n_before
        region[extent] = binning * draw(st.integers(1, size // binning - n_before))
    made: dict[str, Any] = {"pixel_format": draw(st.sampled_from(pixel_formats)), "binning": binning}
    is_whole = binning != 3 and draw(st.booleans())
    return made if is_whole else made | {"region": region}
