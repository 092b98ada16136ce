"""Calibrations of the virtual lab, from the run to the entry in use."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_virtual.images import site_spots
from labseq_virtual.settings import ImageSettings

import labseq
from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration.store import Store
from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.model import CalibrationKind, SiteGrid
from labseq.testing.fakes import RecordingObserver, fake_calibration

PROFILE = """labseq: 1
name: hidden
grid: {rows: 6, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [160, 176], centre_px: [79.5, 87.5]}
simulation:
  use: virtual
  image: {frame: [160, 176], centre_px: [77.3, 90.8], angle: 2 deg, stretch: 0.1, barrel: 0.02}
"""
GRID = SiteGrid(6, 6)
IMAGE = ImageSettings(
    frame=(160, 176), centre_px=(77.3, 90.8), angle=math.radians(2), stretch=0.1, barrel=0.02
)
TRUE_PX = site_spots(IMAGE, GRID)


class Lab:
    """A profile whose camera sees the sites elsewhere than it says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.profile = folder / "hidden.yaml"
        self.profile.write_text(PROFILE, "utf-8")
        self.store = Store(folder / "calibrations" / "hidden")
        self.observer = RecordingObserver()

    def calibrate(self, kind: str, shots: int = 30, **changes: Any) -> Outcome:
        changes = {"output": self.folder / "data", "seed": 1, "shots": shots} | changes
        request = CalibrationRequest(str(self.profile), **changes)
        return calibrate(METHODS[kind], request, self.observer)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


def test_sites_are_found_from_scratch_and_thresholds_on_top_of_them(lab: Lab) -> None:
    sites = lab.calibrate("sites", shots=40)
    assert sites.refused == ""
    entry = sites.stored.entry
    assert np.abs(entry.values["positions_px"] - TRUE_PX).max() < 0.1
    assert entry.values["frame"].tolist() == [160, 176]
    assert entry.quality["n_sites_found"] == 36
    assert entry.quality["stretch"] == pytest.approx(1.1, abs=0.01)
    assert entry.quality["angle_rad"] == pytest.approx(math.radians(2), abs=2e-3)
    assert sites.stored.picture is not None
    assert sites.run is not None
    assert entry.origin["run"] == str(sites.run.path)
    assert (entry.origin["n_shots"], entry.origin["profile"], entry.origin["simulated"]) == (
        40,
        "hidden",
        True,
    )

    thresholds = lab.calibrate("thresholds", shots=60).stored.entry
    assert thresholds.origin["calibrations"] == {"sites": entry.id}
    assert thresholds.origin["unit"] == "counts"
    assert thresholds.quality["error"] < 5e-3
    assert np.all((thresholds.values["thresholds"] > 800) & (thresholds.values["thresholds"] < 3000))

    shot = look(lab)
    assert shot.calibrations == {"sites": entry.id, "thresholds": thresholds.id}
    assert int(np.count_nonzero(shot.occupancies[0])) == pytest.approx(
        shot.readings["simulation.n_atoms_true"], abs=1
    )


def look(lab: Lab) -> Any:
    """A shot of an ordinary run on the calibrated profile."""
    sequence = lab.folder / "look.yaml"
    sequence.write_text(
        "labseq: 1\nname: look\nprofile: hidden\nshots: 1\nseed: 3\n"
        "target: {pattern: compact, rows: 2, cols: 2}\nplanner: {use: psca}\n"
        "shot: [{load: {}}, {image: {}}]\n",
        "utf-8",
    )
    with labseq.Session.open(sequence, output=lab.folder / "data") as session:
        (shot,) = session.run().shots
    return shot


def test_a_run_may_be_analysed_again(lab: Lab) -> None:
    first = lab.calibrate("sites")
    assert first.run is not None
    again = lab.calibrate("sites", source=first.run.path)
    assert again.stored.entry.id == first.stored.entry.id
    assert again.stored.path != first.stored.path
    assert again.before is not None
    assert again.before.id == first.stored.entry.id
    assert {change.greatest for change in again.changes} == {0.0}
    assert again.stored.entry.taken_utc == first.stored.entry.taken_utc
    assert lab.store.active()["sites"].file == again.stored.path.name


