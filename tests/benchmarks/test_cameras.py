"""Benchmarks: the camera drivers with their simulated cameras, in real time, 512 x 512 pixels.

Times include exposure and read-out: 1 ms, and with the settings used here 17.5 ms for Andor and 1.8 ms for
pylablib.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from typing import Any, Final

import numpy as np
import pytest
from labseq_andor.camera import AndorCamera
from labseq_andor.settings import AndorSettings
from labseq_genicam.camera import GenicamCamera
from labseq_genicam.settings import GenicamSettings
from labseq_pylablib.camera import PylablibCamera
from labseq_pylablib.settings import PylablibSettings
from labseq_pylon.camera import PylonCamera
from labseq_pylon.settings import PylonSettings

from labseq.plugin import Context, Frame, SensorMode, SiteGrid
from labseq.plugin.camera import CameraDriver
from labseq.roles import WHOLE_SENSOR, NeverStopped
from labseq.testing.fakes import RecordingSimulation

N_FRAMES: Final = int(os.environ.get("LABSEQ_FRAMES", "5"))
EXPOSURE_S: Final = 1e-3


class StillWorld(RecordingSimulation):
    """Always shows the same picture, so that drawing it takes no time."""

    picture = np.random.default_rng(0).poisson(530, (512, 512)).astype(np.uint16)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        height, width = mode.frame_shape(self.picture.shape)
        return Frame(self.picture[:height, :width], exposure_s, t_start_s)


def andor(context: Context) -> CameraDriver:
    return AndorCamera(AndorSettings.model_validate({"camera": "simulated"}), context)


def genicam(context: Context) -> CameraDriver:
    settings = {"camera": "simulated", "readout": "0 ms", "frame_rate": "100 Hz"}
    return GenicamCamera(GenicamSettings.model_validate(settings), context)


def pylablib(context: Context) -> CameraDriver:
    settings = {"camera": "simulated", "interface": "dcam", "arming_time": "0 ms"}
    return PylablibCamera(PylablibSettings.model_validate(settings), context)


def pylon(context: Context) -> CameraDriver:
    return PylonCamera(PylonSettings.model_validate({"camera": "simulated", "readout": "0 ms"}), context)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(andor, id="andor"),
        pytest.param(genicam, id="genicam", marks=pytest.mark.needs("libaravis")),
        pytest.param(pylablib, id="pylablib", marks=pytest.mark.needs("pylablib")),
        pytest.param(pylon, id="pylon", marks=pytest.mark.needs("pypylon")),
    ],
)
def camera(request: pytest.FixtureRequest) -> Generator[CameraDriver]:
    make: Callable[[Context], CameraDriver] = request.param
    context = Context("camera", SiteGrid(), clock=NeverStopped(), simulation=StillWorld())
    camera = make(context)
    camera.open()
    yield camera
    camera.close()


def test_from_arming_to_a_frame(benchmark: Any, camera: CameraDriver) -> None:
    benchmark.group = "camera: arm, software trigger, read"

    def take() -> Frame:
        camera.arm(1, EXPOSURE_S, "software")
        camera.trigger()
        return camera.read(5.0)

    assert benchmark(take).image.shape == (512, 512)


def test_a_series_with_the_internal_trigger(benchmark: Any, camera: CameraDriver) -> None:
    benchmark.group = f"camera: {N_FRAMES} frames with the internal trigger"

    def take() -> list[int]:
        camera.arm(N_FRAMES, EXPOSURE_S, "internal")
        return [camera.read(5.0).number for _ in range(N_FRAMES)]

    assert benchmark(take) == list(range(N_FRAMES))
