"""How fast frames come: no judgement of time here, but none may be lost.

``LABSEQ_FRAMES=500 pytest -s tests/plugins/test_labseq_genicam_speed.py --numprocesses=0`` measures.
"""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from labseq_aravis import load_library
from labseq_genicam_sim.messages import Exposure
from numpy.typing import NDArray

from labseq.roles import NeverStopped

from .labseq_genicam_rig import PACKET_SIZE, WAIT_S, opened, pattern, plugged_in, rig
from .needs import need_library

N_FRAMES = int(os.environ.get("LABSEQ_FRAMES", "25"))
REGION = {"OffsetX": 0, "OffsetY": 0, "Width": 512, "Height": 512}
N_BUFFERS = 6

IMAGE = pattern(Exposure(0, 0, 0, 0, 0, 0, 512, 512, 1, 1))


@pytest.fixture(autouse=True)
def aravis() -> None:
    need_library(load_library)


def _expose(request: Exposure) -> NDArray[np.uint16]:
    image = IMAGE.copy()
    image[0, 0] = request.n
    return image


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_no_frame_is_lost_at_full_rate(rate_hz: float) -> None:
    with (
        plugged_in(_expose) as fake,
        opened(fake, trigger=None, region=REGION, n_buffers=N_BUFFERS) as (camera, stream),
    ):
        camera.set_frame_rate_hz(rate_hz)
        stream.pop(WAIT_S)
        begun_s = time.perf_counter()
        numbers: list[int] = []
        for _ in range(N_FRAMES):
            buffer = stream.pop(WAIT_S)
            assert buffer is not None
            assert buffer.image is not None, (buffer.status, stream.statistics)
            numbers.append(int(buffer.image[0, 0]))
        duration_s = time.perf_counter() - begun_s
        camera.stop()
    print(f"\n{rate_hz:g}/s asked: {N_FRAMES / duration_s:.1f}/s came")
    assert numbers == list(range(1, N_FRAMES + 1))


def test_every_software_trigger_makes_a_frame() -> None:
    with plugged_in(_expose) as fake, opened(fake, region=REGION, n_buffers=N_BUFFERS) as (camera, stream):
        times_s: list[tuple[float, float]] = []
        for n in range(N_FRAMES):
            begun_s = time.perf_counter()
            camera.trigger()
            assert fake.wait_for_exposure(n, WAIT_S)
            exposed_s = time.perf_counter()
            buffer = stream.pop(WAIT_S)
            times_s.append((exposed_s - begun_s, time.perf_counter() - begun_s))
            assert buffer is not None
            assert buffer.image is not None, (buffer.status, stream.statistics)
            assert buffer.image[0, 0] == n
    for name, column in zip(("exposure", "frame"), np.array(times_s[1:]).T * 1e3, strict=True):
        print(
            f"\ntrigger to {name}: median {np.median(column):.1f} ms, p99 {np.percentile(column, 99):.1f} ms"
        )
    print(f"first trigger after the start: {times_s[0][1] * 1e3:.0f} ms")


@pytest.mark.parametrize("rate", ["100 Hz", "200 Hz"])
def test_the_driver_loses_no_frame_either(rate: str) -> None:
    settings = {"frame_rate": rate, "readout": "0 ms", "packet_size": PACKET_SIZE}
    with (
        plugged_in(_expose, sensor_shape=(512, 512)) as fake,
        rig(fake.address, clock=NeverStopped(), **settings) as lab,
    ):
        lab.take(1, 1e-3)
        lab.camera.arm(N_FRAMES, 1e-3, "internal")
        frames = [lab.camera.read(WAIT_S)]
        begun_s = time.perf_counter()
        frames += [lab.camera.read(WAIT_S) for _ in range(N_FRAMES - 1)]
        duration_s = time.perf_counter() - begun_s
    print(f"\ndriver, {rate} asked: {(N_FRAMES - 1) / duration_s:.1f}/s came")
    assert [frame.number for frame in frames] == list(range(N_FRAMES))
    assert [frame.image[0, 0] for frame in frames] == list(range(1, N_FRAMES + 1))


def test_one_series_after_the_other_costs_the_driver_no_more_than_a_frame() -> None:
    settings = {"readout": "0 ms", "packet_size": PACKET_SIZE}
    with (
        plugged_in(_expose, sensor_shape=(512, 512)) as fake,
        rig(fake.address, clock=NeverStopped(), **settings) as lab,
    ):
        lab.take(1, 1e-4)
        times_s: list[float] = []
        for n in range(N_FRAMES):
            begun_s = time.perf_counter()
            (frame,) = lab.take(1, 1e-4)
            times_s.append(time.perf_counter() - begun_s)
            assert frame.image[0, 0] == n + 1
    median_s, late_s = np.quantile(times_s, [0.5, 0.99])
    print(f"\ndriver, arm to frame: median {median_s * 1e3:.1f} ms, p99 {late_s * 1e3:.1f} ms")
