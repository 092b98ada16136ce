"""Failures of a GenICam camera: the simulated one really fails."""

from __future__ import annotations

import ctypes
import re
import sys
from functools import partial
from typing import Any

import labseq_aravis.library as aravis_library
import pytest
from labseq_aravis import load_library
from labseq_genicam_sim.messages import Faults

from labseq import DeviceError, LimitError, TransientError
from labseq.errors import DeviceTimeoutError
from labseq.roles import NeverStopped

from .labseq_camera_rig import Rig, assert_shown, opened_rig
from .labseq_genicam_rig import WAIT_S, needs_aravis, plugged_in

unopened = partial(Rig, "genicam")
rig = partial(opened_rig, "genicam")

LARGE = (512, 512)
"""A sensor whose frames have so many packets that some of a failed one always come."""
GONE = "camera: the camera no longer answers; check its cable and power"


def opening(**settings: Any) -> DeviceError | LimitError:
    made = unopened(**settings)
    with pytest.raises((DeviceError, LimitError)) as caught:
        made.camera.open()
    made.camera.close()
    return caught.value


@needs_aravis
@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"camera": "127.255.0.9"}, "check its cable, power and network address"),
        ({"faults": {"busy": True}}, "another program controls it"),
        ({"model": "BFS-1"}, "the model Simulated, not BFS-1"),
        ({"serial": "7"}, "the serial number SIM1, not 7"),
        ({"pixel_format": "Mono14"}, "cannot be Mono14; the camera offers Mono8, Mono10"),
        ({"gain": 2000.0}, "gain is 2000; the limit is 0 to 1000"),
        ({"binning": 16}, "binning is 16; the limit is 1 to 8, in steps of 1"),
        (
            {"binning": 2, "region": {"y": 3, "x": 0, "height": 32, "width": 32}},
            "region's y is 3; the limit is 0 to 64, in steps of 2",
        ),
    ],
)
def test_what_the_camera_is_not_or_cannot_is_refused_when_it_is_opened(
    settings: dict[str, Any], text: str
) -> None:
    assert text in str(opening(**settings))


@needs_aravis
def test_a_region_beyond_the_cameras_sensor_is_refused() -> None:
    region = {"y": 0, "x": 2000, "height": 64, "width": 100}
    with plugged_in() as fake:
        error = str(opening(camera=fake.address, region=region))
    assert all(fact in error for fact in ("row 64, column 2100", "2048 x 2048"))


@needs_aravis
def test_a_failed_buffer_is_a_lost_frame_and_the_series_goes_on() -> None:
    faults = {"failed_frames": [1]}
    with rig(sensor_shape=LARGE, faults=faults, frame_timeout="50 ms") as lab:
        lab.camera.arm(3, 0.01, "software")
        lab.camera.trigger()
        frames = [lab.camera.read(1.0)]
        lab.camera.trigger()
        with pytest.raises(
            TransientError, match=r"frame 1 was lost from .* 3: .*network packets are missing"
        ):
            lab.camera.read(1.0)
        del lab.world.shown[1]
        lab.camera.trigger()
        frames.append(lab.camera.read(1.0))
        assert [frame.number for frame in frames] == [0, 2]
        assert_shown(frames, lab)


@needs_aravis
def test_a_limit_of_the_kernel_that_is_too_small_for_a_frame_is_named_with_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = "512 KiB may not fit .* 208 KiB; raise it with `sysctl -w net.core.rmem_max=2097152`"
    monkeypatch.setattr("labseq_genicam.aravis.granted", lambda _: 212992)
    with (
        plugged_in(faults=Faults(failed_frames=[0]), sensor_shape=LARGE) as fake,
        rig(fake.address, clock=NeverStopped(), frame_timeout="50 ms") as lab,
    ):
        (note,) = lab.camera.describe()["notes"]
        assert re.search(text, note)
        lab.camera.arm(1, 1e-3, "software")
        lab.camera.trigger()
        with pytest.raises(TransientError, match=f"network packets are missing; .*{text}"):
            lab.camera.read(WAIT_S)
    monkeypatch.setattr("labseq_genicam.aravis.granted", lambda n_bytes: n_bytes)
    with rig() as lab:
        assert lab.camera.describe()["notes"] == []


