"""The simulated GigE Vision camera: a process of its own, with pixels from this one."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable

import numpy as np
import pytest
from labseq_aravis import AravisError, Camera, load_library
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults, Setup, to_json
from labseq_genicam_sim.network import n_waiting
from numpy.typing import NDArray

from .labseq_genicam_rig import REGION, WAIT_S, opened, pattern, plugged_in
from .needs import need_library

pytestmark = pytest.mark.usefixtures("aravis")


@pytest.fixture
def aravis() -> None:
    need_library(load_library)


def test_it_is_told_what_is_exposed() -> None:
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
    assert request.exposure_s == pytest.approx(0.045)
    assert request.gain == pytest.approx(12.5)
    assert [request.x, request.y, request.width, request.height] == list(REGION.values())
    assert (request.n, request.binning_y, request.binning_x) == (0, 1, 2)


@pytest.mark.parametrize("side", [512, 2048])
def test_the_whole_sensor_can_be_read_out(side: int) -> None:
    region = {"OffsetX": 0, "OffsetY": 0, "Width": side, "Height": side}
    with plugged_in(sensor_shape=(side, side)) as fake, opened(fake, region=region) as (camera, stream):
        assert camera.sensor_shape == (side, side)
        camera.trigger()
        buffer = stream.pop(WAIT_S)
    assert buffer is not None
    assert buffer.image is not None
    np.testing.assert_array_equal(buffer.image, pattern(Exposure(0, 0, 0, 0, 0, 0, side, side, 1, 1)))


def test_several_cameras_live_on_one_machine() -> None:
    with plugged_in() as first, plugged_in() as second:
        assert first.address != second.address
        with opened(first) as (one, frames), opened(second) as (other, others):
            one.trigger()
            other.trigger()
            assert frames.pop(WAIT_S) is not None
            assert others.pop(WAIT_S) is not None
        assert (first.n_begun, second.n_begun) == (1, 1)


def test_an_exposure_can_be_waited_for() -> None:
    goes_on = threading.Event()

    def expose(request: Exposure) -> NDArray[np.uint16]:
        goes_on.wait(WAIT_S)
        return pattern(request)

    with plugged_in(expose) as fake, opened(fake) as (camera, stream):
        n = fake.n_begun
        assert not fake.wait_for_exposure(n, 0.0)
        camera.trigger()
        assert fake.wait_for_exposure(n, WAIT_S)
        assert not fake.wait_for_exposure(n, 0.0, answered=True)
        goes_on.set()
        assert fake.wait_for_exposure(n, WAIT_S, answered=True)
        assert stream.pop(WAIT_S) is not None


def _raises(request: Exposure) -> NDArray[np.uint16]:
    raise RuntimeError(f"no light in exposure {request.n}")


def _has_wrong_shape(request: Exposure) -> NDArray[np.uint16]:
    return np.zeros((request.height, request.width + 1), np.uint16)


@pytest.mark.parametrize(("expose", "text"), [(_raises, "no light"), (_has_wrong_shape, "expected uint16")])
def test_an_exposure_that_goes_wrong_fails_its_frame_and_is_told(
    expose: Callable[[Exposure], NDArray[np.uint16]], text: str
) -> None:
    with plugged_in(expose) as fake, opened(fake) as (camera, stream):
        camera.trigger()
        buffer = stream.pop(WAIT_S)
        assert buffer is not None
        assert buffer.status in ("missing packets", "timeout")
        assert buffer.image is None
        with pytest.raises((RuntimeError, ValueError), match=text):
            fake.raise_pending()
        fake.raise_pending()


def test_it_stops_and_starts_again_at_its_address() -> None:
    fake = FakeCamera(pattern, serial="T2")
    fake.stop()
    fake.start()
    fake.start()
    address = fake.address
    fake.stop()
    fake.stop()
    assert not fake.is_running
    fake.start()
    try:
        assert fake.address == address
        with opened(fake) as (camera, stream):
            assert camera.serial == "T2"
            camera.trigger()
            assert stream.pop(WAIT_S) is not None
    finally:
        fake.stop()


def test_stopping_does_not_wait_for_a_frame() -> None:
    goes_on = threading.Event()

    def expose(request: Exposure) -> NDArray[np.uint16]:
        goes_on.wait(WAIT_S)
        return pattern(request)

    with plugged_in(expose) as fake, opened(fake) as (camera, _):
        camera.trigger()
        assert fake.wait_for_exposure(0, WAIT_S)
        fake.unplug()
        assert not fake.is_running
        goes_on.set()
        fake.start()  # or the client would wait for an answer when it closes


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


def test_messages_come_out_as_they_went_in() -> None:
    exposure = Exposure(1, 2, 3, 4, 5, 6, 7, 8, 9, 10)
    assert Exposure.from_bytes(exposure.to_bytes()) == exposure


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the table")
def test_the_cable_sees_what_waits_at_a_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        port = receiver.getsockname()[1]
        assert n_waiting(port) == 0
        receiver.sendto(bytes(1000), ("127.0.0.1", port))
        assert n_waiting(port) >= 1000
    assert n_waiting(port) == 0


# failures

FAILED = ("missing packets", "timeout")
"""What a frame with lost packets is called: the first if a later one is whole before it is given up."""


def test_lost_packets_fail_their_frames_and_are_counted() -> None:
    with plugged_in(faults=Faults(packet_loss=0.02)) as fake, opened(fake, trigger=None) as (camera, stream):
        buffers = [stream.pop(WAIT_S) for _ in range(20)]
        camera.stop()
        statistics = stream.statistics
    statuses = [buffer.status for buffer in buffers if buffer is not None]
    assert "success" in statuses
    assert set(statuses) & set(FAILED)
    assert all(
        (buffer.image is None) == (buffer.status != "success") for buffer in buffers if buffer is not None
    )
    assert statistics.n_failed > 0
    assert statistics.n_missing > 0


def test_one_failed_frame_does_not_touch_the_next() -> None:
    with plugged_in(faults=Faults(failed_frames=(1,))) as fake, opened(fake) as (camera, stream):
        statuses: list[str] = []
        for _ in range(3):
            camera.trigger()
            buffer = stream.pop(WAIT_S)
            assert buffer is not None
            statuses.append(buffer.status)
    assert statuses[::2] == ["success", "success"]
    assert statuses[1] in FAILED


def test_a_late_frame_comes_after_the_time_is_up() -> None:
    with plugged_in() as fake, opened(fake) as (camera, stream):
        fake.set_faults(Faults(late_s=0.3))
        camera.trigger()
        assert stream.pop(0.05) is None
        buffer = stream.pop(WAIT_S)
        assert buffer is not None
        assert buffer.status == "success"


def test_nobody_fires_a_line_trigger() -> None:
    with plugged_in() as fake, opened(fake, trigger="Line1") as (_, stream):
        assert stream.pop(0.2) is None
        assert fake.n_begun == 0


def test_software_triggers_can_be_ignored() -> None:
    with plugged_in(faults=Faults(ignores_triggers=True)) as fake, opened(fake) as (camera, stream):
        camera.trigger()
        assert stream.pop(0.2) is None
        assert fake.n_begun == 0


def test_another_model_is_told() -> None:
    faults = Faults(vendor="Other Cameras", model="OC-1 <&>")
    with plugged_in(faults=faults) as fake, Camera(fake.address) as camera:
        assert (camera.vendor, camera.model) == ("Other Cameras", "OC-1 <&>")


def test_a_camera_that_another_program_controls_is_refused_until_it_is_free() -> None:
    with plugged_in(faults=Faults(is_busy=True)) as fake:
        with pytest.raises(AravisError, match="controlled by another program") as caught:
            Camera(fake.address)
        assert caught.value.code == "not controller"
        fake.set_faults(Faults())
        with Camera(fake.address) as camera:
            assert camera.serial == "T1"


def test_a_camera_unplugged_in_a_series_is_lost() -> None:
    with plugged_in(faults=Faults(unplugged_at=1)) as fake, opened(fake) as (camera, stream):
        camera.trigger()
        assert stream.pop(WAIT_S) is not None
        camera.trigger()
        assert stream.pop(0.2) is None
        with pytest.raises(AravisError, match="timeout") as caught:
            camera.trigger()
        assert caught.value.code == "timeout"
        assert camera.wait_lost(WAIT_S)
        assert camera.is_lost
        assert not fake.is_running
        fake.set_faults(Faults())
        fake.start()  # plugged in again, it answers the client that lets go of it


def test_a_killed_camera_can_be_used_again_when_it_is_back() -> None:
    with plugged_in() as fake:
        with opened(fake) as (_, stream):
            fake.unplug()
            assert stream.pop(0.05) is None
            fake.start()
        with opened(fake) as (camera, stream):
            camera.trigger()
            buffer = stream.pop(WAIT_S)
        assert buffer is not None
        assert buffer.status == "success"


def test_setup_and_faults_reach_the_process_as_they_are() -> None:
    faults = Faults(0.1, (1, 5), 0.2, 7, is_busy=True, ignores_triggers=True, vendor="a", model="b")
    setup = Setup("S1", (512, 1024), "127.0.0.9", faults)
    assert Setup.from_json(to_json(setup)) == setup