def test_a_shift_since_the_last_time_is_told(lab: Lab) -> None:
    lab.calibrate("sites")
    lab.profile.write_text(PROFILE.replace("centre_px: [77.3, 90.8]", "centre_px: [77.8, 90.6]"), "utf-8")
    positions = next(one for one in lab.calibrate("sites").changes if one.name == "positions_px")
    assert positions.mean == pytest.approx((0.5, -0.2), abs=0.03)


def test_a_worse_one_is_kept_but_not_used(lab: Lab) -> None:
    good = fake_calibration("sites", GRID, quality={"residual_px": 1e-3, "n_sites_found": 37})
    lab.store.use(lab.store.add(good), GRID)
    outcome = lab.calibrate("sites")
    assert outcome.refused == "it found 36 sites, the one in use 37"
    assert lab.store.active()["sites"].id == good.id
    assert lab.store.find(outcome.stored.entry.id).path == outcome.stored.path
    assert outcome.run is not None
    assert lab.calibrate("sites", source=outcome.run.path, force=True).refused == ""
    assert lab.store.active()["sites"].id == outcome.stored.entry.id


def test_a_damaged_one_in_use_does_not_stand_in_the_way_of_a_new_one(lab: Lab) -> None:
    stored = lab.store.add(fake_calibration("sites", GRID))
    lab.store.use(stored, GRID)
    stored.path.write_text("{", "utf-8")
    outcome = lab.calibrate("sites")
    assert (outcome.refused, outcome.before) == ("", None)


def test_a_detector_that_does_not_fit_the_frames_does_not_either(lab: Lab) -> None:
    lab.profile.write_text(
        PROFILE.replace("{use: threshold, frame: [160, 176]", "{use: threshold, frame: [64, 64]"), "utf-8"
    )
    assert lab.calibrate("sites").refused == ""


def test_settings_of_the_detector_count_in_the_analysis(lab: Lab) -> None:
    lab.calibrate("sites")
    run = lab.calibrate("thresholds").run
    assert run is not None
    smaller = lab.calibrate("thresholds", source=run.path, overrides=["profile.detector.region=3"])
    assert smaller.stored.entry.origin["detector"]["region"] == 3


@pytest.mark.parametrize(("kind", "why"), [("sites", "no lattice found"), ("thresholds", "show one peak")])
def test_an_analysis_that_fails_says_why_and_keeps_what_is_in_use(
    lab: Lab, kind: CalibrationKind, why: str
) -> None:
    old = lab.store.add(
        fake_calibration("sites", GRID, values={"positions_px": TRUE_PX, "frame": [160, 176]})
    )
    lab.store.use(old, GRID)
    with pytest.raises(DeviceError, match=why) as caught:
        lab.calibrate(kind, overrides=["profile.simulation.loading=0 %"])
    assert caught.value.exit_code == 3
    assert lab.store.active()["sites"].id == old.entry.id
    assert len(lab.store.entries()) == 1
    (warning,) = (values["text"] for name, values in lab.observer.events if name == "warning")
    assert warning.startswith(
        "the calibration failed, and the one in use is unchanged; analyse the run again"
    )


def test_too_few_frames_for_thresholds(lab: Lab) -> None:
    with pytest.raises(LimitError, match="number of frames for thresholds is 5"):
        lab.calibrate("thresholds", shots=5)


