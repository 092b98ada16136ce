"""The GenICam camera: what the simulation shows comes through GigE Vision, every pixel of it."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_genicam.aravis import LAST_ID, FrameCounter
from labseq_genicam.features import Features
from labseq_genicam.settings import BITS, StandardSettings
from labseq_genicam.standard import frame_period_s, set_exposure, set_trigger, temperature_k
from labseq_genicam_sim.messages import Exposure
from numpy.typing import NDArray

from labseq import Frame
from labseq.errors import DeviceTimeoutError
from labseq.plugin import SensorMode
from labseq.plugin.camera import Series
from labseq.roles import NeverStopped, Trigger

from .labseq_camera_rig import assert_shown, opened_rig, sensors
from .labseq_genicam_rig import PACKET_SIZE, WAIT_S, needs_aravis, plugged_in

rig = partial(opened_rig, "genicam")


@needs_aravis
def test_the_camera_goes_on_waiting_from_one_series_to_the_next() -> None:
    with rig() as lab:
        lab.take(1)
        stream = lab.camera.connection._stream
        for n_frames in (3, 12):
            del lab.world.shown[:]
            assert_shown(lab.take(n_frames), lab)
        assert lab.camera.connection._stream is stream


@needs_aravis
def test_a_series_that_is_broken_off_costs_the_next_one_no_packet() -> None:
    """The first frame of a stream must fit into the buffer that a socket has by default."""
    with rig(sensor_shape=(512, 512)) as lab:
        for _ in range(3):
            lab.camera.arm(2, 0.01, "software")
            lab.camera.trigger()
            lab.clock.sleep(0.01)
            lab.camera.safe_state()
            del lab.world.shown[:]
            assert_shown(lab.take(1), lab)


@needs_aravis
def test_on_a_real_clock_it_exposes_in_turn_and_shows_no_more_than_was_armed() -> None:
    with rig(clock=NeverStopped(), readout="1 ms", frame_rate="200 Hz") as lab:
        for n_frames in (4, 10):
            del lab.world.shown[:]
            lab.camera.arm(n_frames, 0.002, "internal")
            frames = [lab.camera.read(WAIT_S) for _ in range(n_frames)]
            assert [frame.number for frame in frames] == list(range(n_frames))
            assert np.diff([frame.t_start_s for frame in frames]) == pytest.approx(0.005)
            assert_shown(frames, lab)
        del lab.world.shown[:]
        assert_shown(lab.take(1), lab)


@needs_aravis
@settings(max_examples=4)
@given(sensor=sensors(tuple(name for name in BITS if name != "Mono14")))
def test_the_world_shows_the_region_that_the_camera_reads(sensor: dict[str, Any]) -> None:
    with rig(**sensor) as lab:
        about = lab.camera.facts.frame_shape
        (frame,) = lab.take(1)
        features = ("OffsetY", "OffsetX", "Height", "Width")
        read = [lab.genicam.get(feature, int) for feature in features]
    wanted = sensor.get("region") or {"y": 0, "x": 0, "height": 96, "width": 128}
    binned = [wanted[key] // sensor["binning"] for key in ("y", "x", "height", "width")]
    assert read == binned
    assert about == tuple(binned[2:])
    largest = 2 ** int(sensor["pixel_format"].removeprefix("Mono")) - 1
    np.testing.assert_array_equal(frame.image, np.minimum(lab.world.shown[0], largest))


@needs_aravis
def test_a_computer_that_is_slow_costs_no_time_on_a_virtual_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_genicam.aravis.CHECK_PERIOD_S", 1e-3)
    with rig(readout="5 ms") as lab:
        connection, asked = lab.camera.connection, list[None]()
        pop = connection._pop
        monkeypatch.setattr(connection, "check_alive", lambda: asked.append(None))
        monkeypatch.setattr(connection, "_pop", lambda s: pop(s) if len(asked) > 2 else None)
        frames = lab.take(1, 0.01)
        assert len(asked) >= 3  # the frame itself may take longer than such a period
        assert lab.clock.now() == pytest.approx(0.015)
        assert_shown(frames, lab)


@needs_aravis
def test_the_camera_answers_while_its_image_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long that takes: a busy computer's camera is not gone."""
    with rig() as lab:
        expose, connection = lab.world.expose, lab.camera.connection

        def slow(t_start_s: float, exposure_s: float, mode: SensorMode) -> Frame:
            connection.check_alive()
            return expose(t_start_s, exposure_s, mode)

        monkeypatch.setattr(lab.world, "expose", slow)
        assert_shown(lab.take(2), lab)


@needs_aravis
def test_it_says_what_it_is_and_what_it_took() -> None:
    with rig(gain=6.0, packet_size=9000, packet_delay="1 us", binning=2, serial="SIM1") as lab:
        lab.take(1, np.float64(0.02))
        about = json.loads(json.dumps(dict(lab.camera.describe()), allow_nan=False))
        assert lab.camera.facts.max_exposure_s == 10.0
        assert lab.genicam.packet_delay_s == pytest.approx(1e-6)
    expected = {"vendor": "labseq", "model": "Simulated", "serial_number": "SIM1", "pixel_format": "Mono16"}
    expected |= {"frame_shape": [48, 64], "connection": "GigE Vision"}
    assert about.items() >= expected.items()
    assert about["firmware"]
    assert about["packet_size_now"] == 9000
    assert about["gain_now"] == pytest.approx(6.0)
    assert about["exposure_now_s"] == pytest.approx(0.02)


