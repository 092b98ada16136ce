"""The base of camera drivers: what it asks of a subclass, in which order, and what it refuses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import given, strategies as st

from labseq.plugin import CameraFacts, Context, DeviceError, DeviceTimeoutError, LimitError
from labseq.roles import Hardware, Trigger, overrides
from labseq.testing import CameraContract

from .cameras import SHAPE, Bench, TinyCamera


class TestTinyCamera(CameraContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], TinyCamera]:
        return lambda context: TinyCamera(context, CameraFacts(readout_s=1e-3, max_exposure_s=10.0))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_subclass_is_called_in_order() -> None:
    bench = Bench()
    camera = bench.camera
    camera.close()
    camera.log.clear()
    camera.open()
    camera.open()
    bench.fire(2)
    bench.read()
    bench.read()
    camera.close()
    assert camera.log == ["connect", "start", "fire", "fire", "take", "take", "stop", "disconnect"]


def test_a_connection_that_failed_is_undone_and_may_be_tried_again() -> None:
    camera = TinyCamera(Context("cam"), CameraFacts())
    camera.broken = {"connect", "disconnect"}
    with pytest.raises(RuntimeError, match="connect is broken"):  # what went wrong first
        camera.open()
    assert camera.log == ["connect", "disconnect"]
    with pytest.raises(DeviceError, match=r"^cam: not open; call open\(\) first"):
        camera.arm(1, 0.01, "software")
    camera.broken = set()
    camera.open()
    camera.arm(1, 0.01, "software")


def test_a_camera_that_was_never_open_is_disconnected_but_not_stopped() -> None:
    camera = TinyCamera(Context("cam"), CameraFacts())
    camera.safe_state()
    assert camera.log == []
    camera.close()
    assert camera.log == ["disconnect"]


def test_a_stop_that_fails_does_not_keep_the_camera_connected(bench: Bench) -> None:
    bench.camera.broken = {"stop"}
    with pytest.raises(RuntimeError, match="stop is broken"):
        bench.camera.close()
    assert bench.camera.log == ["stop", "disconnect"]
    with pytest.raises(DeviceError, match="not open"):
        bench.camera.trigger()


@given(st.floats() | st.sampled_from([0.0, -0.0, math.nan, math.inf, 10.0, 10.000001]))
def test_only_exposures_that_the_camera_can_make_reach_it(exposure_s: float) -> None:
    bench = Bench()
    if 0 < exposure_s <= 10.0:
        bench.camera.arm(1, exposure_s, "software")
        assert bench.camera.series[-1].exposure_s == exposure_s
    else:
        with pytest.raises(LimitError, match=r"^cam: exposure is .* at most 10 s"):
            bench.camera.arm(1, exposure_s, "software")
        assert bench.camera.log == []


def test_a_trigger_that_the_camera_does_not_have_is_refused() -> None:
    bench = Bench(triggers=("software", "external"))
    with pytest.raises(DeviceError, match=r"no internal trigger.*'software', 'external'"):
        bench.camera.arm(1, 0.01, "internal")
    assert bench.camera.log == []


def test_a_refusal_leaves_the_series_as_it_was(bench: Bench) -> None:
    bench.camera.arm(1, 0.01, "software")
    with pytest.raises(LimitError, match=r"^cam: number of frames is 0"):
        bench.camera.arm(0, 0.01, "software")
    bench.camera.trigger()
    assert bench.read().image.shape == SHAPE
    bench.camera.safe_state()
    with pytest.raises(DeviceTimeoutError, match="the camera is not armed"):
        bench.read()


def test_arming_again_ends_the_series_before_and_drops_its_frames(bench: Bench) -> None:
    bench.fire(3)
    bench.camera.arm(2, 0.02, "software")
    assert bench.camera.log == ["start", "fire", "fire", "fire", "stop", "start"]
    with pytest.raises(DeviceTimeoutError, match="the next one was not triggered"):
        bench.read()
    bench.camera.trigger()
    assert bench.read().number == 0


def test_a_start_that_fails_is_undone_and_leaves_the_camera_unarmed(bench: Bench) -> None:
    bench.camera.arm(1, 0.01, "software")
    bench.camera.broken = {"start"}
    with pytest.raises(RuntimeError, match="start is broken"):
        bench.camera.arm(1, 0.01, "software")
    assert bench.camera.log == ["start", "stop", "start", "stop"]
    with pytest.raises(DeviceError, match="without being armed"):
        bench.camera.trigger()


def test_a_trigger_during_an_exposure_is_refused(bench: Bench) -> None:
    bench.camera.arm(2, 0.5, "software")
    bench.camera.trigger()
    bench.clock.sleep(0.25)
    with pytest.raises(DeviceError, match=r"during an exposure that ends at 0\.500000 s"):
        bench.camera.trigger()
    bench.clock.sleep(0.25)
    bench.camera.trigger()


def test_a_software_trigger_belongs_to_a_series_with_one() -> None:
    bench = Bench(triggers=("external",))
    bench.camera.arm(1, 0.01, "external")
    with pytest.raises(DeviceError, match="armed for the external trigger"):
        bench.camera.trigger()
    bench.camera.log.clear()
    bench.camera.self_test()
    assert bench.camera.log == []  # it cannot be triggered


@pytest.mark.parametrize(
    ("trigger", "n_triggered", "n_read", "reason"),
    [
        ("software", 1, 0, "frame 0 is not ready, although its software trigger was sent"),
        ("software", 1, 1, "the next one was not triggered"),
        ("software", 3, 3, "all 3 frames of the series were read"),
        ("internal", 0, 1, "frame 1 needs no trigger, but is not ready"),
        ("external", 0, 0, "frame 0 waits for its external trigger, the line 'exposure'; check the cable"),
    ],
)
def test_a_timeout_says_why_and_takes_its_time(
    trigger: Trigger, n_triggered: int, n_read: int, reason: str
) -> None:
    bench = Bench(triggers=("software", "internal", "external"))
    bench.camera.arm(3, 1.0, trigger)
    for _ in range(n_triggered):
        bench.camera.trigger()
        if n_read:
            bench.clock.sleep(1.0)
    for _ in range(n_read):
        bench.read(2.0)
    if trigger == "internal":
        bench.camera.coming.clear()
    start_s = bench.clock.now()
    with pytest.raises(DeviceTimeoutError, match=f"^cam: no frame within 500 ms: {reason}$") as caught:
        bench.read(0.5)
    assert caught.value.timeout_s == 0.5
    assert bench.clock.now() - start_s == pytest.approx(0.5)


@given(st.integers(1, 5), st.floats(1e-3, 1.0))
def test_a_frame_carries_what_is_known_of_it(n_frames: int, exposure_s: float) -> None:
    bench = Bench()
    bench.clock.sleep(2.0)
    bench.fire(n_frames, exposure_s)
    frames = [bench.read() for _ in range(n_frames)]
    assert [frame.number for frame in frames] == list(range(n_frames))
    assert [int(frame.image[0, 0]) for frame in frames] == list(range(n_frames))
    for k, frame in enumerate(frames):
        assert frame.t_start_s == pytest.approx(2.0 + k * exposure_s)
        assert (frame.exposure_s, frame.camera) == (exposure_s, "cam")
        assert math.isnan(frame.device_time_s)


def test_what_the_camera_reports_goes_before_what_was_requested(bench: Bench) -> None:
    bench.camera.tells = {"exposure_s": 0.011, "t_start_s": 7.0, "device_time_s": 1e6}
    bench.fire(1)
    frame = bench.read()
    assert (frame.exposure_s, frame.t_start_s, frame.device_time_s) == (0.011, 7.0, 1e6)


def test_a_frame_of_its_own_accord_began_an_exposure_and_a_read_out_before_it_came() -> None:
    bench = Bench(triggers=("internal",))
    bench.camera.arm(1, 0.25, "internal")
    assert bench.read().t_start_s == pytest.approx(0.0)


def test_the_em_gain_is_on_in_a_series_and_1_in_the_self_test() -> None:
    bench = Bench(em_gain=300.0)
    bench.camera.self_test()
    bench.fire(1)
    assert [series.em_gain for series in bench.camera.series] == [1.0, 300.0]


@pytest.mark.parametrize(
    ("facts", "exposure_s"), [({}, 10e-3), ({"max_exposure_s": 1e-3}, 1e-3), ({"frame_shape": None}, 10e-3)]
)
def test_the_self_test_takes_a_short_frame(facts: Mapping[str, Any], exposure_s: float) -> None:
    bench = Bench(**facts)
    assert overrides(bench.camera, Hardware.self_test)
    bench.camera.self_test()
    assert bench.camera.log == ["start", "fire", "take"]
    assert bench.camera.series[0].exposure_s == exposure_s
    assert bench.clock.now() == pytest.approx(exposure_s + 5e-3)


def test_the_self_test_finds_a_frame_of_another_shape(bench: Bench) -> None:
    bench.camera.shape = (3, 5)
    with pytest.raises(DeviceError, match=r"\(3, 5\); expected \(3, 4\)"):
        bench.camera.self_test()