def test_sites_of_an_irregular_array_come_from_a_file(lab: Lab) -> None:
    path = lab.folder / "sites.npy"
    np.save(path, TRUE_PX)
    outcome = lab.calibrate("sites", source=path)
    assert outcome.run is None
    assert outcome.stored.picture is None
    assert np.array_equal(outcome.stored.entry.values["positions_px"], TRUE_PX)
    assert outcome.stored.entry.origin["file"] == str(path)
    assert lab.store.active()["sites"].id == outcome.stored.entry.id


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("sites", "beside.npy", "outside of the frame of 160 x 176 pixels"),
        ("sites", "shape.npy", "the sites in '.*' are of shape"),
        ("sites", "none.npy", "the sites cannot be read from '.*': No such file"),
        ("thresholds", "beside.npy", "a calibration of thresholds cannot be made from a file"),
        ("sites", "none", "--from: .*no such file or folder"),
    ],
)
def test_a_source_that_is_none_is_told(lab: Lab, kind: str, name: str, message: str) -> None:
    np.save(lab.folder / "beside.npy", TRUE_PX + 100)
    np.save(lab.folder / "shape.npy", TRUE_PX[1:])
    with pytest.raises(ConfigError, match=message):
        lab.calibrate(kind, source=lab.folder / name)
    assert lab.store.entries() == []


def test_a_run_of_another_lab_is_refused(lab: Lab, tmp_path: Path) -> None:
    run = lab.calibrate("sites").run
    assert run is not None
    lab.profile.write_text(PROFILE.replace("rows: 6", "rows: 5"), "utf-8")
    with pytest.raises(ConfigError, match="the run has a grid of 6 x 6 sites; expected 5 x 6"):
        lab.calibrate("sites", source=run.path)
    real = PROFILE.replace("camera: {use: virtual}", "camera: {use: slow}\nplugin_folders: [plugins]")
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "slow.py").write_text(
        "import labseq\nfrom labseq_virtual.camera import VirtualCamera\n"
        "from labseq_virtual.settings import CameraSettings\nLABSEQ_API = 1\n"
        "@labseq.plugin.hookimpl\n"
        "def labseq_register(registry): registry.camera('slow', VirtualCamera, CameraSettings)\n",
        "utf-8",
    )
    lab.profile.write_text(real, "utf-8")
    with pytest.raises(ConfigError, match="the run was simulated; expected one with real devices"):
        lab.calibrate("sites", source=run.path)
    outcome = lab.calibrate("sites", source=run.path, dry_run="full")
    assert outcome.stored.path.parent == lab.store.folder / "dry-run"


def test_a_run_on_another_lattice_is_refused(lab: Lab) -> None:
    run = lab.calibrate("sites", shots=10).run
    assert run is not None
    lab.profile.write_text(PROFILE.replace("4.49 um}", "4.49 um, shear: -1}"), "utf-8")
    with pytest.raises(ConfigError, match=r"grid of 6 x 6 sites.*shear \+1; expected 6 x 6 .*shear -1"):
        lab.calibrate("sites", source=run.path)


def test_any_name_of_a_folder_will_do(tmp_path: Path) -> None:
    folder = tmp_path / "Prüfung \U0001f600 = #1"
    folder.mkdir()
    assert Lab(folder).calibrate("sites").stored.path.is_file()


def test_a_run_without_frames_is_refused(lab: Lab) -> None:
    with pytest.raises(ConfigError, match="the first image of shot 1 was not kept"):
        lab.calibrate("sites", shots=1, overrides=["record_frames=none"])


def test_a_choice_in_the_profile_is_told(lab: Lab) -> None:
    lab.profile.write_text(PROFILE + "calibrations: {use: {sites: off}}\n", "utf-8")
    (warning,) = lab.calibrate("sites").warnings
    assert warning == "the profile says 'calibrations.use.sites: off', which takes precedence"


@pytest.mark.parametrize("kind", ["sites", "thresholds"])
def test_saturated_frames_are_refused(lab: Lab, kind: Any) -> None:
    with pytest.raises(
        DeviceError, match=r"pixels of the first frame of shot 1 are saturated; use less light"
    ):
        lab.calibrate(kind, shots=3, overrides=["profile.simulation.image.photoelectrons=200000"])
