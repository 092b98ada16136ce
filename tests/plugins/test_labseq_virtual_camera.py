"""The virtual camera."""

from __future__ import annotations

from typing import Any

import pytest
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.settings import CameraSettings

from labseq import (
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    RandomStream,
    SelfTesting,
    TransientError,
)
from labseq.testing.fakes import FakeClock, RecordingSimulation


class Lab:
    """A camera before a dark world."""

    def __init__(self, **settings: Any) -> None:
        self.clock = FakeClock()
        self.world = RecordingSimulation()
        context = Context("camera", clock=self.clock, random=RandomStream(0, "camera"), simulation=self.world)
        self.camera = VirtualCamera(CameraSettings.model_validate(settings), context)
        self.camera.open()


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_a_frame_takes_exposure_and_read_out(lab: Lab) -> None:
    start_s = lab.clock.now()
    lab.camera.arm(1, 45e-3, "software")
    lab.camera.trigger()
    assert lab.clock.now() == start_s
    frame = lab.camera.read(1.0)
    assert lab.clock.now() - start_s == pytest.approx(50e-3)
    assert frame.camera == "camera"
    assert frame.exposure_s == 45e-3
    assert frame.t_start_s == start_s


def test_frames_come_in_the_order_of_their_triggers(lab: Lab) -> None:
    lab.camera.arm(2, 10e-3, "software")
    for _ in range(2):
        lab.camera.trigger()
        lab.clock.sleep(10e-3)
    first, second = lab.camera.read(1.0), lab.camera.read(1.0)
    assert second.t_start_s - first.t_start_s == pytest.approx(10e-3)


def test_a_camera_that_is_not_armed_does_not_expose(lab: Lab) -> None:
    with pytest.raises(DeviceError, match=r"not armed.*arm\(\)"):
        lab.camera.trigger()
    lab.camera.arm(1, 10e-3, "software")
    lab.camera.trigger()
    lab.camera.read(1.0)
    with pytest.raises(DeviceError, match="not armed for another frame"):
        lab.camera.trigger()


def test_a_trigger_during_an_exposure_is_refused(lab: Lab) -> None:
    lab.camera.arm(2, 10e-3, "software")
    lab.camera.trigger()
    with pytest.raises(DeviceError, match="during an exposure"):
        lab.camera.trigger()


def test_reading_without_a_frame_waits_for_the_timeout(lab: Lab) -> None:
    lab.camera.arm(1, 45e-3, "software")
    start_s = lab.clock.now()
    with pytest.raises(DeviceTimeoutError, match="was not triggered") as caught:
        lab.camera.read(0.3)
    assert caught.value.timeout_s == 0.3
    assert lab.clock.now() - start_s == pytest.approx(0.3)
    lab.camera.trigger()
    with pytest.raises(DeviceTimeoutError, match="is not ready"):
        lab.camera.read(0.01)
    lab.camera.read(0.1)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, 11.0, float("nan")])
def test_an_exposure_out_of_range_is_refused(lab: Lab, exposure_s: float) -> None:
    with pytest.raises(LimitError, match="camera: exposure"):
        lab.camera.arm(1, exposure_s, "software")
    with pytest.raises(LimitError, match="number of frames"):
        lab.camera.arm(0, 0.1, "software")


def test_only_the_software_trigger_has_no_wire(lab: Lab) -> None:
    with pytest.raises(DeviceError, match="external trigger; expected 'software'"):
        lab.camera.arm(1, 0.1, "external")


def test_arming_and_the_safe_state_drop_old_frames(lab: Lab) -> None:
    for drop in (lambda: lab.camera.arm(1, 10e-3, "software"), lab.camera.safe_state):
        lab.camera.arm(1, 10e-3, "software")
        lab.camera.trigger()
        lab.clock.sleep(0.1)
        drop()
        with pytest.raises(DeviceTimeoutError):
            lab.camera.read(0.0)


def test_rehearsed_failures_come_with_their_probability() -> None:
    flaky = Lab(faults={"transient": 0.3})
    n_lost = 0
    for _ in range(100):
        flaky.camera.arm(1, 1e-3, "software")
        flaky.camera.trigger()
        try:
            flaky.camera.read(1.0)
        except TransientError as error:
            assert error.device == "camera"
            n_lost += 1
    assert 12 < n_lost < 48


def test_a_missed_trigger_ends_in_a_timeout_and_leaves_the_atoms_in_the_dark() -> None:
    deaf = Lab(faults={"missed_trigger": 1.0})
    deaf.camera.arm(1, 1e-3, "software")
    deaf.camera.trigger()
    with pytest.raises(DeviceTimeoutError):
        deaf.camera.read(1.0)
    assert deaf.world.calls.names() == []


def test_the_self_test_takes_a_frame_and_leaves_none(lab: Lab) -> None:
    assert isinstance(lab.camera, SelfTesting)
    lab.camera.self_test()
    assert lab.clock.now() == pytest.approx(15e-3)
    lab.camera.arm(1, 10e-3, "software")
    with pytest.raises(DeviceTimeoutError, match="was not triggered"):
        lab.camera.read(0.1)


@pytest.mark.parametrize(
    ("fault", "error"), [("missed_trigger", DeviceTimeoutError), ("transient", TransientError)]
)
def test_the_self_test_tells_when_no_frame_comes(fault: str, error: type[Exception]) -> None:
    with pytest.raises(error, match="frame"):
        Lab(faults={fault: 1.0}).camera.self_test()
