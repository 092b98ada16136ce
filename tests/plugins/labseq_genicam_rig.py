"""For the tests of the GenICam plugin: a simulated camera, a client that has it open, and the driver."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from labseq_aravis import Camera, Stream, StreamOptions
from labseq_genicam.camera import GenicamCamera
from labseq_genicam.settings import GenicamSettings
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults
from numpy.typing import NDArray

from labseq.model import SiteGrid
from labseq.plugin import Clock, Context, Frame, LineSpec, SensorMode
from labseq.roles import WHOLE_SENSOR
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

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
        camera.set_integer(feature, region[feature])


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
    trigger: str | None = "Software",
    region: Mapping[str, int] = REGION,
    pixel_format: str = "Mono16",
    n_buffers: int = 6,
) -> Generator[tuple[Camera, Stream]]:
    """A camera that acquires, and its stream."""
    with Camera(fake.address) as camera:
        camera.set_pixel_format(pixel_format)
        set_region(camera, region)
        camera.set_packet_size(PACKET_SIZE)
        camera.set_trigger(trigger)
        stream = camera.create_stream(n_buffers, StreamOptions(frame_retention_s=RETENTION_S, resend=False))
        camera.start()
        yield camera, stream


class NoisyWorld(RecordingSimulation):
    """Every frame is noise over the whole range of 16 bits; lines can be wired to the camera.

    Attributes:
        shown: The frames, in order.
        edge: Brings an edge of the camera's line, at a time.
    """

    def __init__(self, clock: Clock, sensor_shape: tuple[int, int]) -> None:
        super().__init__(Calls(clock), sensor_shape)
        self._rng = np.random.default_rng(1)
        self.shown: list[NDArray[np.uint16]] = []
        self.edge: Callable[[float], object] = lambda _: None

    def wire(self, role: str, on_edge: Callable[[float], object]) -> None:
        assert role == "camera"
        self.edge = on_edge

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        self.shown.append(self._rng.integers(0, 2**16, frame.image.shape).astype(np.uint16))
        return Frame(self.shown[-1], exposure_s, t_start_s)


class Rig:
    """The driver in a noisy world; not open.

    Args:
        camera: The setting `camera`.
        sensor_shape: (height, width) of the simulated sensor.
        clock: The session's clock; None for a virtual one.
        is_wired: Whether a line is wired to the camera's trigger input.
        settings: Further settings of the camera.
    """

    def __init__(
        self,
        camera: str | None = "simulated",
        sensor_shape: tuple[int, int] = (96, 128),
        clock: Clock | None = None,
        is_wired: bool = False,
        **settings: Any,
    ) -> None:
        self.clock = clock or FakeClock()
        self.world = NoisyWorld(self.clock, sensor_shape)
        wires = (LineSpec("shutter", 0, frozenset({"image"}), triggers="camera"),) if is_wired else ()
        context = Context("camera", SiteGrid(), clock=self.clock, simulation=self.world, lines=wires)
        given = {"camera": camera, **settings}
        self.camera = GenicamCamera(GenicamSettings.model_validate(given), context)

    def take(self, n_frames: int, exposure_s: float = 0.01) -> list[Frame]:
        """Trigger and read, one frame after the other."""
        self.camera.arm(n_frames, exposure_s, "software")
        frames: list[Frame] = []
        for _ in range(n_frames):
            self.camera.trigger()
            frames.append(self.camera.read(2.0))
        return frames


@contextmanager
def rig(camera: str | None = "simulated", **settings: Any) -> Generator[Rig]:
    """The driver in a noisy world, open."""
    made = Rig(camera, **settings)
    made.camera.open()
    try:
        yield made
    finally:
        made.camera.close()


def assert_shown(frames: list[Frame], lab: Rig) -> None:
    """Each frame is what the world showed, pixel for pixel, and nothing else was shown."""
    assert len(frames) == len(lab.world.shown)
    for frame, shown in zip(frames, lab.world.shown, strict=True):
        np.testing.assert_array_equal(frame.image, shown)
