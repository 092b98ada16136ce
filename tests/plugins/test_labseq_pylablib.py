"""The driver of pylablib's cameras, on a simulated DCAM library below pylablib, and what a user reads."""

from __future__ import annotations

import re
import sys
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, get_args
from unittest.mock import create_autospec

import numpy as np
import pytest
from labseq_dcam_sim import Faults, SimulatedCamera
from labseq_pylablib.camera import PylablibCamera
from labseq_pylablib.interfaces import INTERFACES
from labseq_pylablib.settings import PylablibSettings
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq import ConfigError, DeviceError, DeviceTimeoutError, LimitError, TransientError
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.plugin import Context, DepthRamp, RandomStream
from labseq.roles import NeverStopped, Trigger
from labseq.testing.fakes import FakeClock

from .labseq_camera_rig import Rig, assert_shown, opened_rig

pytestmark = pytest.mark.needs("pylablib")
unopened = partial(Rig, "pylablib")
rig = partial(opened_rig, "pylablib")


def refusal(lab: Rig, kind: type[Exception] = DeviceError) -> str:
    with pytest.raises(kind) as caught:
        lab.camera.open()
    lab.camera.close()
    return str(caught.value)


# what the camera reports and does


def test_the_run_knows_how_many_electrons_a_count_is_and_how_fast_the_sensor_is_read() -> None:
    """1152 pairs of rows in 172.8 us or 7.2 us are 5 and 120 frames per second, as Hamamatsu quotes."""
    times: list[float] = []
    for speed in ("slow", "fast"):
        lab = unopened(sensor_shape=(2304, 4096), readout_mode=speed)
        times.append(lab.camera.facts.readout_s)
        lab.camera.open()
        assert lab.camera.facts.readout_s == pytest.approx(times[-1])
        about = lab.camera.describe()
        lab.camera.close()
        assert (about["electrons_per_count"], about["offset_counts"]) == (0.11, 200.0)
    assert [1 / one for one in times] == pytest.approx([5.0, 120.5], rel=0.01)


def test_a_region_is_read_pixel_for_pixel_and_faster() -> None:
    region = {"y": 32, "x": 16, "height": 48, "width": 64}
    with rig(region=region, binning=2) as lab:
        frames = lab.take(2)
        assert_shown(frames, lab)
        assert lab.world.modes[-1].region == (32, 16, 48, 64)
        assert (lab.world.modes[-1].binning, frames[0].image.shape) == (2, (24, 32))
        assert lab.camera.facts.readout_s == pytest.approx(24 * 7.2e-6)


def test_frames_carry_the_cameras_time_stamps_in_real_time_too() -> None:
    with rig(clock=NeverStopped()) as lab:
        frames = [*lab.take(2, 1e-3), *lab.take(2, 1e-3, "internal")]
    assert_shown(frames, lab)
    starts, stamps = ([getattr(one, key) for one in frames] for key in ("t_start_s", "device_time_s"))
    assert np.diff(stamps) == pytest.approx(np.diff(starts), abs=2e-6)


def test_after_an_external_start_the_trigger_is_set_again() -> None:
    with rig(line_trigger="external_start", cycle_time="50 ms", is_wired=True) as lab:
        for _ in range(2):
            lab.camera.arm(2, 0.01, "external_start")
            assert lab.dcam.trigger()
            assert [lab.camera.read(1.0).number for _ in range(2)] == [0, 1]
        lab.take(1)


def test_it_waits_until_the_sensor_is_cold() -> None:
    with rig(cooling={"temperature": "-20 degC"}) as lab:
        lab.camera.settle()
        assert lab.camera.describe()["temperature_k"] == pytest.approx(253.15, abs=1.0)
        lab.camera.safe_state()
        assert lab.camera.describe()["setpoint_k"] == pytest.approx(253.15)
    with rig(cooling={"temperature": "-30 degC", "timeout": "5 min"}) as lab:
        lab.dcam.faults.coldest_c = -25.0
        with pytest.raises(DeviceTimeoutError, match="the sensor is at -2"):
            lab.camera.settle()


