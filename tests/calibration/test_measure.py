"""Calibrations of the virtual lab, from the run to the entry in use."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from labseq_virtual.images import site_spots
from labseq_virtual.settings import ImageSettings

import labseq
from labseq.assembly.assemble import assemble
from labseq.assembly.options import Options
from labseq.assembly.profile import resolve_profile
from labseq.calibration.measure import METHODS
from labseq.calibration.method import PROBE_ADDRESS, CalibrationData, count_probed
from labseq.calibration.methods import analyse_timing
from labseq.errors import ConfigError, DeviceError
from labseq.model import CalibrationKind, SiteGrid, StageTiming
from labseq.testing.fakes import fake_calibration

PROFILE = """grid: {rows: 6, cols: 6, spacing: 4.49 um}
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


@pytest.fixture
def lab(tmp_path: Path, make_lab: Any) -> Any:
    """A lab whose camera sees the sites elsewhere than its profile says."""
    return make_lab(tmp_path / "lab", PROFILE)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory, make_lab: Any) -> Any:
    """Such a lab after calibrations of sites and thresholds, for reading only."""
    lab = make_lab(tmp_path_factory.mktemp("measured") / "lab", PROFILE)
    lab.sites, lab.thresholds = lab.calibrate("sites", shots=40), lab.calibrate("thresholds", shots=40)
    return lab


@pytest.fixture
def copied(tmp_path: Path, measured: Any, make_lab: Any) -> Any:
    """A copy of it."""
    return make_lab(shutil.copytree(measured.folder, tmp_path / "lab"), PROFILE)


def test_sites_are_found_from_scratch_and_thresholds_on_top_of_them(measured: Any, copied: Any) -> None:
    sites, entry = measured.sites, measured.sites.stored.entry
    assert sites.refused == ""
    assert np.abs(entry.values["positions_px"] - TRUE_PX).max() < 0.1
    assert entry.values["frame"].tolist() == [160, 176]
    assert entry.quality["n_sites_found"] == 36
    assert entry.quality["stretch"] == pytest.approx(1.1, abs=0.01)
    assert entry.quality["angle_rad"] == pytest.approx(math.radians(2), abs=2e-3)
    assert sites.stored.picture is not None
    origin = [entry.origin[name] for name in ("run", "n_shots", "profile", "simulated")]
    assert origin == [str(sites.run.path), 40, "lab", True]

    thresholds = measured.thresholds.stored.entry
    assert thresholds.origin["calibrations"] == {"sites": entry.id}
    assert thresholds.origin["unit"] == "counts"
    assert thresholds.quality["error"] < 5e-3
    assert np.all((thresholds.values["thresholds"] > 800) & (thresholds.values["thresholds"] < 3000))

    sequence = copied.folder / "look.yaml"
    sequence.write_text(
        "labseq: 1\nname: look\nprofile: lab\nshots: 1\nseed: 3\n"
        "target: {pattern: compact, rows: 2, cols: 2}\nplanner: {use: psca}\n"
        "shot: [{load: {}}, {image: {}}]\n",
        "utf-8",
    )
    with labseq.Session.open(sequence, output=copied.folder / "data") as session:
        (shot,) = session.run().shots
    assert shot.calibrations == {"sites": entry.id, "thresholds": thresholds.id}
    n_atoms = np.count_nonzero(shot.occupancies[0])
    assert n_atoms == pytest.approx(shot.readings["simulation.n_atoms_true"], abs=1)


def test_a_run_may_be_analysed_again(measured: Any, copied: Any) -> None:
    first = measured.sites.stored
    again = copied.calibrate("sites", source=measured.sites.run.path)
    assert (again.stored.entry.id, again.before.id) == (first.entry.id, first.entry.id)
    assert again.stored.path.name != first.path.name
    assert {change.greatest for change in again.changes} == {0.0}
    assert again.stored.entry.taken_utc == first.entry.taken_utc
    assert copied.store.active()["sites"].file == again.stored.path.name


def test_the_change_since_the_last_calibration_is_reported(copied: Any) -> None:
    copied.write_profile(PROFILE.replace("centre_px: [77.3, 90.8]", "centre_px: [77.8, 90.6]"))
    changes = copied.calibrate("sites", shots=15).changes
    positions = next(change for change in changes if change.name == "positions_px")
    assert positions.mean == pytest.approx((0.5, -0.2), abs=0.05)


def test_a_worse_one_is_kept_but_not_used(lab: Any, measured: Any) -> None:
    good = fake_calibration("sites", GRID, quality={"residual_px": 1e-3, "n_sites_found": 37})
    lab.store.use(lab.store.add(good), GRID)
    source = measured.sites.run.path
    outcome = lab.calibrate("sites", source=source)
    assert re.search("36 sites.* 37", outcome.refused)
    assert lab.store.active()["sites"].id == good.id
    assert lab.store.find(outcome.stored.entry.id).path == outcome.stored.path
    assert lab.calibrate("sites", source=source, force=True).refused == ""
    assert lab.store.active()["sites"].id == outcome.stored.entry.id