@needs_aravis
def test_frames_of_which_nothing_comes_are_missed_by_their_numbers() -> None:
    """The second and third frame: for the camera, not for the world, the line is cut between them."""
    with rig(sensor_shape=LARGE) as lab:
        lab.camera.arm(4, 0.01, "software")
        lab.camera.trigger()
        first = lab.camera.read(1.0)
        for _ in range(2):
            lab.camera.trigger()
            lab.clock.sleep(0.01)
            assert lab.camera.connection._stream.pop(WAIT_S) is not None
        lab.camera.trigger()
        with pytest.raises(
            TransientError, match=r"frames 1 to 2 were lost from a series of 4: .* have a gap"
        ):
            lab.camera.read(1.0)
        last = lab.camera.read(1.0)
        assert (last.number, last.t_start_s) == (3, pytest.approx(first.t_start_s + 0.035))
        assert [call.number for call in lab.take(2)] == [0, 1]


@needs_aravis
def test_a_frame_that_comes_too_late_is_a_timeout_and_does_not_turn_up_in_the_next_series() -> None:
    with rig(faults={"late_by": "100 ms"}) as lab:
        lab.camera.arm(1, 0.01, "software")
        lab.camera.trigger()
        with pytest.raises(DeviceTimeoutError, match="50 ms: frame 0 is not ready"):
            lab.camera.read(0.05)
        lab.camera.safe_state()
        del lab.world.shown[:]
        assert_shown(lab.take(2), lab)


@needs_aravis
def test_an_unplugged_camera_is_reported_once_and_nothing_waits_for_it_again() -> None:
    made = unopened(faults={"unplugged_at": 1})
    made.camera.open()
    made.camera.arm(3, 0.01, "software")
    made.camera.trigger()
    made.camera.read(1.0)
    made.camera.trigger()
    with pytest.raises(DeviceError, match=GONE):
        made.camera.read(1.0)
    for use in (
        lambda: made.camera.read(60.0),
        lambda: made.camera.arm(1, 0.01, "software"),
        made.camera.describe,
    ):
        with pytest.raises(DeviceError, match=GONE):
            use()
    made.camera.safe_state()
    made.camera.close()
    made.camera.open()
    del made.world.shown[:]
    assert_shown(made.take(1), made)
    made.camera.close()


@needs_aravis
def test_a_loss_that_the_library_notices_ends_a_wait() -> None:
    """It sends its signal 6 s after the last answer of the camera; here the test does."""
    with rig() as lab:
        lab.camera.arm(1, 0.01, "external")
        lib = load_library()
        device = ctypes.c_void_p(lib.arv_camera_get_device(lab.genicam._handle))
        lib._libraries[1].g_signal_emit_by_name(device, b"control-lost")
        with pytest.raises(DeviceError, match=GONE):
            lab.camera.read(60.0)


@needs_aravis
def test_a_software_trigger_that_is_not_seen_is_a_timeout() -> None:
    with rig(faults={"ignores_triggers": True}) as lab:
        lab.camera.arm(1, 0.01, "software")
        lab.camera.trigger()
        with pytest.raises(DeviceTimeoutError, match="frame 0 is not ready"):
            lab.camera.read(1.0)


@needs_aravis
def test_a_trigger_that_the_camera_does_not_have_is_refused() -> None:
    text = "trigger source cannot be Line9; the camera offers Software, Line1"
    with rig(trigger_line="Line9") as lab:
        with pytest.raises(DeviceError, match=text):
            lab.camera.arm(1, 0.01, "external")
        assert len(lab.take(1)) == 1


@needs_aravis
def test_exposures_beyond_the_cameras_limits_are_refused() -> None:
    with rig(max_exposure="60 s", frame_rate="200 Hz") as lab:
        with pytest.raises(LimitError, match=r"exposure is 20 s; .* 10 us to 10 s"):
            lab.camera.arm(1, 20.0, "software")
        with pytest.raises(LimitError, match=r"exposure is 1 us; .* 10 us to 10 s"):
            lab.camera.arm(1, 1e-6, "software")
        with pytest.raises(LimitError, match=r"frame rate is 200; .* 0\.1 to 100 per second"):
            lab.camera.arm(2, 0.01, "internal")
        assert len(lab.take(1)) == 1


@needs_aravis
def test_a_camera_that_reads_another_region_is_noticed() -> None:
    with rig(region={"y": 0, "x": 0, "height": 32, "width": 32}) as lab:
        lab.genicam.set("OffsetX", 5)
        lab.camera.arm(1, 0.01, "software")
        with pytest.raises(DeviceError, match=r"the camera reads .*\(0, 5, 32, 32, .*\), not"):
            lab.camera.trigger()


def test_without_the_library_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis_library, "_library", None)
    monkeypatch.setattr(aravis_library, "NAMES", {sys.platform: (("libnone.so.1", "none"),)})
    error = str(opening())
    assert all(fact in error for fact in ("camera", "apt-get install libaravis-0.8-0", "use: virtual"))