def test_atoms_are_told_from_empty_sites_with_the_cameras_offset() -> None:
    """See docs/how-to/cameras-pylablib.md."""
    random, clock, counts = RandomStream(3), FakeClock(), np.zeros(4, int)
    image = SimulationSettings.model_validate({"image": {"sensor": "qcmos"}})
    world = VirtualSimulation(image, Context("simulation", random=random, clock=clock))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    settings = {"interface": "dcam", "camera": "simulated", "readout_mode": "slow"}
    context = Context("camera", clock=clock, simulation=world, random=random)
    camera = PylablibCamera(PylablibSettings.model_validate(settings), context)
    camera.open()
    offset = camera.describe()["offset_counts"]
    chosen = ThresholdSettings(offset=offset, threshold=140.0, width=5.0, shape="disc")
    detector = ThresholdDetector(chosen, Context("detector"))
    for shot in range(10):
        random.begin_shot(shot, 0)
        world.begin_shot()
        world.load(clock.now(), 0.5)
        clock.sleep(0.5)
        empty = ~world.truth()
        camera.arm(1, image.image.exposure, "software")
        camera.trigger()
        seen, *_ = detector.detect(camera.read(1.0))
        atoms = ~empty & world.truth()
        counts += (atoms & ~seen).sum(), atoms.sum(), (seen & empty).sum(), empty.sum()
    camera.close()
    missed, n_atoms, imagined, n_empty = counts
    assert n_atoms + n_empty > 3900
    assert max(missed, imagined) <= 3  # 9e-5 of them


# faults


def test_a_frame_that_is_lost_on_its_way_leaves_a_gap_of_the_numbers() -> None:
    with rig() as lab:
        lab.camera.arm(4, 0.01, "external")
        for lost in (0, 2, 0, 0):
            lab.dcam.faults.lost_frames += lost
            lab.dcam.trigger()
            lab.clock.sleep(0.05)
        lab.dcam.faults.lost_frames = 0
        assert lab.camera.read(1.0).number == 0
        with pytest.raises(TransientError, match="frames 1 to 2 were lost from a series of 4"):
            lab.camera.read(1.0)
        assert lab.camera.read(1.0).number == 3


def test_unplugged_in_a_series_and_opened_again() -> None:
    with rig() as lab:
        lab.dcam.faults.unplugged_at = 2
        lab.camera.arm(3, 0.01, "internal")
        assert lab.camera.read(1.0).number == 0
        gone = r"no longer answers.*gave DCAMERR_NOCONNECTION"
        for call in (partial(lab.camera.read, 1.0), lab.camera.safe_state, lab.camera.close):
            with pytest.raises(DeviceError, match=gone):
                call()
        lab.dcam.faults.unplugged, lab.dcam.faults.unplugged_at = False, 0
        lab.dcam.close()
        lab.camera.open()
        assert lab.take(1)


def test_a_frame_later_than_the_timeout_and_a_trigger_that_is_too_early() -> None:
    with rig() as lab:
        lab.dcam.faults.late_s = 0.5
        lab.camera.arm(2, 0.01, "software")
        lab.camera.trigger()
        with pytest.raises(DeviceTimeoutError, match="200 ms: frame 0 is not ready"):
            lab.camera.read(0.2)
        assert lab.camera.read(0.5).number == 0
        lab.camera.trigger()
        lab.clock.sleep(0.0101)
        lab.camera.arm(2, 0.01, "software")
        lab.camera.trigger()
        lab.clock.sleep(0.0101)
        with pytest.raises(DeviceError, match=r"cannot take a trigger yet.*TOOFREQUENTTRIGGER"):
            lab.camera.trigger()


def test_the_safe_state_comes_through_while_a_call_hangs() -> None:
    with rig() as lab:
        lab.camera.arm(1, 0.01, "software")
        lab.camera.trigger()
        lab.dcam.faults.hang = threading.Event()
        seen: list[Exception] = []

        def read() -> None:
            try:
                lab.camera.read(1.0)
            except Exception as error:  # noqa: BLE001 - whatever comes of a call that hung
                seen.append(error)

        reader = threading.Thread(target=read)
        reader.start()
        assert lab.dcam.exposures.hangs.wait(10.0)
        lab.camera.safe_state()
        assert not lab.dcam.exposures.is_acquiring
        lab.dcam.faults.hang.set()
        reader.join(10.0)
        assert not reader.is_alive()


def test_no_camera_one_that_is_used_and_one_of_two() -> None:
    lab = unopened()
    lab.dcam.faults.not_connected = True
    assert re.search("no dcam camera is connected.*close HCImage", refusal(lab))
    lab.dcam.faults.not_connected, lab.dcam.faults.held = False, True
    assert re.search("cannot be used; close HCImage.*dcamdev_open gave DCAMERR_EXCLUDED", refusal(lab))
    lab.dcam.faults.held = False
    lab.camera.open()
    assert lab.take(1)
    lab.camera.close()


def two_cameras(**settings: Any) -> Rig:
    lab = unopened(**settings)
    lab.camera.connection.others.append(SimulatedCamera(lab.world, lab.clock, (96, 128), "500002"))
    return lab


