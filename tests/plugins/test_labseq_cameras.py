"""What all camera drivers have in common: every simulated pixel comes through the vendor's library."""

from __future__ import annotations

import json
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from labseq import ConfigError, Run, Session
from labseq.detection.sites import site_pixels
from labseq.errors import DeviceError, DeviceTimeoutError, LimitError, StopRequested
from labseq.model import SiteGrid
from labseq.plugin import Context
from labseq.roles import Trigger
from labseq.testing import CameraContract

from .labseq_camera_rig import DRIVERS, REQUIRED, Rig, assert_shown, driver_param, opened_rig

ROOT = Path(__file__).parents[2]
SETTINGS: dict[str, list[dict[str, Any]]] = {
    "andor": [{"em_gain": 300}, {"frame_transfer": True, "binning": 2, "shutter": "auto"}],
    "genicam": [{}],
    "pylablib": [{}, {"readout_mode": "slow", "binning": 2}],
    "pylon": [{}],
}


@pytest.fixture(params=[*map(driver_param, DRIVERS)])
def driver(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.mark.parametrize(
    ("name", "settings"), [driver_param(name, one) for name, some in SETTINGS.items() for one in some]
)
class TestCameraDrivers(CameraContract):
    exposure_s = 0.02

    @pytest.fixture
    def factory(self, name: str, settings: dict[str, Any]) -> Any:
        make, model = DRIVERS[name]
        given = {"camera": "simulated", **REQUIRED.get(name, {}), **settings}
        return partial(make, model.model_validate(given))


@pytest.mark.parametrize("trigger", ["software", "internal"])
def test_frames_come_in_order_and_pixel_for_pixel(driver: str, trigger: Trigger) -> None:
    with opened_rig(driver, sensor_shape=(256, 512)) as lab:
        frames = lab.take(8, 0.01, trigger)
        overlaps = driver == "pylablib" and trigger == "internal"  # a rolling shutter reads while it exposes
        period_s = 0.01 + (0.0 if overlaps else lab.camera.facts.readout_s)
        assert [frame.number for frame in frames] == list(range(8))
        assert np.diff([frame.t_start_s for frame in frames]) == pytest.approx(period_s)
        assert_shown(frames, lab)


def test_it_takes_its_time_to_arm(driver: str) -> None:
    with opened_rig(driver, arming_time="30 ms") as lab:
        assert lab.camera.facts.arm_s == pytest.approx(0.03)
        lab.clock.sleep(1.0)
        starts_s = [lab.clock.now()]
        for _ in range(2):
            lab.camera.arm(2, 0.01, "software")
            lab.camera.disarm()
            starts_s.append(lab.clock.now())
        again_s = 0.0 if driver == "genicam" else 0.03  # it goes on waiting for triggers
        assert np.diff(starts_s) == pytest.approx([0.03, again_s])
        with pytest.raises(DeviceError, match="without being armed"):
            lab.camera.trigger()


def test_frames_that_wait_to_be_read_keep_their_order(driver: str) -> None:
    with opened_rig(driver) as lab:
        lab.camera.arm(6, 1e-3, "software")
        starts_s: list[float] = []
        for _ in range(6):
            starts_s.append(lab.clock.now())
            lab.camera.trigger()
            lab.clock.sleep(0.02)
        frames = [lab.camera.read(1.0) for _ in range(6)]
        assert [frame.t_start_s for frame in frames] == pytest.approx(starts_s)
        assert_shown(frames, lab)


def test_every_series_begins_with_its_own_frames(driver: str) -> None:
    with opened_rig(driver) as lab:
        for n_frames in (3, 7, 1):
            lab.camera.arm(2, 0.01, "software")
            lab.camera.trigger()
            lab.clock.sleep(0.05)
            del lab.world.shown[:]  # it was not read
            frames = lab.take(n_frames)
            assert [frame.number for frame in frames] == list(range(n_frames))
            assert_shown(frames, lab)


def test_a_frame_is_due_when_a_real_camera_would_have_it(driver: str) -> None:
    with opened_rig(driver) as lab:
        lab.camera.arm(1, 0.045, "software")
        start_s = lab.clock.now()
        lab.camera.trigger()
        with pytest.raises(DeviceTimeoutError, match="frame 0 is not ready"):
            lab.camera.read(0.045)
        assert lab.clock.now() - start_s == pytest.approx(0.045)
        frame = lab.camera.read(0.1)
        assert lab.clock.now() - start_s == pytest.approx(0.045 + lab.camera.facts.readout_s)
    assert frame.exposure_s == pytest.approx(0.045)
    assert frame.t_start_s == pytest.approx(start_s)


def test_an_external_trigger_that_never_comes_is_a_timeout(driver: str) -> None:
    with opened_rig(driver) as lab:
        lab.camera.arm(2, 0.01, "external")
        with pytest.raises(DeviceTimeoutError, match="frame 0 waits for its external trigger"):
            lab.camera.read(0.05)
        assert len(lab.take(1)) == 1
        lab.camera.arm(1, 0.01, "external")
        lab.clock.stop.request()
        with pytest.raises(StopRequested):
            lab.camera.read(60.0)
        lab.clock.stop = type(lab.clock.stop)()


def test_an_edge_of_a_line_that_is_wired_to_it_starts_an_exposure(driver: str) -> None:
    with opened_rig(driver, is_wired=True) as lab:
        for _ in range(2):
            lab.camera.arm(2, 0.01, "external")
            start_s = lab.clock.now()
            lab.world.pulse("camera", start_s + 0.002, 1e-3)
            lab.world.pulse("camera", start_s + 0.1, 1e-3)
            frames = [lab.camera.read(1.0) for _ in range(2)]
            assert [frame.t_start_s - start_s for frame in frames] == pytest.approx([0.002, 0.1])
            assert lab.clock.now() - start_s == pytest.approx(0.11 + lab.camera.facts.readout_s)
            assert_shown(frames, lab)
            lab.world.pulse("camera", lab.clock.now(), 1e-3)
            assert_shown(frames, lab)
            del lab.world.shown[:]


def test_bulb_exposes_as_long_as_the_line_is_on(driver: str) -> None:
    with opened_rig(driver, is_wired=True, line_trigger="bulb") as lab:
        assert (lab.camera.facts.line_trigger, "bulb" in lab.camera.facts.triggers) == ("bulb", True)
        for widths_s in ((0.01, 0.01), (0.003, 0.02)):  # the exposure set before has no effect
            lab.camera.arm(2, 0.01, "bulb")
            start_s = lab.clock.now()
            for n, width_s in enumerate(widths_s):
                lab.world.pulse("camera", start_s + 0.1 * n, width_s)
            frames = [lab.camera.read(1.0) for _ in range(2)]
            assert lab.clock.now() - start_s == pytest.approx(0.1 + widths_s[1] + lab.camera.facts.readout_s)
            made = [(start_s, widths_s[0]), (start_s + 0.1, widths_s[1])]
            assert lab.world.exposures == [pytest.approx(one) for one in made]
            assert_shown(frames, lab)
            del lab.world.shown[:], lab.world.exposures[:]
        lab.take(1, 0.02)  # by software it lasts as long as it is set to
        assert lab.world.exposures[-1][1] == pytest.approx(0.02)


def test_an_external_start_begins_a_series_that_later_edges_do_not_change(driver: str) -> None:
    settings = {"line_trigger": "external_start", "cycle_time": "50 ms"}
    with opened_rig(driver, is_wired=True, **settings) as lab:
        for _ in range(2):
            lab.camera.arm(3, 0.01, "external_start")
            start_s = lab.clock.now()
            with pytest.raises(DeviceTimeoutError, match="frame 0 waits for its external trigger"):
                lab.camera.read(0.1)
            lab.world.pulse("camera", start_s + 0.12, 1e-3)
            frames = [lab.camera.read(1.0)]
            lab.world.pulse("camera", lab.clock.now(), 1e-3)
            with pytest.raises(DeviceTimeoutError, match=r"frame 1 of the .*series is not ready"):
                lab.camera.read(1e-3)
            frames += [lab.camera.read(1.0) for _ in range(2)]
            starts_s = [start_s + 0.12 + 0.05 * n for n in range(3)]
            assert [frame.t_start_s for frame in frames] == pytest.approx(starts_s)
            assert_shown(frames, lab)
            del lab.world.shown[:]
        with pytest.raises(LimitError, match="cycle_time is 50 ms; the limit is at least"):
            lab.camera.arm(2, 0.06, "external_start")


@pytest.mark.parametrize("name", [driver_param("genicam"), driver_param("pylon")])
def test_a_trigger_that_the_camera_lacks_is_refused_when_it_is_opened(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labseq_genicam.standard.WIDTH", "NoSuchMode")
    monkeypatch.setattr("labseq_genicam.standard.series_trigger", lambda _: "")
    cases: dict[str, dict[str, Any]] = {
        "has no exposure mode NoSuchMode; leave out `line_trigger: bulb`": {"line_trigger": "bulb"},
        "starts no series by a trigger": {"line_trigger": "external_start", "cycle_time": "50 ms"},
    }
    for lacking, settings in cases.items():
        lab = Rig(name, **settings)
        with pytest.raises(DeviceError, match=lacking):
            lab.camera.open()
        lab.camera.close()


def test_two_simulated_cameras_work_side_by_side(driver: str) -> None:
    with opened_rig(driver, sensor_shape=(64, 64)) as one, opened_rig(driver, sensor_shape=(32, 96)) as other:
        for lab in (one, other, one):
            np.testing.assert_array_equal(lab.take(1)[0].image, lab.world.shown[-1])


def test_it_describes_itself_also_while_it_acquires(driver: str) -> None:
    with opened_rig(driver, binning=2) as lab:
        lab.camera.arm(1, 0.01, "software")
        described = json.loads(json.dumps(dict(lab.camera.describe()), allow_nan=False))
    assert (described["frame_shape"], described["firmware"] != "") == ([48, 64], True)
    models = {
        "andor": ("DU-897", "10001"),
        "genicam": ("Simulated", "SIM1"),
        "pylablib": ("C15550-20UP", "500001"),
        "pylon": ("Emulation", "0815-0000"),
    }
    assert (described["model"], described["serial_number"]) == models[driver]


def test_a_simulated_camera_needs_a_simulation_and_a_region_on_its_sensor(driver: str) -> None:
    make, model = DRIVERS[driver]
    given = {"camera": "simulated", **REQUIRED.get(driver, {})}
    with pytest.raises(ConfigError, match=r"add `simulation: \{use: virtual\}`"):
        make(model.model_validate(given), Context("camera"))
    with pytest.raises(ConfigError, match="beyond the sensor of 96 x 128 pixels"):
        Rig(driver, region={"y": 60, "x": 0, "height": 48, "width": 64})


REAL: dict[str, dict[str, Any]] = {
    "andor": {"serial": 4711, "em_gain": 300, "model": "DU-897", "cooling": {"temperature": "-70 degC"}},
    "genicam": {"camera": "192.168.7.2", "model": "BFS-PGE-50S5M", "serial": "23456789"},
    "pylablib": {
        "interface": "dcam",
        "serial": "000123",
        "model": "C15550-20UP",
        "cooling": {"temperature": "-20 degC"},
    },
    "pylon": {"camera": 22345678, "model": "acA1920-40um"},
}
"""Profiles of real cameras."""


@pytest.mark.parametrize("name", ["virtual", *map(driver_param, DRIVERS)])
def test_every_orientation_shows_the_same_atoms(tmp_path: Path, name: str) -> None:
    (tmp_path / "look.yaml").write_text(
        "labseq: 1\nname: look\nprofile: bench.yaml\nrecord_frames: all\n"
        "shot: [load: {duration: 500 ms}, image: {exposure: 45 ms}]\n"
    )
    height, width = 120, 200
    plain = site_pixels(SiteGrid(6, 9, 4.49e-6, "triangular"), 0.35e-6, ((height - 1) / 2, (width - 1) / 2))
    region = {"y": (512 - height) // 2, "x": (512 - width) // 2, "height": height, "width": width}
    seen: list[Any] = []
    every = [*product((False, True), ("none", "rows", "columns", "both"))]
    differing = [(False, "none"), (False, "columns"), (True, "rows")]  # of each driver, how it passes them on
    for transpose, flip in every if name == "virtual" else differing:
        sites, shape = (plain[..., ::-1], (width, height)) if transpose else (plain, (height, width))
        sites = np.array(sites)
        for axis, which in enumerate(("rows", "columns")):
            if flip in (which, "both"):
                sites[..., axis] = shape[axis] - 1 - sites[..., axis]
        np.save(tmp_path / "sites.npy", sites)
        parts = yaml.safe_load((ROOT / "hardware_profiles" / "virtual.yaml").read_text())
        parts["grid"] |= {"rows": 6, "cols": 9}
        gain = {"em_gain": 300} if name == "andor" else REQUIRED.get(name, {})
        parts["camera"] = {"use": name, "region": region, "transpose": transpose, "flip": flip, **gain}
        parts["detector"] = {"use": "threshold", "sites": "sites.npy", "frame": list(shape)}
        (tmp_path / "bench.yaml").write_text(yaml.safe_dump(parts))
        with Session.open(
            tmp_path / "look.yaml", shots=1, seed=1, output=tmp_path / "data", dry_run="full"
        ) as session:
            shot = session.run().shots[0]
        assert shot.frames[0].shape == shape
        seen.append(shot.occupancies[0])
    assert 30 < seen[0].sum() < 54
    for occupied in seen:
        np.testing.assert_array_equal(occupied, seen[0])


def test_a_dry_run_with_a_real_cameras_profile_sees_what_the_virtual_camera_sees(
    tmp_path: Path, driver: str
) -> None:
    parts = yaml.safe_load((ROOT / "hardware_profiles" / "virtual.yaml").read_text())
    parts["camera"] = {"use": driver, **REAL[driver]}
    profile = tmp_path / "bench.yaml"
    profile.write_text(yaml.safe_dump(parts))

    def run(profile: str, *overrides: str, **options: Any) -> Run:
        sequence = ROOT / "sequences" / "compact_225.yaml"
        cut = (
            "profile.camera.region={y: 20, x: 4, height: 472, width: 504}",
            "profile.detector.frame=[472, 504]",
            "profile.detector.centre_px=[235.5, 251.5]",
        )
        with Session.open(
            sequence,
            profile=profile,
            shots=1,
            seed=1,
            output=tmp_path,
            overrides=(*cut, *overrides),
            **options,
        ) as session:
            return session.run()

    done = run(str(profile), dry_run="full")
    assert done.simulated
    camera = done.record["devices"]["camera"]
    virtual = run(
        "virtual",
        f"profile.camera.readout={camera.get('readout_s', 5e-3)} s",
        f"profile.camera.arming_time={camera['arming_time']} s",
    )
    for shot, expected in zip(done.shots, virtual.shots, strict=True):
        np.testing.assert_array_equal(shot.occupancies, expected.occupancies)