def test_sites_are_found_whatever_was_in_use_and_is_set(tmp_path: Path, make_lab: Any) -> None:
    """The entry in use is damaged, the detector does not fit the frames, and the folder has an odd name."""
    profile = PROFILE.replace("{use: threshold, frame: [160, 176]", "{use: threshold, frame: [64, 64]")
    lab = make_lab(tmp_path / "Prüfung \U0001f600 = #1", profile)
    stored = lab.store.add(fake_calibration("sites", GRID))
    lab.store.use(stored, GRID)
    stored.path.write_text("{", "utf-8")
    outcome = lab.calibrate("sites", shots=10)
    assert (outcome.refused, outcome.before) == ("", None)


def test_settings_of_the_detector_count_in_the_analysis(measured: Any, copied: Any) -> None:
    source = measured.thresholds.run.path
    again = copied.calibrate("thresholds", source=source, overrides=["profile.detector.region=3"])
    assert again.stored.entry.origin["detector"]["region"] == 3


@pytest.mark.parametrize(
    ("kind", "shots", "change", "why"),
    [
        ("sites", 3, "loading=0 %", "no lattice found"),
        ("thresholds", 30, "loading=0 %", "show only one peak"),
        ("sites", 2, "image.photoelectrons=200000", "first frame of shot 0 are saturated; use less light"),
    ],
)
def test_an_analysis_that_fails_says_why_and_keeps_what_is_in_use(
    copied: Any, kind: CalibrationKind, shots: int, change: str, why: str
) -> None:
    before = copied.store.active()
    with pytest.raises(DeviceError, match=why) as caught:
        copied.calibrate(kind, shots=shots, overrides=[f"profile.simulation.{change}"])
    assert caught.value.exit_code == 3
    assert copied.store.active() == before
    assert len(copied.store.entries()) == 2
    (warning,) = (values["text"] for name, values in copied.observer.events if name == "warning")
    assert "analyse the run again" in warning