@needs_aravis
def test_a_camera_with_an_address_is_used_as_a_real_one() -> None:
    """No simulation: region, all triggers, a rate."""
    region = {"y": 8, "x": 16, "height": 24, "width": 32}
    settings = {"region": region, "packet_size": PACKET_SIZE, "readout": "1 ms", "frame_rate": "500 Hz"}

    def expose(request: Exposure) -> NDArray[np.uint16]:
        return np.full((request.height, request.width), request.n, np.uint16)

    with (
        plugged_in(expose, sensor_shape=(64, 64)) as fake,
        rig(fake.address, clock=NeverStopped(), **settings) as lab,
    ):
        assert lab.camera.facts.frame_shape == (24, 32)
        lab.camera.self_test()
        lab.camera.arm(20, 1e-3, "internal")
        frames = [lab.camera.read(WAIT_S) for _ in range(20)]
        assert [frame.number for frame in frames] == list(range(20))
        assert [frame.image[0, 0] for frame in frames] == list(range(1, 21))
        assert [frame.number for frame in lab.take(3, 2e-5)] == [0, 1, 2]
        lab.camera.arm(1, 1e-3, "external")
        with pytest.raises(DeviceTimeoutError, match="waits for its external trigger"):
            lab.camera.read(0.05)
        assert [frame.number for frame in lab.take(1)] == [0]


@given(
    first=st.integers(0, LAST_ID),
    steps=st.lists(st.integers(1, 1000), min_size=1, max_size=50),
    is_ethernet=st.booleans(),
)
def test_numbers_tell_how_many_frames_never_came(first: int, steps: list[int], is_ethernet: bool) -> None:
    frame_id, number, counter = first + is_ethernet * (first == 0), 0, FrameCounter()
    assert counter.number(frame_id) == 0
    for step in steps:
        frame_id, number = frame_id + step, number + step
        if is_ethernet:
            frame_id = (frame_id - 1) % LAST_ID + 1
        assert counter.number(frame_id) == number


def test_the_temperature_of_a_camera_that_measures_one_is_in_kelvins() -> None:
    values = {"TemperatureAbs": 21.5}
    nodes: Any = SimpleNamespace(is_available=values.__contains__, get=lambda name, _: values[name])
    features = Features("camera", nodes, lambda _: nullcontext())
    assert temperature_k(features) == pytest.approx(294.65)
    values.clear()
    assert temperature_k(features) is None


class LimitedNodes:
    """A camera with one trigger, whose frame rate limits its exposure time while it is switched on."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"AcquisitionFrameRateEnable": True, "AcquisitionFrameRate": 100.0}
        self.values |= {"ExposureTime": 1e3, "TriggerMode": "On", "TriggerSource": "Line1"}

    def is_available(self, feature: str) -> bool:
        return feature in self.values

    def options(self, feature: str) -> tuple[str, ...]:
        return {"TriggerMode": ("Off", "On"), "TriggerSource": ("Software", "Line1")}.get(feature, ())

    def get(self, feature: str, kind: type[Any]) -> Any:
        return kind(self.values[feature])

    def set(self, feature: str, value: str | float) -> None:
        self.values[feature] = value

    def bounds(self, feature: str, kind: type[Any]) -> tuple[Any, Any]:
        if feature == "ExposureTime" and self.values["AcquisitionFrameRateEnable"]:
            return kind(10), kind(1e6 / self.values["AcquisitionFrameRate"])
        return kind(0), kind(1e7)

    def increment(self, feature: str) -> int:
        return 1


def test_a_frame_rate_that_was_set_before_does_not_limit_the_exposure() -> None:
    nodes, standard = LimitedNodes(), StandardSettings(readout=0.0)
    features = Features("camera", nodes, lambda _: nullcontext())
    for exposure_s in (5e-3, 0.05, 0.02):
        set_trigger(features, standard, "internal", 2)
        assert nodes.values["TriggerMode"] == "Off"
        assert set_exposure(features, exposure_s) == pytest.approx(exposure_s)
        series = Series(2, exposure_s, "internal")
        assert frame_period_s(features, standard, series, "internal") == pytest.approx(exposure_s)
        assert nodes.values["AcquisitionFrameRateEnable"]
    set_trigger(features, standard, "software", 2)
    assert (nodes.values["TriggerSource"], nodes.values["AcquisitionFrameRateEnable"]) == ("Software", False)


@needs_aravis
def test_a_pulse_or_the_start_of_a_series_is_chosen_by_the_features_of_the_standard() -> None:
    features = ("AcquisitionMode", "ExposureMode", "TriggerMode", "TriggerSource", "TriggerActivation")
    with rig(line_trigger="external_start", cycle_time="50 ms", trigger_edge="falling") as lab:
        camera = lab.genicam

        def chosen(trigger: Trigger, selector: str) -> list[str]:
            lab.camera.arm(3, 0.01, trigger)
            camera.set("TriggerSelector", selector)
            return [camera.get(feature, str) for feature in features]

        assert chosen("external_start", "AcquisitionStart") == [
            "MultiFrame",
            "Timed",
            "On",
            "Line1",
            "FallingEdge",
        ]
        assert (camera.get("AcquisitionFrameCount", int), camera.get("AcquisitionFrameRate", float)) == (
            3,
            20.0,
        )
        assert chosen("external_start", "FrameStart")[2] == "Off"
        assert chosen("bulb", "FrameStart") == ["Continuous", "TriggerWidth", "On", "Line1", "FallingEdge"]
        assert chosen("bulb", "AcquisitionStart")[2] == "Off"
        assert chosen("software", "FrameStart")[:4] == ["Continuous", "Timed", "On", "Software"]
