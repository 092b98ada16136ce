"""The virtual camera: its times, its triggers, and failures to rehearse."""

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
    TransientError,
)
from labseq.roles import offers
from labseq.testing.fakes import FakeClock, RecordingSimulation


class Lab:
    """A camera before a dark world."""

    def __init__(self, **settings: Any) -> None:
        self.clock = FakeClock()
        self.world = RecordingSimulation()
        context = Context("camera", clock=self.clock, random=RandomStream(0, "camera"), simulation=self.world)
        self.camera = VirtualCamera(CameraSettings.model_validate(settings), context)
        self.camera.open()

    def fire(self, n_frames: int, exposure_s: float = 1e-3) -> None:
        """Arm, and trigger each frame."""
        self.camera.arm(n_frames, exposure_s, "software")
        for _ in range(n_frames):
            self.camera.trigger()
            self.clock.sleep(exposure_s)

    def exposed_s(self) -> list[float]:
        """Start of each exposure of the world."""
        return [call.args[0] for call in self.world.calls]


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_a_frame_takes_exposure_and_read_out(lab: Lab) -> None:
    lab.clock.sleep(1.0)
    lab.camera.arm(1, 45e-3, "software")
    lab.camera.trigger()
    assert lab.clock.now() == 1.0
    frame = lab.camera.read(1.0)
    assert lab.clock.now() == pytest.approx(1.05)
    assert (frame.camera, frame.exposure_s, frame.t_start_s, frame.number) == ("camera", 45e-3, 1.0, 0)


def test_time_stamps_count_from_when_the_camera_was_opened() -> None:
    lab = Lab()
    lab.camera.close()
    lab.clock.sleep(100.0)
    lab.camera.open()
    lab.clock.sleep(0.5)
    lab.fire(1)
    assert lab.camera.read(1.0).device_time_s == pytest.approx(0.5)


def test_frames_come_in_the_order_of_their_triggers(lab: Lab) -> None:
    lab.fire(2, 10e-3)
    first, second = lab.camera.read(1.0), lab.camera.read(1.0)
    assert second.t_start_s - first.t_start_s == pytest.approx(10e-3)
    assert (first.number, second.number) == (0, 1)


def test_with_the_internal_trigger_exposures_follow_one_another_and_begin_when_read(lab: Lab) -> None:
    lab.clock.sleep(2.0)
    lab.camera.arm(3, 45e-3, "internal")
    assert lab.exposed_s() == []
    lab.clock.sleep(0.06)
    frames = [lab.camera.read(1.0) for _ in range(3)]
    assert [frame.t_start_s for frame in frames] == pytest.approx([2.0, 2.05, 2.1])
    assert lab.exposed_s() == [frame.t_start_s for frame in frames]
    assert lab.clock.now() == pytest.approx(2.15)
    with pytest.raises(DeviceTimeoutError, match="all 3 frames of the series were read"):
        lab.camera.read(0.1)


def test_a_short_wait_does_not_begin_another_exposure(lab: Lab) -> None:
    lab.camera.arm(2, 45e-3, "internal")
    for _ in range(3):
        with pytest.raises(DeviceTimeoutError, match="frame 1 of 2 is not ready"):
            lab.camera.read(0.01)
    assert lab.camera.read(0.1).t_start_s == 0.0
    assert lab.exposed_s() == [0.0]


def test_a_camera_that_is_not_armed_does_not_expose(lab: Lab) -> None:
    with pytest.raises(DeviceError, match=r"not armed.*arm\(\)"):
        lab.camera.trigger()
    lab.fire(1)
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


def test_no_wire_brings_an_external_trigger(lab: Lab) -> None:
    with pytest.raises(DeviceError, match="no external trigger; expected one of 'software', 'internal'"):
        lab.camera.arm(1, 0.1, "external")


def test_arming_and_the_safe_state_drop_old_frames(lab: Lab) -> None:
    for drop in (lambda: lab.camera.arm(1, 10e-3, "software"), lab.camera.safe_state):
        lab.fire(1)
        lab.clock.sleep(0.1)
        drop()
        with pytest.raises(DeviceTimeoutError):
            lab.camera.read(0.0)


def test_rehearsed_failures_come_with_their_probability() -> None:
    flaky = Lab(faults={"transient": 0.3})
    n_lost = 0
    for _ in range(100):
        flaky.fire(1)
        try:
            flaky.camera.read(1.0)
        except TransientError as error:
            assert str(error).startswith("camera: frame 1 was lost, of a series of 1: the frame arrived")
            n_lost += 1
    assert 12 < n_lost < 48


def test_a_missed_trigger_ends_in_a_timeout_and_leaves_the_atoms_in_the_dark() -> None:
    deaf = Lab(faults={"missed_trigger": 1.0})
    deaf.fire(1)
    with pytest.raises(DeviceTimeoutError, match="frame 1 of 1 is not ready"):
        deaf.camera.read(1.0)
    assert deaf.exposed_s() == []


def test_a_frame_lost_in_a_series_leaves_a_gap_in_the_numbers() -> None:
    lossy = Lab(faults={"lost_in_series": 0.5})
    lossy.fire(20)
    numbers, n_told = list[int](), 0
    for _ in range(40):
        try:
            numbers.append(lossy.camera.read(1.0).number)
        except TransientError as error:
            assert "frame numbers have a gap" in str(error)
            n_told += 1
        except DeviceTimeoutError:
            break
    assert len(lossy.exposed_s()) == 20
    assert 4 < len(numbers) < 16
    assert numbers == sorted(set(numbers))
    assert n_told == sum(b - a > 1 for a, b in zip([-1, *numbers], numbers, strict=False))


@pytest.mark.parametrize("trigger", ["software", "internal"])
def test_when_all_frames_are_lost_none_comes(trigger: Any) -> None:
    lossy = Lab(faults={"lost_in_series": 1.0})
    lossy.camera.arm(2, 1e-3, trigger)
    if trigger == "software":
        lossy.camera.trigger()
    with pytest.raises(DeviceTimeoutError, match="frame 1 of 2 is not ready"):
        lossy.camera.read(1.0)
    assert lossy.clock.now() == pytest.approx(1.0)


def test_a_late_frame_comes_when_it_comes() -> None:
    late = Lab(faults={"late": 1.0, "late_by": "3 s"})
    late.fire(1)
    with pytest.raises(DeviceTimeoutError, match="is not ready"):
        late.camera.read(2.0)
    assert late.camera.read(2.0).t_start_s == 0.0
    assert late.clock.now() == pytest.approx(3.006)


def test_the_self_test_takes_a_frame_and_leaves_none(lab: Lab) -> None:
    assert offers(lab.camera, "self_test")
    lab.camera.self_test()
    assert lab.clock.now() == pytest.approx(15e-3)
    lab.camera.arm(1, 10e-3, "software")
    with pytest.raises(DeviceTimeoutError, match="was not triggered"):
        lab.camera.read(0.1)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("missed_trigger", DeviceTimeoutError),
        ("lost_in_series", DeviceTimeoutError),
        ("late", DeviceTimeoutError),
        ("transient", TransientError),
    ],
)
def test_the_self_test_tells_when_no_frame_comes(fault: str, error: type[Exception]) -> None:
    with pytest.raises(error, match="frame"):
        Lab(faults={fault: 1.0, "late_by": "10 s"}).camera.self_test()
