"""Scans on the virtual lab: points checked, applied, recorded, and devices that stay open or are reopened."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.assembly.points import MAX_PROBLEMS, rebuild_lab
from labseq.data.points import scan_points
from labseq.errors import ConfigError
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

from . import small_runs
from .whole_runs import SMALL_FRAMES

ROOT = Path(__file__).parents[2]
REST = """labseq: 1
name: s
profile: virtual
seed: 5
record_frames: none
target: {pattern: compact, rows: 10, cols: 10}
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {}
  - {name: sort, rearrange: {window: 100 ms}}
  - image: {}
"""
N_REST = REST.count("\n")


def open_scan(folder: Path, text: str, **options: Any) -> labseq.Session:
    path = folder / "s.yaml"
    path.write_text(REST + text)
    profile = str(ROOT / "hardware_profiles" / "virtual.yaml")
    options["overrides"] = [*SMALL_FRAMES, *options.get("overrides", ())]
    return labseq.Session.open(path, profile=profile, output=folder / "data", **options)


def run(folder: Path, text: str, **options: Any) -> labseq.Run:
    with open_scan(folder, text, **options) as session:
        return session.run()


def states(observer: RecordingObserver) -> list[str]:
    return [values["state"] for name, values in observer.events if name == "state"]


def test_every_shot_is_taken_at_its_point_and_records_it(tmp_path: Path) -> None:
    text = "scan: {planner.degree_of_parallelism: [2, 5], shot.sort.window: [50 ms, 0.1 s]}\nrepeats: 2\n"
    done = run(tmp_path, text)
    assert done.status == "complete"
    expected = [(dop, window) for dop in (2, 5) for window in (0.05, 0.1) for _ in range(2)]
    for shot, (dop, window) in zip(done.shots, expected, strict=True):
        assert shot.parameters["planner.degree_of_parallelism"] == dop
        assert shot.parameters["shot.sort.window"] == window
        assert shot.record().parameters == shot.parameters
        assert shot.cycles[0].window_s == window
        assert max(len(batch) for plan in shot.plans for batch in plan.batches) == dop
    assert [p.parameters["shot.sort.window"] for p in scan_points(done)] == [0.05, 0.1] * 2
    assert [p.written["shot.sort.window"] for p in scan_points(done)] == ["50 ms", "0.1 s"] * 2


def test_devices_stay_open_while_only_planner_detector_and_steps_change(tmp_path: Path) -> None:
    observer = RecordingObserver()
    text = "scan: {planner: [{use: psca}, {use: lsap}], shot.sort.cycles: [1, 2]}\n"
    done = run(tmp_path, text, observer=observer)
    assert "reopening" not in states(observer)
    assert states(observer).count("opening") == 1
    assert done.shots[2].parameters["planner"] == {"use": "lsap"}
    assert {cycle.report is not None for shot in done.shots for cycle in shot.cycles} == {True}


def test_a_setting_of_the_motion_or_of_a_device_reopens_a_simulated_lab(tmp_path: Path) -> None:
    observer = RecordingObserver()
    speed = "profile.mobile_tweezers.speed: [50 um/ms, 200 um/ms]"
    text = f"scan: {{{speed}, profile.simulation.loading: [0.6, 0.9]}}\n"
    done = run(tmp_path, text, observer=observer)
    assert states(observer).count("reopening") == 3
    loaded = [shot.occupancies[0].mean() for shot in done.shots]
    assert np.allclose(loaded, [0.6, 0.9, 0.6, 0.9], atol=0.1)
    slow, fast = (shot.cycles[0].moves_s for shot in (done.shots[0], done.shots[2]))
    assert slow > fast


def test_a_shot_of_a_scan_is_the_same_as_in_a_run_with_its_values_set(tmp_path: Path) -> None:
    speed = "profile.mobile_tweezers.speed: [50 um/ms, 130 um/ms]"
    text = f"scan: {{{speed}, planner.degree_of_parallelism: [2, 5]}}\norder: shuffled\n"
    scanned = run(tmp_path, text)
    for shot, point in zip(scanned.shots, scanned.record["scan"]["point_of_shot"], strict=True):
        overrides = [f"{address}={value}" for address, value in scan_points(scanned)[point].written.items()]
        alone = run(tmp_path, f"shots: {shot.index + 1}\n", overrides=overrides).shots[shot.index]
        assert np.array_equal(shot.occupancies, alone.occupancies)
        assert [p.moves.tobytes() for p in shot.plans] == [p.moves.tobytes() for p in alone.plans]


def test_a_shuffled_order_follows_from_the_seed_and_is_recorded(tmp_path: Path) -> None:
    text = "scan: {shot.0.load.duration: {range: [50 ms, 100 ms, 10 ms]}}\nrepeats: 2\norder: shuffled\n"
    done = run(tmp_path, text)
    scan = json.loads((done.path / "run.json").read_text())["scan"]
    assert scan["order"] == "shuffled"
    order = scan["point_of_shot"]
    assert sorted(order) == sorted([*range(6), *range(6)])
    assert order != sorted(order)
    taken = [shot.parameters["shot.0.load.duration"] for shot in done.shots]
    assert taken == [scan["points"][p][0] for p in order]
    first = run(tmp_path, text, shots=3)
    assert [shot.parameters["shot.0.load.duration"] for shot in first.shots] == taken[:3]


def test_an_option_replaces_the_scan_of_its_address(tmp_path: Path) -> None:
    observer = RecordingObserver()
    text = "scan: {profile.mobile_tweezers.speed: [50 um/ms, 130 um/ms], shot.sort.window: [50 ms, 60 ms]}\n"
    done = run(tmp_path, text, overrides=["profile.mobile_tweezers.speed=100 um/ms"], observer=observer)
    assert len(done.shots) == 2
    assert done.record["resolved"]["profile"]["mobile_tweezers"]["speed"] == pytest.approx(0.1)
    warnings = [values["text"] for name, values in observer.events if name == "warning"]
    assert any("replaces the scan of 'profile.mobile_tweezers.speed'" in text for text in warnings)


WRONG = [
    (
        "scan: {planner.degree_of_parallelism: [0, 3, x], profile.mobile_tweezers.speed: [1 m/s, -2 m/s]}",
        [
            "40: degree_of_parallelism is 0 (from the scan of 'planner.degree_of_parallelism')",
            "46: degree_of_parallelism is 'x' (from the scan of 'planner.degree_of_parallelism')",
            "89: speed is '-2 m/s' (from the scan of 'profile.mobile_tweezers.speed')",
        ],
    ),
    (
        "scan: {shot.sort.cycles: [2, 3], shot.sort.window: [[60 ms, 40 ms], 60 ms]}",
        ["53: the list has 2 entries, but cycles is 3 (from the scan of 'shot.sort.window')"],
    ),
    ("scan: {profile.camera.gian: [3, 4]}", ["8: 'gian' is not a setting of camera 'virtual' ("]),
    ("scan: {profile.grid.rows: [19, 20]}", ["8: a scan cannot change 'profile.grid.rows' ("]),
    ("scan: {profile.calibrations.use.sites: [a, b]}", ["8: a scan cannot change 'profile.calibrations.use"]),
    ("scan: {profile.camera.use: [virtual, andor]}", ["38: a scan cannot change the driver of camera ("]),
    (
        "scan: {profile.mobile_tweezers: [{use: spcm, card: simulated}, {use: spcm, card: /dev/spcm0}]}",
        ["64: the scan would change whether mobile_tweezers is simulated (from the scan of"],
    ),
]


@pytest.mark.parametrize(("text", "messages"), WRONG, ids=[text for text, _ in WRONG])
def test_every_wrong_value_is_reported_with_its_place(tmp_path: Path, text: str, messages: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        open_scan(tmp_path, text + "\n")
    found = caught.value.problems
    assert {problem.line for problem in found} == {N_REST + 1}
    for problem, message in zip(found, messages, strict=True):
        assert f"{problem.column}: {problem.what} ({(*problem.notes, '')[0]})".startswith(message)


def test_a_target_that_does_not_fit_is_reported_in_a_scan_too(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the size of the target is 100 rows"):
        open_scan(tmp_path, "scan: {shot.sort.cycles: [2, 3]}\n", overrides=["target.rows=100"])


def test_after_many_wrong_values_no_further_point_is_tried(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        open_scan(tmp_path, f"scan: {{shot.sort.cycles: {list(range(-3 * MAX_PROBLEMS, 0))}}}\n")
    assert len(caught.value.problems) == MAX_PROBLEMS + 1  # the first is also in the file


def test_without_a_simulation_only_what_changes_is_reopened(tmp_path: Path) -> None:
    text = """scan:
  - profile.mobile_tweezers.speed: [50 um/ms, 60 um/ms, 60 um/ms]
    profile.mobile_tweezers.eject_slots: [1, 1, 2]
