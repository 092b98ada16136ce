"""A run's images once more: its own planner and detector give the same, others what they give anywhere."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import labseq
from labseq.analysis.replay import ReplayRequest, replay, shots_of
from labseq.calibration_store import Store
from labseq.data.reader import open_run
from labseq.errors import ConfigError, RecordingError
from labseq.files import packaged_profiles_dir
from labseq.model import SiteGrid
from labseq.recording.folders import INDEX_FILE, STATE_FILE
from labseq.testing.fakes.records import fake_calibration

from .whole_runs import SMALL_FRAMES

PLUGIN = """
import labseq
LABSEQ_API = 1

class Lazy:
    degree_of_parallelism = 1
    def __init__(self, settings, context):
        pass
    def plan(self, occupancy, target):
        return labseq.Plan.from_batches(BATCHES)

class Blinking:
    def __init__(self, settings, context):
        self.shape = context.grid.shape
    def detect(self, frame):
        raise RuntimeError("closed")

@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("lazy", Lazy)
    registry.detector("blinking", Blinking)
"""
SEQUENCE = """labseq: 1
name: replayed
shots: 4
seed: 5
plugin_folders: [mine]
target: {pattern: compact, rows: 12, cols: 12}
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms}
  - image: {exposure: 45 ms}
"""
SCAN = """labseq: 1
name: scanned
seed: 5
target: {pattern: compact, rows: 12, cols: 12}
planner: {use: psca}
scan:
  planner.use: [psca, tetris]
  profile.detector.threshold: [1630, 1500]
