"""How fast pylon is with its emulated camera, printed by ``pytest -s``. More frames: LABSEQ_FRAMES=200."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from labseq_pylon.camera import PylonCamera
from labseq_pylon.library import load_pypylon
from labseq_pylon.settings import PylonSettings

from labseq import Context, Frame, SensorMode, SiteGrid
from labseq.roles import WHOLE_SENSOR, NeverStopped
from labseq.testing.fakes import RecordingSimulation

from .needs import need_library

N_FRAMES = int(os.environ.get("LABSEQ_FRAMES", "5"))
EXPOSURE_S = 1e-3


@pytest.fixture(autouse=True, scope="module")
def pypylon() -> None:
    need_library(lambda: load_pypylon("camera"))


class StillWorld(RecordingSimulation):
    """Shows the same picture for ever, so that drawing it takes no time."""

    picture = np.random.default_rng(0).poisson(530, (512, 512)).astype(np.uint16)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        del mode
        return Frame(self.picture, exposure_s, t_start_s)


def opened(settings: PylonSettings) -> PylonCamera:
    clock = NeverStopped()
    camera = PylonCamera(settings, Context("camera", SiteGrid(), clock=clock, simulation=StillWorld()))
    start_s = time.perf_counter()
    camera.open()
    print(f"open(): {1e3 * (time.perf_counter() - start_s):.0f} ms")
    return camera


def test_from_trigger_to_frame() -> None:
    camera = opened(PylonSettings(camera="simulated", readout=0.0))
    camera.arm(N_FRAMES, EXPOSURE_S, "software")
    took_s: list[float] = []
    first_s = time.perf_counter()
    for _ in range(N_FRAMES):
        start_s = time.perf_counter()
        camera.trigger()
        frame = camera.read(1.0)
        took_s.append(time.perf_counter() - start_s)
        assert frame.image.shape == (512, 512)
    rate_hz = N_FRAMES / (time.perf_counter() - first_s)
    camera.close()
    median_s, late_s = np.quantile(took_s, [0.5, 0.99])
    print(f"trigger to frame, 1 ms exposure: median {1e3 * median_s:.2f} ms, p99 {1e3 * late_s:.2f} ms")
    print(f"one by one: {rate_hz:.0f} frames/s")


def test_frames_in_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """pylon's own pictures, since a camera that runs by itself would not wait for others."""
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    region = {"height": 512, "width": 512}
    settings = {"camera": "0815-0000", "region": region, "pixel_format": "Mono16", "readout": 0.0}
    camera = opened(PylonSettings.model_validate(settings))
    camera._camera.ExposureTimeAbs.Value = 1e6 * EXPOSURE_S
    start_s = time.perf_counter()
    camera.arm(N_FRAMES, EXPOSURE_S, "internal")
    frames = [camera.read(1.0) for _ in range(N_FRAMES)]
    rate_hz = N_FRAMES / (time.perf_counter() - start_s)
    camera.close()
    assert [frame.number for frame in frames] == list(range(N_FRAMES))
    print(f"internal trigger, 1 ms exposure, 512 x 512 Mono16: {rate_hz:.0f} frames/s, none lost")
