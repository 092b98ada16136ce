"""The simulated GigE Vision camera: a process of its own, with pixels from this one."""

from __future__ import annotations

import os
import select
import subprocess
import sys

import numpy as np
import pytest
from labseq_aravis import AravisError, load_library
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults
from numpy.typing import NDArray

from .labseq_genicam_rig import REGION, WAIT_S, opened, pattern, plugged_in
from .needs import need_library

pytestmark = pytest.mark.usefixtures("aravis")


@pytest.fixture
def aravis() -> None:
    need_library(load_library)


def test_region_exposure_gain_and_binning_reach_what_makes_the_pixels() -> None:
    requests: list[Exposure] = []

    def expose(request: Exposure) -> NDArray[np.uint16]:
        requests.append(request)
        return pattern(request)

    with plugged_in(expose) as fake, opened(fake) as (camera, stream):
        camera.set_exposure_s(0.045)
        camera.set_gain(12.5)
        camera.set_binning(1, 2)
        camera.trigger()
        assert stream.pop(WAIT_S) is not None
    (request,) = requests
    assert (request.exposure_us, request.gain_steps) == (45_000, 12_500)
    assert [request.x, request.y, request.width, request.height] == list(REGION.values())
    assert (request.n, request.binning_y, request.binning_x) == (0, 1, 2)


def test_the_whole_sensor_can_be_read_out() -> None:
    region = {"OffsetX": 0, "OffsetY": 0, "Width": 2048, "Height": 2048}
    with plugged_in() as fake, opened(fake, region=region) as (camera, stream):
        camera.trigger()
        buffer = stream.pop(WAIT_S)
    assert buffer is not None
    assert buffer.image is not None
    np.testing.assert_array_equal(buffer.image, pattern(Exposure(0, 0, 0, 0, 0, 0, 2048, 2048, 1, 1)))


def test_an_exposure_that_goes_wrong_fails_its_frame_and_is_reported() -> None:
    def expose(request: Exposure) -> NDArray[np.uint16]:
        if request.n == 0:
            raise RuntimeError("no light in exposure 0")
        return pattern(request)[:, : -1 if request.n == 1 else None]

    with plugged_in(expose) as fake, opened(fake) as (camera, stream):
        for n in range(3):
            camera.trigger()
            assert fake.wait_for_image(n, WAIT_S)
        buffers = [stream.pop(WAIT_S) for _ in range(3)]
        assert [buffer is not None and buffer.image is not None for buffer in buffers] == [False, False, True]
        for text in ("no light", "expected uint16"):
            with pytest.raises((RuntimeError, ValueError), match=text):
                fake.raise_pending()
        fake.raise_pending()


def test_it_stops_and_starts_again_at_its_address() -> None:
    fake = FakeCamera(pattern, serial="T2")
    fake.stop()
    fake.start()
    address = fake.address
    for stop in (fake.stop, fake.unplug):
        fake.start()
        stop()
        stop()
        assert not fake.is_running
    with fake, opened(fake) as (camera, stream):
        assert (fake.address, camera.serial) == (address, "T2")
        camera.trigger()
        assert stream.pop(WAIT_S) is not None


def test_a_process_that_cannot_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_genicam_sim.fake.sys.executable", "/bin/false")
    with pytest.raises(AravisError, match="process of the simulated camera has ended"):
        FakeCamera(pattern).start()


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="only Linux waits for other processes' children")
def test_the_process_ends_with_its_parent() -> None:
    program = (
        "import os, numpy as np\n"
        "from labseq_genicam_sim.fake import FakeCamera\n"
        "fake = FakeCamera(lambda request: np.zeros((request.height, request.width), np.uint16))\n"
        "fake.start()\n"
        "print(fake._process.pid, flush=True)\n"
        "input()\n"
        "os._exit(1)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert parent.stdin is not None
    assert parent.stdout is not None
    with parent.stdin, parent.stdout:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        assert parent.wait(WAIT_S) != 0
        assert select.select([child], [], [], WAIT_S)[0]
        os.close(child)


def test_lost_packets_fail_their_frames() -> None:
    with plugged_in(faults=Faults(packet_loss=0.02)) as fake, opened(fake, trigger=None) as (camera, stream):
        buffers = [stream.pop(WAIT_S) for _ in range(12)]
        camera.stop()
    statuses = [buffer.status for buffer in buffers if buffer is not None]
    assert "success" in statuses
    assert {"missing packets", "timeout"} & {*statuses}  # the first if a later frame is whole before
