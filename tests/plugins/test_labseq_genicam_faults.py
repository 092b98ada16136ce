"""What a client sees of a camera when things go wrong, each really done by the simulated one."""

from __future__ import annotations

import pytest
from labseq_genicam.aravis import AravisError, Camera
from labseq_genicam.aravis.library import library
from labseq_genicam.counterpart.faults import Faults, Setup, faults_from, setup_from, to_json

from .labseq_genicam_rig import WAIT_S, opened, plugged_in
from .needs import need_library

FAILED = ("missing packets", "timeout")
"""What a frame with lost packets is called: the first if a later one is whole before it is given up."""


@pytest.fixture(autouse=True)
def aravis() -> None:
    need_library(library)


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


def test_faults_reach_the_process_as_they_are() -> None:
    faults = Faults(0.1, (1, 5), 0.2, 7, is_busy=True, ignores_triggers=True, vendor="a", model="b")
    setup = Setup("S1", (512, 1024), "127.0.0.9", faults)
    assert faults_from(to_json(faults)) == faults
    assert setup_from(to_json(setup)) == setup