order: shuffled
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms}
"""


def write_plugin(folder: Path, batches: str = "[]") -> None:
    (folder / "mine").mkdir(exist_ok=True)
    (folder / "mine" / "lazy.py").write_text(PLUGIN.replace("BATCHES", batches))


def take(folder: Path, text: str, *overrides: str, **options: Any) -> labseq.Run:
    write_plugin(folder)
    options["overrides"] = [*SMALL_FRAMES, *overrides]
    path = folder / "replayed.yaml"
    path.write_text(text)
    with labseq.Session.open(path, output=folder / "data", **options) as session:
        return session.run()


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    return take(tmp_path_factory.mktemp("taken"), SEQUENCE)


def test_the_planner_and_detector_of_the_run_give_what_was_recorded(taken):
    found = replay(taken, ReplayRequest())
    assert found.is_own
    assert found.is_reproduced
    assert len(found.plans) == sum(len(shot.plans) for shot in taken.shots) > 4
    assert len(found.images.images) == sum(len(shot.frames) for shot in taken.shots)
    assert {plan.same for plan in found.plans} == {True}
    for plan in found.plans:
        assert plan.replayed is not None
        assert (plan.recorded.n_batches, plan.recorded.duration_s) == (
            plan.replayed.n_batches,
            plan.replayed.duration_s,
        )
        assert plan.recorded.planning_s > 0


def test_every_point_of_a_scan_has_its_own_settings(tmp_path):
    run = take(tmp_path, SCAN)
    assert len({shot.parameters["planner.use"] for shot in run.shots}) == 2
    found = replay(run, ReplayRequest())
    assert found.is_reproduced
    assert (len(found.plans), found.images.n_differing) == (4, 0)


def test_another_planner_is_checked_and_counted(taken):
    found = replay(taken, ReplayRequest(planner="tetris", degree_of_parallelism=3))
    assert not found.is_own
    assert found.used == {"planner": {"use": "tetris", "degree_of_parallelism": 3}}
    assert not found.images.images
    planner = labseq.make_planner("tetris", degree_of_parallelism=3)
    first = planner.plan(taken.shots[0].occupancies[0], taken.target)
    counted = found.plans[0].replayed
    assert counted is not None
    assert (counted.n_batches, counted.n_atom_moves) == (first.n_batches, first.n_atom_moves)
    assert counted.meets_target
    assert counted.filling == 1.0


def test_one_setting_of_the_own_planner_can_be_changed(taken):
    found = replay(taken, ReplayRequest(overrides=["planner.degree_of_parallelism=2"], shots=" 0 , 0-0"))
    assert found.used["planner"]["degree_of_parallelism"] == 2
    assert found.changed == {"planner": {"degree_of_parallelism": 2}}
    assert found.n_shots == 1
    assert {plan.shot for plan in found.plans} == {0}


@pytest.mark.parametrize(
    ("batches", "rule"), [("[([(0, 0)], [(3, 3)])]", "breaks the rule"), ("1 / 0", "ZeroDivisionError")]
)
def test_a_plan_that_fails_is_reported(taken, batches, rule):
    folder = taken.path.parents[2]
    write_plugin(folder, batches)
    found = replay(taken, ReplayRequest(planner="lazy"))
    write_plugin(folder)
    assert {plan.replayed for plan in found.plans} == {None}
    assert all(rule in plan.failure and "lazy" in plan.failure for plan in found.plans)


def test_changed_code_is_noticed(tmp_path):
    run = take(tmp_path, SEQUENCE.replace("psca", "lazy").replace("shots: 4", "shots: 1"))
    assert replay(run, ReplayRequest()).is_reproduced
    row = run.shots[0].occupancies[0][5]
    source = int(np.flatnonzero(row[:-1] & ~row[1:])[0])
    write_plugin(tmp_path, f"[([(5, {source})], [(5, {source + 1})])]")
    found = replay(run, ReplayRequest())
    assert found.is_own
    assert not found.is_reproduced


def test_another_detector_is_compared_site_by_site(taken):
    found = replay(taken, ReplayRequest(overrides=["profile.detector.threshold=1e6"]))
    n_seen = sum(shot.occupancies.sum(axis=0) for shot in taken.shots)
    assert (found.images.vanished == n_seen).all()
    assert not found.images.appeared.any()
    assert not found.plans
    last = [image for image in found.images.images if image.n_atoms_true is not None]
    assert [image.n_atoms_true for image in last] == [
        shot.readings["simulation.n_atoms_true"] for shot in taken.shots
    ]
    assert {image.n_atoms_replayed for image in last} == {0}
    failing = replay(taken, ReplayRequest(detector="blinking", shots="1")).images.failures
    assert {place: text.partition(" (")[0] for place, text in failing.items()} == {
        (1, i): "RuntimeError: closed" for i in range(len(taken.shots[1].occupancies))
    }


def test_frames_that_were_not_kept_are_no_failure(tmp_path):
    run = take(tmp_path, SEQUENCE, "record_frames=last", shots=1)
    found = replay(run, ReplayRequest())
    assert found.is_reproduced
    assert (len(found.images.images), len(found.plans) > 0) == (1, True)
    assert found.images.n_without_frame == len(run.shots[0].occupancies) - 1


def test_a_run_in_progress_is_replayed_as_far_as_it_is(taken, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(taken.path, folder)
    lines = (folder / INDEX_FILE).read_bytes().splitlines(keepends=True)
    (folder / INDEX_FILE).write_bytes(b"".join(lines[:2]) + lines[2][:50])
    (folder / STATE_FILE).unlink()
    found = replay(open_run(folder), ReplayRequest())
    assert (found.n_shots, found.is_reproduced) == (2, True)


def test_a_shot_that_cannot_be_read_is_left_out_and_reported(taken, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(taken.path, folder)
    open_run(folder).shots[1].file.unlink()
    found = replay(open_run(folder), ReplayRequest())
    assert (found.n_shots, list(found.unreadable)) == (3, [1])
    assert not found.is_reproduced


def test_a_shot_with_two_frames_of_an_image_is_left_out_and_reported(taken, tmp_path):
    folder = shutil.copytree(taken.path, tmp_path / taken.path.name)
    with h5py.File(open_run(folder).shots[1].file, "r+") as file:
        numbers: Any = file["entry/camera/camera/image"]
        numbers[:] = 0
    found = replay(open_run(folder), ReplayRequest())
    assert list(found.unreadable) == [1]
    assert "two frames of image 0" in found.unreadable[1]
    assert found.n_shots == 3


def test_calibrations_come_from_the_run_s_own_folder(tmp_path):
    profile, store = tmp_path / "own.yaml", Store(tmp_path / "calibrations" / "own")
    shutil.copy(packaged_profiles_dir() / "virtual.yaml", profile)
    thresholds = np.full((20, 20), 1630.0)
    thresholds[:, 3] = 1e9  # a column that seems empty
    entry = fake_calibration("thresholds", values={"thresholds": thresholds})
    store.use(store.add(entry), SiteGrid())
    run = take(tmp_path, SEQUENCE, profile=str(profile), shots=1)
    assert not run.shots[0].occupancies[0][:, 3].any()
    profile.unlink()
    shutil.rmtree(tmp_path / "calibrations")
    assert replay(run, ReplayRequest()).is_reproduced
    (run.path / "calibration_thresholds.json").unlink()
    with pytest.raises(ConfigError, match=r"calibration_thresholds\.json: it cannot be read"):
        replay(run, ReplayRequest())


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        (ReplayRequest(planner="tetri"), "--planner tetri: unknown planner 'tetri'.*did you mean 'tetris'"),
        (ReplayRequest(degree_of_parallelism=0), "--dop 0: degree_of_parallelism is 0; expected at least 1"),
        (ReplayRequest(overrides=["planner.dop=3"]), "--set planner.dop=3: .*degree_of_parallelism"),
        (ReplayRequest(overrides=["shots=3"]), "only change the planner and the detector"),
    ],
)
def test_what_cannot_be_tried_is_refused(taken, request_, expected):
    with pytest.raises(ConfigError, match=expected):
        replay(taken, request_)


def test_a_text_that_was_edited_is_refused(taken, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(taken.path, folder)
    (folder / "sequence.yaml").write_text(SEQUENCE + "# later\n")
    with pytest.raises(RecordingError, match=r"sequence.yaml: is not the file described in run.json"):
        replay(open_run(folder), ReplayRequest())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "'' is not a shot; expected numbers such as 3,5-9"),
        ("-1", "'-1' is not a shot"),
        ("4", "there is no shot 4; expected 0 to 3"),
        ("3-1", "3-1 goes backwards; expected 1-3"),
    ],
)
def test_shots_that_are_not_there(taken, text, expected):
    with pytest.raises(ConfigError, match=expected):
        shots_of(taken, text)