def test_the_serial_number_chooses_the_camera() -> None:
    assert "2 cameras are connected; choose one by `serial`" in refusal(two_cameras())
    assert "number 500001 and 500002, not 4711" in refusal(two_cameras(serial="4711"))
    assert "number 500001, not 4711" in refusal(unopened(serial="4711"))
    lab = two_cameras(serial="500002")
    lab.dcam.faults.held = True  # the other one
    lab.camera.open()
    assert lab.camera.describe()["serial_number"] == "500002"
    lab.camera.close()
    lab = unopened(model="C11440")
    lab.dcam.model = "C15550-20UP"
    assert re.search("is a C15550-20UP, but .*C11440", refusal(lab))


@pytest.mark.parametrize(
    ("settings", "kind", "text"),
    [
        (
            {"region": {"y": 2, "x": 0, "height": 8, "width": 8}},
            LimitError,
            "y is 2; .*steps of 4.*nearest possible value is 4",
        ),
        ({"region": {"height": 8, "width": 10}}, LimitError, "width is 10; the limit is 4 to 128, in steps"),
        ({"binning": 3, "region": {"height": 96, "width": 96}}, DeviceError, "binned by 2 x 2, not what"),
        ({"readout_mode": "quiet"}, DeviceError, "'quiet', which this camera does not have; it has.*slow"),
        ({"cooling": {"temperature": "-70 degC"}}, DeviceError, "-70 degC, but the camera cools to -35 degC"),
    ],
)
def test_what_the_camera_cannot_do_is_refused_when_it_is_opened(
    settings: dict[str, Any], kind: type[Exception], text: str
) -> None:
    assert re.search(text, refusal(unopened(**settings), kind))


def test_a_trigger_that_the_camera_lacks_is_refused() -> None:
    lab = unopened(line_trigger="bulb")
    active = {1: "EDGE", 3: "SYNCREADOUT"}
    limits = lab.dcam.properties.limits
    ((number, one),) = [item for item in limits.items() if item[0].text == "TRIGGER ACTIVE"]
    limits[number] = type(one)(one.kind, 1, 3, 1.0, 1, one.access, active)
    assert "no bulb trigger with these settings" in refusal(lab)


def test_more_frames_than_fit_into_memory() -> None:
    with rig(sensor_shape=(2304, 4096)) as lab, pytest.raises(LimitError, match=r"1000; .*at most 113"):
        lab.camera.arm(1000, 0.01, "internal")


def test_settings_that_do_not_go_together() -> None:
    validate = PylablibSettings.model_validate
    with pytest.raises(ValueError, match="sdk3 has no simulated camera"):
        validate({"interface": "sdk3", "camera": "simulated"})
    with pytest.raises(ValueError, match="cannot set the cooling of PCO"):
        validate({"interface": "pco", "cooling": {"temperature": "-5 degC"}})
    with pytest.raises(ConfigError, match="beyond the sensor of 96 x 128"):
        unopened(region={"y": 92, "height": 8, "width": 8})


@pytest.mark.skipif(sys.platform == "win32", reason="there the vendors' libraries may be installed")
def test_without_the_vendors_library_the_error_says_what_to_install() -> None:
    expected = {
        "dcam": r"'libdcamapi.so' cannot be loaded .*install Hamamatsu's DCAM-API \(dcam-api.com\)",
        "sdk3": "'libatcore.so' .*install Andor SDK3 or Solis",
        "picam": "'libpicam.so' .*install PICam",
        "photometrics": "'libpvcam.so' .*install PVCAM",
        "pco": "under Windows only",
    }
    for name, text in expected.items():
        settings = PylablibSettings.model_validate({"interface": name})
        with pytest.raises(DeviceError, match=text):
            PylablibCamera(settings, Context("camera", clock=FakeClock())).open()


PROFILE: Final = """labseq: 1
name: bench
grid: {rows: 4, cols: 4, spacing: 4.49 um}
camera: {use: pylablib, interface: dcam, camera: simulated, SETTINGS}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual, image: {sensor: qcmos}}
"""


@pytest.mark.parametrize(
    ("faults", "settings", "code", "text"),
    [
        ({}, "readout_mode: slow", 0, "C15550-20UP +500001 +2.20.A .*ok"),
        ({"held": True}, "model: C15550", 3, "close HCImage and every other program"),
        ({"unplugged_at": 1}, "model: C15550", 3, "no longer answers"),
        ({"missed_triggers": 1}, "model: C15550", 3, "frame 0 is not ready, although its software trigger"),
    ],
)
def test_labseq_devices_finds_each_planted_fault(
    faults: dict[str, Any],
    settings: str,
    code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Any,
) -> None:
    monkeypatch.setattr("labseq_dcam_sim.camera.Faults", partial(Faults, **faults))
    monkeypatch.chdir(tmp_path)
    Path("p.yaml").write_text(PROFILE.replace("SETTINGS", settings), encoding="utf-8")
    got, out, err = call("devices", "./p.yaml")
    assert got == code, out + err
    (row,) = [line for line in out.splitlines() if line.startswith("camera") and "firmware" not in line]
    assert re.search(text, row), out


