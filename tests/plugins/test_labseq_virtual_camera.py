"""The virtual camera: timing, triggers, simulated failures, sensor modes, cooling."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_virtual.camera import ROOM_K, Cooler, VirtualCamera
from labseq_virtual.settings import CameraSettings, SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

import labseq
from labseq.plugin import (
    ConfigError,
    Context,
    DepthRamp,
    DeviceError,
    DeviceTimeoutError,
    RandomStream,
    SensorMode,
    SiteGrid,
    TransientError,
)
from labseq.roles import Hardware, overrides
from labseq.testing.fakes import FakeClock, RecordingSimulation


class DarkLab:
    """A camera before a dark simulation."""

    def __init__(self, **settings: Any) -> None:
        self.clock = FakeClock()
        self.simulation = RecordingSimulation()
        context = Context(
            "camera", clock=self.clock, random=RandomStream(0, "camera"), simulation=self.simulation
        )
        self.camera = VirtualCamera(CameraSettings.model_validate(settings), context)
        self.camera.open()

    def fire(self, n_frames: int, exposure_s: float = 1e-3) -> None:
        """Arm, and trigger each frame."""
        self.camera.arm(n_frames, exposure_s, "software")
        for _ in range(n_frames):
            self.camera.trigger()
            self.clock.sleep(exposure_s)

    def exposed_s(self) -> list[float]:
        """Start of each exposure of the simulation."""
        return [call.args[0] for call in self.simulation.calls]


@pytest.fixture
def dark() -> DarkLab:
    return DarkLab()


def test_a_frame_takes_exposure_and_read_out(dark: DarkLab) -> None:
    dark.camera.close()
    dark.clock.sleep(0.75)
    dark.camera.open()
    dark.clock.sleep(0.25)
    dark.camera.arm(1, 45e-3, "software")
    dark.camera.trigger()
    assert dark.clock.now() == 1.0
    frame = dark.camera.read(1.0)
    assert dark.clock.now() == pytest.approx(1.05)
    assert (frame.camera, frame.exposure_s, frame.t_start_s, frame.number) == ("camera", 45e-3, 1.0, 0)
    assert frame.device_time_s == 0.25  # since it was opened


def test_with_the_internal_trigger_exposures_follow_one_another_and_begin_when_read(dark: DarkLab) -> None:
    dark.clock.sleep(2.0)
    dark.camera.arm(3, 45e-3, "internal")
    assert dark.exposed_s() == []
    dark.clock.sleep(0.06)
    frames = [dark.camera.read(1.0) for _ in range(3)]
    assert [frame.t_start_s for frame in frames] == pytest.approx([2.0, 2.05, 2.1])
    assert dark.exposed_s() == [frame.t_start_s for frame in frames]
    assert dark.clock.now() == pytest.approx(2.15)
    with pytest.raises(DeviceTimeoutError, match="all 3 frames"):
        dark.camera.read(0.1)


def test_no_wire_brings_an_external_trigger(dark: DarkLab) -> None:
    with pytest.raises(DeviceError, match=r"no external trigger; .*'software', 'internal'"):
        dark.camera.arm(1, 0.1, "external")


def test_simulated_failures_come_with_their_probability() -> None:
    flaky = DarkLab(faults={"transient": 0.3})
    n_lost = 0
    for _ in range(100):
        flaky.fire(1)
        try:
            flaky.camera.read(1.0)
        except TransientError as error:
            assert str(error).startswith("camera: frame 0 was lost from a series of 1")
            n_lost += 1
    assert 12 < n_lost < 48


def test_a_missed_trigger_ends_in_a_timeout_and_exposes_no_atoms() -> None:
    deaf = DarkLab(faults={"missed_trigger": 1.0})
    deaf.fire(1)
    with pytest.raises(DeviceTimeoutError, match="frame 0 is not ready"):
        deaf.camera.read(1.0)
    assert deaf.exposed_s() == []


def test_a_frame_lost_in_a_series_leaves_a_gap_in_the_numbers() -> None:
    lossy = DarkLab(faults={"lost_in_series": 0.5})
    lossy.fire(20)
    numbers, n_reported = list[int](), 0
    for _ in range(40):
        try:
            numbers.append(lossy.camera.read(1.0).number)
        except TransientError as error:
            assert "frame numbers have a gap" in str(error)
            n_reported += 1
        except DeviceTimeoutError:
            break
    assert len(lossy.exposed_s()) == 20
    assert 4 < len(numbers) < 16
    assert numbers == sorted(set(numbers))
    assert n_reported == sum(b - a > 1 for a, b in zip([-1, *numbers], numbers, strict=False))


def test_a_late_frame_can_be_read_later() -> None:
    late = DarkLab(faults={"late": 1.0, "late_by": "3 s"})
    late.fire(1)
    with pytest.raises(DeviceTimeoutError, match="is not ready"):
        late.camera.read(2.0)
    assert late.camera.read(2.0).t_start_s == 0.0
    assert late.clock.now() == pytest.approx(3.006)


EXPOSURE_S = 45e-3
SMALL: dict[str, Any] = {"frame": (120, 120), "centre_px": (59.5, 59.5)}
PROFILE = """labseq: 1
name: p
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual, CAMERA}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [128, 128], centre_px: [63.5, 63.5]}
simulation: {use: virtual, image: {sensor: qcmos, frame: [128, 128], centre_px: [63.5, 63.5]}}
"""

SEQUENCE = """labseq: 1
name: s
profile: p.yaml
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca}
shot: [load: {duration: 500 ms}, image: {exposure: 45 ms}]
"""


class Lab:
    """A camera before a simulation, with atoms on about all of 4 x 4 sites."""

    def __init__(self, image: dict[str, Any] | None = None, **camera: Any) -> None:
        self.clock = FakeClock()
        random = RandomStream(1)
        settings = SimulationSettings.model_validate({"image": SMALL | (image or {}), "loading": 1.0})
        grid = SiteGrid(4, 4)
        self.simulation = VirtualSimulation(
            settings, Context("simulation", grid, clock=self.clock, random=random)
        )
        context = Context("camera", grid, clock=self.clock, simulation=self.simulation)
        self.camera = VirtualCamera(CameraSettings.model_validate(camera), context)
        self.simulation.open()
        self.simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
        random.begin_shot(0, 0)
        self.simulation.begin_shot()
        self.simulation.load(0.0, 0.5)
        self.clock.sleep(0.5)
        self.camera.open()

    def take(self) -> NDArray[np.float64]:
        """A frame, as the camera takes it."""
        self.camera.arm(1, EXPOSURE_S, "software")
        self.camera.trigger()
        return self.camera.read(1.0).image.astype(float)

    def said(self, key: str) -> Any:
        """What the camera says of itself now."""
        return self.camera.describe()[key]


def run(folder: Path) -> None:
    """A shot with the sequence and the profile in a folder."""
    with labseq.Session.open(folder / "s.yaml", shots=1, output=folder / "runs") as session:
        session.run()


@pytest.mark.parametrize("sensor", ["emccd", "qcmos"])
def test_a_region_of_a_bright_sensor_is_that_part_of_it(sensor: str) -> None:
    image = {"sensor": sensor, "read_noise": 0.0, "em_gain": 1.0, "photoelectrons": 1e4}
    region = {"y": 20, "x": 10, "height": 60, "width": 80}
    whole, part = Lab(image).take(), Lab(image, region=region).take()
    assert part.shape == (60, 80)
    spots = part > part.mean() + part.std()
    assert part[spots] == pytest.approx(whole[20:80, 10:90][spots], rel=0.02)


def test_the_cameras_gain_wins_over_the_simulations() -> None:
    assert (Lab().camera.facts.em_gain, Lab().said("em_gain_now")) == (1.0, None)
    np.testing.assert_array_equal(Lab({"em_gain": 100.0}).take(), Lab({"em_gain": 7.0}, em_gain=100).take())
    assert Lab(em_gain=10).camera.facts.em_gain == 10.0


def test_gain_and_shutter_are_on_in_a_series_only() -> None:
    lab = Lab(em_gain=300)

    def state() -> tuple[Any, Any]:
        return lab.said("em_gain_now"), lab.said("shutter")

    assert state() == (1.0, "closed")
    lab.camera.arm(1, EXPOSURE_S, "software")
    assert state() == (300.0, "open")
    lab.camera.safe_state()
    assert state() == (1.0, "closed")
    lab.take()
    lab.camera.self_test()
    assert state() == (1.0, "open")
    lab.camera.close()
    assert state() == (1.0, "closed")


@pytest.mark.parametrize("sensor", ["emccd", "qcmos"])
def test_behind_a_closed_shutter_it_is_dark_and_the_light_still_takes_atoms(sensor: str) -> None:
    bright = {
        "sensor": sensor,
        "background": 5.0,
        "clock_induced_charge": 0.5,
        "qcmos": {"dark_current": 10.0},
    }
    lab = Lab(bright)
    frame = lab.simulation.expose(0.5, 20.0, SensorMode(shutter_open=False)).image
    ground = {"emccd": 500 + 0.5 * 60, "qcmos": 200 + 200 / 0.11}[
        sensor
    ]  # dark counts: per frame, per second
    assert frame.mean() == pytest.approx(ground, rel=0.03)
    atoms = [lab.simulation.truth().sum(), lab.simulation.losses()["imaging"]]
    assert atoms[0] < 16
    assert atoms[1] > 0


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        ("region: {y: 100, height: 60, width: 60}", "row 160 and column 60, beyond the sensor of 128"),
        ("binning: 3", "128 x 128 pixels cannot be binned by 3"),
        ("em_gain: 300", "the EM gain is 300; the limit is 1"),
        ("cooling: {temperature: -70 K}", "(-343 degC); expected -123 to 50 degC"),
    ],
)
def test_settings_that_the_sensor_lacks_are_reported_with_their_line(
    tmp_path: Path, camera: str, text: str
) -> None:
    (tmp_path / "p.yaml").write_text(PROFILE.replace("CAMERA", camera), encoding="utf-8")
    (tmp_path / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        run(tmp_path)
    assert "p.yaml:4:" in str(caught.value)
    assert text in str(caught.value)


COLD: dict[str, Any] = {"temperature": "-70 degC"}


def test_a_sensor_cools_from_room_temperature_past_its_set_point_and_back() -> None:
    clock = FakeClock()
    cooler = Cooler(203.15, clock)
    assert cooler.temperature_k == ROOM_K
    cooler.switch_on()
    temperatures = list[float]()
    for _ in range(1000):
        temperatures.append(cooler.temperature_k)
        clock.sleep(1.0)
    assert temperatures[0] == ROOM_K
    assert 202.15 < min(temperatures) < 203.0
    cooler.switch_on()
    assert cooler.temperature_k == pytest.approx(203.15, abs=0.01)


def test_the_camera_waits_until_it_is_cold() -> None:
    lab = Lab(cooling=COLD)
    assert overrides(lab.camera, Hardware.settle)
    assert lab.camera.settling_timeout_s == 900.0
    assert lab.said("temperature_k") == ROOM_K
    start_s = lab.clock.now()
    lab.camera.settle()
    assert 120.0 < lab.clock.now() - start_s < 600.0
    assert lab.said("temperature_k") == pytest.approx(203.15, abs=1.0)


def test_it_stays_cold_in_the_safe_state_and_while_it_is_closed() -> None:
    lab = Lab(cooling=COLD)
    lab.camera.settle()
    lab.camera.close()
    lab.clock.sleep(100.0)
    lab.camera.open()
    start_s = lab.clock.now()
    lab.camera.settle()
    assert lab.clock.now() - start_s == 5.0
