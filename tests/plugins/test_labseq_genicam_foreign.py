"""The GenICam driver with a camera that is not ours: that of Debian's package aravis-tools.

It sends a whole frame at once, as soon as it is triggered.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path

import pytest
from labseq_aravis import AravisError, Camera
from labseq_genicam.camera import GenicamCamera
from labseq_genicam.settings import GenicamSettings

import labseq
from labseq import Frame
from labseq.model import SiteGrid
from labseq.plugin import Context
from labseq.roles import NeverStopped

from .labseq_genicam_rig import WAIT_S

pytestmark = pytest.mark.needs("libaravis", "aravis-tools")

ADDRESS = "127.0.0.1"
SIZE = 512
COMPACT = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


@pytest.fixture(autouse=True)
def foreign() -> Generator[None]:
    """The camera runs at 127.0.0.1, whose port simulated cameras use for a moment when they start."""
    end_s = time.monotonic() + WAIT_S
    with ExitStack() as stack:
        while True:
            process = subprocess.Popen(
                ["arv-fake-gv-camera-0.8", "-i", ADDRESS],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            try:
                with Camera(ADDRESS) as camera:
                    answers = camera.vendor == "Aravis" and process.poll() is None
            except AravisError:
                answers = False
            if answers:
                break
            process.kill()
            assert time.monotonic() < end_s, f"port 3956 of {ADDRESS} is in use"
        yield


def camera_settings(pixel_format: str, packet_size: int) -> dict[str, object]:
    region = {"y": 0, "x": 0, "height": SIZE, "width": SIZE}
    settings = {"camera": ADDRESS, "pixel_format": pixel_format, "packet_size": packet_size}
    return {**settings, "region": region, "readout": "5 ms"}


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16"])
def test_no_first_frame_of_an_acquisition_is_lost(pixel_format: str) -> None:
    """The socket has its size before the first packet comes."""
    for packet_size in (1500, 9000, 15800):
        settings = GenicamSettings.model_validate(camera_settings(pixel_format, packet_size))
        camera = GenicamCamera(settings, Context("camera", SiteGrid(), clock=NeverStopped()))
        camera.open()
        frames = list[Frame]()
        for _ in range(5):
            camera.arm(1, 1e-3, "software")
            camera.trigger()
            frames.append(camera.read(WAIT_S))
            camera.safe_state()  # the next series begins with a new stream
        camera.close()
        assert [frame.image.shape for frame in frames] == 5 * [(SIZE, SIZE)]


@pytest.mark.parametrize("packet_size", [1500, 9000, 15800])
@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16"])
def test_shots_are_taken_in_the_first_attempt(pixel_format: str, packet_size: int, tmp_path: Path) -> None:
    chosen = {"use": "genicam", **camera_settings(pixel_format, packet_size)}
    overrides = [f"profile.camera={chosen}", "shot.2.rearrange.cycles=2"]
    with labseq.Session.open(COMPACT, shots=2, seed=1, overrides=overrides, output=tmp_path) as session:
        run = session.run()
    assert len(run.shots) == 2
    assert not run.attempts