def test_sites_of_an_irregular_array_come_from_a_file(lab: Any) -> None:
    path = lab.folder / "sites.npy"
    np.save(path, TRUE_PX)
    outcome = lab.calibrate("sites", source=path)
    assert (outcome.run, outcome.stored.picture) == (None, None)
    assert np.array_equal(outcome.stored.entry.values["positions_px"], TRUE_PX)
    assert outcome.stored.entry.origin["file"] == str(path)
    assert lab.store.active()["sites"].id == outcome.stored.entry.id


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("sites", "outside.npy", "outside of the frame of 160 x 176 pixels"),
        ("thresholds", "outside.npy", "a calibration of thresholds cannot be made from a file"),
        ("sites", "none", "none: no such file or folder, and no run of this name"),
    ],
)
def test_a_source_with_an_error_is_refused(lab: Any, kind: str, name: str, message: str) -> None:
    np.save(lab.folder / "outside.npy", TRUE_PX + 100)
    with pytest.raises(ConfigError, match=message):
        lab.calibrate(kind, source=lab.folder / name)
    assert lab.store.entries() == []


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("overlay", "the run does not scan the offset of a probe"),
        ("frequencies", "the run does not scan the offset of a probe"),
        ("tweezers", "no shot of this run equalised the tweezers; expected a run with the step"),
    ],
)
def test_a_run_for_another_kind_is_refused(measured: Any, lab: Any, kind: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        lab.calibrate(kind, source=measured.sites.run.path)
    assert not lab.store.active()


def test_a_run_of_another_lab_is_refused(measured: Any, lab: Any) -> None:
    source = measured.sites.run.path
    lab.write_profile(PROFILE.replace("rows: 6", "rows: 5"))
    with pytest.raises(ConfigError, match="the run has a grid of 6 x 6 sites; expected 5 x 6"):
        lab.calibrate("sites", source=source)
    lab.write_profile(PROFILE.replace("4.49 um}", "4.49 um, shear: -1}"))
    with pytest.raises(ConfigError, match=r"grid of 6 x 6 sites.*shear \+1; expected 6 x 6 .*shear -1"):
        lab.calibrate("sites", source=source)


def test_a_simulated_run_serves_dry_runs_only(measured: Any, lab: Any) -> None:
    (lab.folder / "plugins").mkdir()
    (lab.folder / "plugins" / "slow.py").write_text(
        "import labseq\nfrom labseq_virtual.camera import VirtualCamera\n"
        "from labseq_virtual.settings import CameraSettings\nLABSEQ_API = 1\n"
        "@labseq.plugin.hookimpl\n"
        "def labseq_register(registry): registry.camera('slow', VirtualCamera, CameraSettings)\n",
        "utf-8",
    )
    lab.write_profile(PROFILE + "plugin_folders: [plugins]\n")
    text = lab.profile.read_text("utf-8")
    lab.profile.write_text(text.replace("camera: {use: virtual}", "camera: {use: slow}"), "utf-8")
    source = measured.sites.run.path
    with pytest.raises(ConfigError, match="the run was simulated; expected a run with real devices"):
        lab.calibrate("sites", source=source)
    outcome = lab.calibrate("sites", source=source, dry_run="full")
    assert outcome.stored.path.parent == lab.store.folder / "dry-run"


def test_a_run_without_frames_is_refused(lab: Any) -> None:
    with pytest.raises(ConfigError, match="the first image of shot 0 was not kept"):
        lab.calibrate("sites", shots=1, overrides=["record_frames=none"])


def test_a_choice_in_the_profile_is_reported(lab: Any, measured: Any) -> None:
    lab.write_profile(PROFILE + "calibrations: {use: {sites: off}}\n")
    warnings = lab.calibrate("sites", source=measured.sites.run.path).warnings
    assert any("'calibrations.use.sites: off'" in warning for warning in warnings)


def test_the_time_to_the_light_is_measured_and_used_instead_of_the_profiles(
    tmp_path: Path, make_lab: Any
) -> None:
    lab = make_lab(tmp_path, PROFILE)
    assert resolve_profile(str(lab.profile)).motion.overhead_per_cycle_s == 13e-3
    outcome = lab.calibrate("timing", shots=5)
    assert not outcome.refused
    assert outcome.stored.entry.quality["n_cycles"] == 5
    (overhead_s,) = outcome.stored.entry.values["overhead_s"]
    assert overhead_s > 0.0  # of this computer: the devices of the profile model no time
    assert resolve_profile(str(lab.profile)).motion.overhead_per_cycle_s == overhead_s
    again = lab.calibrate("timing", source=outcome.run.path)
    assert again.stored.entry.values["overhead_s"] == [overhead_s]
    with pytest.raises(ConfigError, match="no shot of this run moved atoms"):
        lab.calibrate("timing", shots=1, overrides=["profile.simulation.loading=0 %"])


@pytest.mark.parametrize(("is_simulated", "expected_s"), [(False, 10e-3), (True, 17e-3)])
def test_the_time_to_the_light_is_the_median_without_the_detection(
    is_simulated: bool, expected_s: float
) -> None:
    """Of three cycles; the stages count from the frame. Simulated devices wait for no computer."""
    timing = [
        StageTiming(stage, 2, cycle, 0.0, duration_s, host_s)
        for cycle, light_s in enumerate((12e-3, 42e-3, 11e-3))
        for stage, duration_s, host_s in (
            ("detect", 2e-3, 5e-3),
            ("plan", 1e-3, 1e-3),
            ("light", light_s, 12e-3),
        )
    ]
    run: Any = SimpleNamespace(shots=[SimpleNamespace(timing=timing)], simulated=is_simulated)
    found = analyse_timing(CalibrationData(run, cast("Any", None)))
    assert found.values["overhead_s"] == pytest.approx([expected_s])
    assert found.quality["n_cycles"] == 3


def test_the_atoms_of_all_shots_at_an_offset_are_counted_together(measured: Any) -> None:
    rng, here, there = np.random.default_rng(1), (1e-7, 0.0), (0.0, -2e-7)
    seen = rng.random((3, 3, 6, 6)) < 0.6  # of three images; the first and the last count
    shots = [
        SimpleNamespace(index=i, parameters={f"shot.2{PROBE_ADDRESS}": offset}, occupancies=seen[i])
        for i, offset in enumerate((here, there, here))
    ]
    run: Any = SimpleNamespace(shots=shots, record=measured.sites.run.record, path=measured.folder)
    probed = count_probed(run)
    assert probed.offset_m.tolist() == [[*here], [*there]]
    before, after = seen[:, 0].astype(int), (seen[:, 0] & seen[:, 2]).astype(int)
    np.testing.assert_array_equal(probed.n_before, [before[0] + before[2], before[1]])
    np.testing.assert_array_equal(probed.n_survived, [after[0] + after[2], after[1]])


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_every_sequence_can_be_run_on_every_profile_with_virtual_devices(method: Any) -> None:
    needs_meter = method.kind in ("tweezers", "amplitudes")
    assembly = assemble(method.sequence, Options("practice" if needs_meter else "virtual"))
    assert assembly.sequence.name == f"calibrate-{method.kind}"
    takes_frames = method.kind not in ("tweezers", "amplitudes", "timing")
    assert assembly.sequence.record_frames == ("all" if takes_frames else "none")
    assert not assembly.warnings