# the other interfaces, on pylablib's classes without their libraries

INFO: Final[dict[str, Any]] = {
    "sdk3": {"camera_model": "ZYLA-4.2P", "serial_number": "VSC-1", "firmware_version": "1.2"},
    "picam": {"model": "ProEM", "serial_number": "VSC-1"},
    "photometrics": {"product": "Prime 95B", "chip": "", "serial": "VSC-1"},
}
VALUES: Final[dict[str, Any]] = {
    "ReadoutTime": 2e-3,
    "Readout Time Calculation": 2.0,
    "TimestampClockFrequency": 1000,
    "Time Stamp Resolution": 1000,
}


def fake_module(name: str) -> tuple[Any, Any]:
    """pylablib's module with a camera that has the methods of pylablib's class, and no others."""
    module = __import__(f"pylablib.devices.{INTERFACES[name].vendor.module}", fromlist=["lib"])
    make: Any = getattr(module, INTERFACES[name].vendor.camera)
    camera = create_autospec(make, instance=True)
    camera.Error, camera.TimeoutError = make.Error, make.TimeoutError
    camera.FrameTransferError = make.FrameTransferError
    camera.get_device_info.return_value = SimpleNamespace(**INFO[name])
    camera.get_detector_size.return_value = (64, 32)
    limit = (2, 64, 1, 1, 4)
    camera.get_roi_limits.return_value = (limit, limit)
    camera.set_roi.side_effect = lambda *roi: roi
    camera.get_data_dimensions.return_value = (32, 64)
    camera.set_exposure.side_effect = lambda exposure_s: exposure_s
    if hasattr(make, "get_attribute"):
        every = SimpleNamespace(
            values=["Software", "Internal", "External", "External Start", "External Exposure"],
            ivalues=[1, 2, 4, *(code << 8 for code in (7, 9, 10, 12))],
        )
        camera.get_attribute.return_value = every
        camera.get_attribute_value.side_effect = lambda key, **_: VALUES[key]
    if name == "sdk3":
        camera.set_frame_period.side_effect = lambda period_s: period_s
    if name == "photometrics":
        camera.get_readout_time.return_value = 2e-3
    info = SimpleNamespace(frame_index=0, framestamp=1, timestamp_dev=5, timestamp_start=5)
    info.timestamp_start_ns = 5_000_000
    picture = np.arange(32 * 64, dtype=np.uint16).reshape(32, 64)
    camera.read_oldest_image.side_effect = [None, (picture, info)]
    camera.wait_for_frame.side_effect = make.TimeoutError if name == "sdk3" else None
    cameras = {
        "get_cameras_number": lambda: 1,
        "list_cameras": lambda: [SimpleNamespace(serial_number="VSC-1")],
    }
    return SimpleNamespace(**{INTERFACES[name].vendor.camera: lambda _: camera}, **cameras), camera


@pytest.mark.parametrize(
    ("name", "triggers"),
    [
        ("sdk3", {"software": "software", "external_start": "ext_start", "bulb": "ext_exp"}),
        ("picam", {"internal": 1, "external": 2, "bulb": 4}),
        ("photometrics", {"software": "e_soft_edge", "internal": "e_int", "bulb": "e_level"}),
    ],
)
def test_the_other_interfaces_call_pylablib_as_it_is_declared(name: str, triggers: dict[Any, Any]) -> None:
    module, pylablib_camera = fake_module(name)
    settings = {"interface": name, "serial": "VSC-1", "cycle_time": "50 ms", "line_trigger": "external_start"}
    if name != "sdk3":
        del settings["cycle_time"], settings["line_trigger"]
    camera = PylablibCamera(PylablibSettings.model_validate(settings), Context("camera", clock=FakeClock()))
    camera.connection.module = module
    camera.open()
    assert camera.facts.readout_s == pytest.approx(2e-3)
    assert set(triggers) <= set(camera.facts.triggers) <= set(get_args(Trigger))
    for trigger, value in triggers.items():
        camera.arm(3, 0.01, trigger)
        if name == "picam":
            pylablib_camera.set_attribute_value.assert_any_call("Trigger Response", value)
        else:
            pylablib_camera.set_trigger_mode.assert_called_with(value)
        pylablib_camera.setup_acquisition.assert_called_with(mode="snap", nframes=3)
    frame = camera._take(0.2)
    assert frame is not None
    assert (frame.number, frame.device_time_s) == (0, pytest.approx(5e-3))
    camera.close()
    pylablib_camera.close.assert_called_once_with()