"""
    (tmp_path / "s.yaml").write_text(REST + text)
    session = labseq.Session.open(tmp_path / "s.yaml", profile="bench_awg")
    lab = replace(session.build_lab(), simulation=None)
    points = [session.assembly.at(point) for point in range(3)]
    after, reopened = rebuild_lab(lab, points[0], points[1], 5)
    assert (reopened, after.motion.speed_m_s) == (frozenset(), 0.06)
    assert after.mobile_tweezers is lab.mobile_tweezers
    assert after.planner is not lab.planner
    assert len(after.random_streams) == len(lab.random_streams)
    assert rebuild_lab(lab, points[1], points[2], 5)[1] == {"mobile_tweezers"}


def test_the_check_shows_points_and_the_time_of_all_of_them(tmp_path: Path) -> None:
    report = check(open_scan(tmp_path, "scan: {shot.0.load.duration: [1 s, 3 s]}\nrepeats: 2\n"))
    assert (report.n_points, report.n_shots) == (2, 4)
    alone = check(open_scan(tmp_path, "shots: 4\n", overrides=["shot.0.load.duration=2 s"]))
    assert alone.n_points is None
    assert report.run_s == pytest.approx(alone.run_s)


def test_a_resumed_scan_is_as_long_as_the_whole_one(tmp_path: Path) -> None:
    path = small_runs.write(tmp_path)
    text = small_runs.SEQUENCE.replace("SCAN", "scan: {shot.0.load.duration: [100 ms, 900 ms]}")
    path.write_text(text, "utf-8")
    run_dir = small_runs.interrupted(path, "shot_started", 2)
    with labseq.Session.resume(run_dir) as session:
        assert session.history.to_take == [1]
        assert check(session).run_s == check(labseq.Session.open(path)).run_s
