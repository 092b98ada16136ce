"""For the tests of the GenICam plugin: a simulated camera, a client that has it open, and the driver."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from labseq_aravis import AravisError, Camera, Stream, StreamOptions
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults
from numpy.typing import NDArray

needs_aravis = pytest.mark.needs("libaravis")
REGION = {"OffsetX": 8, "OffsetY": 4, "Width": 256, "Height": 200}
PACKET_SIZE = 15800
RETENTION_S = 0.5
"""When an incomplete frame is abandoned: late enough for a busy machine."""
WAIT_S = 20.0
"""Longer than anything takes that comes at all."""


def pattern(request: Exposure) -> NDArray[np.uint16]:
    """Every pixel depends on its place on the sensor and on the number of the exposure."""
    rows = np.arange(request.y, request.y + request.height, dtype=np.uint16)[:, None]
    columns = np.arange(request.x, request.x + request.width, dtype=np.uint16)
    return (rows * 7 + columns + request.n * 1000).astype(np.uint16)


def set_region(camera: Camera, region: Mapping[str, int]) -> None:
    """Set the region; the sizes first, which limit the offsets."""
    for feature in ("Width", "Height", "OffsetX", "OffsetY"):
        camera.set(feature, region[feature])


@contextmanager
def plugged_in(
    expose: Callable[[Exposure], NDArray[np.uint16]] = pattern,
    faults: Faults | None = None,
    sensor_shape: tuple[int, int] = (2048, 2048),
) -> Generator[FakeCamera]:
    """A simulated camera that runs."""
    with FakeCamera(expose, serial="T1", sensor_shape=sensor_shape, faults=faults or Faults()) as fake:
        yield fake


@contextmanager
def opened(
    fake: FakeCamera,
    region: Mapping[str, int] = REGION,
    pixel_format: str = "Mono16",
    n_buffers: int = 6,
) -> Generator[tuple[Camera, Stream]]:
    """A camera that acquires, and its stream."""
    with Camera(fake.address) as camera:
        camera.set("PixelFormat", pixel_format)
        set_region(camera, region)
        camera.set_packet_size(PACKET_SIZE)
        camera.set("TriggerSource", "Software")
        camera.set("TriggerMode", "On")
        stream = camera.create_stream(n_buffers, StreamOptions(frame_retention_s=RETENTION_S, resend=False))
        camera.start()
        yield camera, stream
        with suppress(AravisError):  # the test has closed it
            camera.stop()
