"""What the Andor driver and pylablib cost, printed by ``pytest -s``. More frames: LABSEQ_FRAMES=200."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import pytest
from labseq_andor.camera import AndorCamera
from labseq_andor.library import load_pylablib
from labseq_andor.settings import AndorSettings

from labseq import Context, Frame, SensorMode, SiteGrid
from labseq.roles import WHOLE_SENSOR, NeverStopped
from labseq.testing.fakes import RecordingSimulation

from .needs import need_library

N_FRAMES = int(os.environ.get("LABSEQ_FRAMES", "5"))
EXPOSURE_S = 1e-3


@pytest.fixture(autouse=True, scope="module")
def pylablib() -> None:
    start_s = time.perf_counter()
    need_library(lambda: load_pylablib("camera"))
    print(f"import of pylablib: {time.perf_counter() - start_s:.2f} s")


class StillWorld(RecordingSimulation):
    """Shows the same picture for ever, so that drawing it takes no time."""

    picture = np.random.default_rng(0).poisson(530, (512, 512)).astype(np.uint16)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        shape = mode.frame_shape(self.picture.shape)
        return Frame(self.picture[: shape[0], : shape[1]], exposure_s, t_start_s)


def opened(**settings: Any) -> AndorCamera:
    context = Context("camera", SiteGrid(), clock=NeverStopped(), simulation=StillWorld())
    camera = AndorCamera(AndorSettings.model_validate({"camera": "simulated", **settings}), context)
    start_s = time.perf_counter()
    camera.open()
    print(f"open(): {1e3 * (time.perf_counter() - start_s):.0f} ms")
    return camera


def test_from_trigger_to_frame() -> None:
    camera = opened()
    camera.arm(N_FRAMES, EXPOSURE_S, "software")
    physics_s = EXPOSURE_S + camera.facts.readout_s
    took_s: list[float] = []
    for _ in range(N_FRAMES):
        start_s = time.perf_counter()
        camera.trigger()
        frame = camera.read(1.0)
        took_s.append(time.perf_counter() - start_s)
        assert frame.image.shape == (512, 512)
    camera.close()
    beyond_ms = 1e3 * (np.array(took_s) - physics_s)
    print(f"exposure and read-out: {1e3 * physics_s:.2f} ms; beyond them, over {N_FRAMES} frames:")
    print(f"median {np.median(beyond_ms):.2f} ms, p99 {np.percentile(beyond_ms, 99):.2f} ms")


def test_a_series_with_the_internal_trigger() -> None:
    region = {"y": 240, "x": 240, "height": 32, "width": 32}
    camera = opened(region=region, isolated_crop=True, frame_transfer=True)
    camera.arm(N_FRAMES, EXPOSURE_S, "internal")
    start_s = time.perf_counter()
    frames = [camera.read(1.0) for _ in range(N_FRAMES)]
    rate_hz = N_FRAMES / (time.perf_counter() - start_s)
    camera.close()
    assert [frame.number for frame in frames] == list(range(N_FRAMES))
    print(f"{rate_hz:.0f} frames/s of {1 / EXPOSURE_S:.0f}, isolated crop of 32 x 32, none lost")
