"""Adaptive scans: points chosen during the run, on record, resumed; and scanners that do wrong."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.data.points import scan_points
from labseq.errors import ConfigError, DeviceError
from labseq.recording import shot_file
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

from .scripted_scanner import N_LINES, OVER, SEQUENCE, opened, run

DOP = "planner.degree_of_parallelism"


@pytest.mark.parametrize(("aim", "best_of"), [("maximise", max), ("minimise", min)])
def test_each_point_is_chosen_by_what_came_of_those_before(tmp_path: Path, aim: str, best_of: Any) -> None:
    seen, over = RecordingObserver(), OVER.replace("maximise", aim)
    done = run(tmp_path, f"use: scripted, dops: [5, 5, 3], {over}, points: 5", "repeats: 2\n", observer=seen)
    assert done.status == "complete"
    assert [shot.parameters[DOP] for shot in done.shots] == [5, 5, 5, 5, 3, 3]
    points = [values for name, values in seen.events if name == "scan_point"]
    filling = [np.mean([shot.filling_fraction for shot in done.shots[i : i + 2]]) for i in (0, 2, 4)]
    assert [values["value"] for values in points] == pytest.approx(filling)
    of_points = {"5": (filling[0] + filling[1]) / 2, "3": filling[2]}
    best = best_of(of_points, key=lambda dop: of_points[dop])
    assert points[-1]["best"]["written"] == {DOP: best}
    assert points[-1]["best"]["value"] == pytest.approx(of_points[best])


def test_a_point_visited_twice_is_one_point_of_the_scan(tmp_path: Path) -> None:
    done = run(tmp_path, f"use: scripted, dops: [3, 5, 3], {OVER}, points: 3")
    points = scan_points(done)
    assert [(point.parameters[DOP], len(point.shots)) for point in points] == [(3, 2), (5, 1)]
    assert [point.written[DOP] for point in points] == ["3", "5"]
    assert done.scan["point_of_shot"] == [0, 1, 0]
    record = json.loads((done.path / "run.json").read_text("utf-8"))["scan"]
    assert (record["addresses"], record["figure"], record["n_points"]) == ([DOP], "filling_fraction", 3)
    assert record["ranges"][0].items() >= {"address": DOP, "low": 1, "high": 9, "start": 2.0}.items()
    assert record["scanner"] == {"use": "scripted", "dops": [3, 5, 3], "then": "end"}
    assert done.to_xarray(occupancies=False)["filling_fraction"].dims == (DOP, "repeat")


def test_quantities_are_recorded_in_their_unit_and_chosen_in_si(tmp_path: Path) -> None:
    scan = """use: climb, over: {profile.mobile_tweezers.pick_up: {from: 20 us, to: 0.4 ms, steps: 19},
        shot.sort.window: {from: 10 ms, to: 60 ms}}, minimise: duration_s, points: 4"""
    done = run(tmp_path, scan)
    parameters = [tuple(shot.parameters[a] for a in done.scan["addresses"]) for shot in done.shots]
    assert parameters[0] == pytest.approx((60e-6, 60e-3))  # as in the files
    for pick_up, window in parameters:
        assert 20e-6 <= pick_up <= 400e-6
        assert (pick_up - 20e-6) / 20e-6 == pytest.approx(round((pick_up - 20e-6) / 20e-6))
        assert 0.01 <= window <= 0.06
    assert done.scan["written"][0] == ["60 us", "60 ms"]
    assert all(
        shot.cycles[0].window_s == window for shot, (_, window) in zip(done.shots, parameters, strict=True)
    )


def test_a_scan_of_images_reads_each_shot_once_and_again_for_its_best_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, read_content = list[str](), shot_file.read_content

    def noting(path: Path) -> shot_file.ShotContent:
        read.append(path.name)
        return read_content(path)

    monkeypatch.setattr(shot_file, "read_content", noting)
    scan = f"use: scripted, dops: [3, 5, 3], {OVER}, points: 3".replace("filling_fraction", "survival")
    done = run(tmp_path, scan, "repeats: 2\n")
    assert Counter(read) == {shot.file.name: 2 for shot in done.shots}


def test_a_scanner_may_end_the_run_and_then_it_is_complete(tmp_path: Path) -> None:
    seen = RecordingObserver()
    done = run(tmp_path, f"use: scripted, dops: [3, 5], {OVER}, points: 5", observer=seen)
    assert (done.status, len(done.shots), done.n_shots) == ("complete", 2, 5)
    assert ("scan_ended", {"scanner": "scanner 'scripted'", "n_shots": 2}) in seen.events
    with pytest.raises(ConfigError, match="it is complete"):
        labseq.Session.resume(done.path)


@pytest.mark.parametrize(
    ("scripted", "message", "n_shots"),
    [
        ("dops: [3], then: hang", r"scanner 'scripted': .*did not answer within 0.3 s", 1),
        ("dops: []", "gave no point at all", None),
    ],
)
def test_a_scanner_without_an_answer_ends_the_run(
    tmp_path: Path, scripted: str, message: str, n_shots: int | None
) -> None:
    overrides = ["profile.timeouts.call=0.3 s"]
    with opened(tmp_path, f"use: scripted, {scripted}, {OVER}, points: 5", overrides=overrides) as session:
        with pytest.raises(DeviceError, match=message):
            session.run()
        taken = session.run_dir and len(labseq.open_run(session.run_dir).shots)
    assert taken == n_shots  # None: no folder was made


@pytest.mark.parametrize(
    ("then", "text"),
    [
        ("nan", f"next_point() gave nan for '{DOP}'; expected a whole number from 1 to 9"),
        ("half", f"next_point() gave 2.5 for '{DOP}'; expected"),
        ("other", f"next_point() gave values for 'planner.use'; expected a value for each of '{DOP}'"),
        ("list", f"next_point() gave a list; expected a value for each of '{DOP}'"),
        ("raise", "next_point() raised RuntimeError: no idea"),
    ],
)
def test_a_wrong_answer_names_the_scanner_and_what_was_taken_stays(
    tmp_path: Path, then: str, text: str
) -> None:
    with opened(tmp_path, f"use: scripted, dops: [3], then: {then}, {OVER}, points: 5") as session:
        with pytest.raises(DeviceError) as caught:
            session.run()
        assert session.run_dir is not None
        done = labseq.open_run(session.run_dir)
    assert str(caught.value).startswith("scanner 'scripted': ")
    assert text in str(caught.value)
    assert len(str(caught.value)) < 300
    assert caught.value.exit_code == 3
    assert (done.status, len(done.shots)) == ("failed", 1)
    done.shots[0].verify()


def test_a_shot_that_is_gone_is_taken_again_at_its_point(tmp_path: Path) -> None:
    done = run(tmp_path, f"use: scripted, dops: [3, 5, 3, 9], {OVER}, points: 4")
    before = [shot.occupancies.tobytes() for shot in done.shots]
    for index in (0, 2):
        done.shots[index].file.unlink()
    with labseq.Session.resume(done.path) as session:
        again = session.run()
    assert [shot.parameters[DOP] for shot in again.shots] == [3, 5, 3, 9]
    assert [shot.occupancies.tobytes() for shot in again.shots] == before


def test_a_missing_quantity_is_one_warning_and_no_score(tmp_path: Path) -> None:
    seen = RecordingObserver()
    over = OVER.replace("filling_fraction", "reading.simulation.power_w")
    run(tmp_path, f"use: scripted, dops: [3, 5], {over}, points: 2", observer=seen)
    (warning,) = [values["text"] for name, values in seen.events if name == "warning"]
    assert warning.startswith("shot 0 has no 'reading.simulation.power_w' to optimise")
    points = [values for name, values in seen.events if name == "scan_point"]
    assert [(values["value"], values["best"]) for values in points] == [(None, None)] * 2


def test_an_option_takes_the_place_of_a_range(tmp_path: Path) -> None:
    scan = """use: climb, over: {planner.degree_of_parallelism: {from: 1, to: 9},
        shot.sort.window: {from: 10 ms, to: 60 ms}}, maximise: filling_fraction, points: 3"""
    with opened(tmp_path, scan, overrides=[f"{DOP}=4"]) as session:
        assert session.assembly.warnings == (f"--set {DOP}=4 replaces the scan of '{DOP}'",)
        done = session.run()
    assert done.scan["addresses"] == ["shot.sort.window"]
    with pytest.raises(ConfigError, match="nothing is left to choose"):
        opened(tmp_path, f"use: climb, {OVER}, points: 3", overrides=[f"{DOP}=4"])


def test_the_check_shows_the_most_points_and_the_time_of_the_slowest_corner(tmp_path: Path) -> None:
    scan = "use: climb, over: {shot.0.load.duration: {from: 1 s, to: 3 s}}, maximise: success, points: 3"
    report = check(opened(tmp_path, scan, "repeats: 2\n"))
    assert (report.n_points, report.n_shots) == (3, 6)
    alone = check(opened(tmp_path, scan, overrides=["scan=~", "shots=6", "shot.0.load.duration=3 s"]))
    assert report.run_s[1] == pytest.approx(alone.run_s[1])


def test_shots_limit_a_scan_without_points_and_end_a_point_early(tmp_path: Path) -> None:
    done = run(tmp_path, f"use: scripted, dops: [3, 5, 7], {OVER}", "shots: 5\nrepeats: 2\n", shots=3)
    assert [shot.parameters[DOP] for shot in done.shots] == [3, 3, 5]


BOTH = "from: 1, to: 9"


@pytest.mark.parametrize(
    ("scan", "text"),
    [
        ("use: climb", "1:7: 'over' is missing"),
        (f"use: clim, {OVER}, points: 3", "1:13: unknown scanner 'clim'; expected one of"),
        (f"use: climb, {OVER}", "1:7: 'points' (the maximum number of points) is missing from 'scan'"),
        (f"use: climb, {OVER}, points: 3, stop: 0.1", "'stop' is not a setting of scanner 'climb'"),
        (f"use: climb, over: {{{DOP}: {{from: 1}}}}, maximise: success, points: 3", "'to' is missing"),
        (f"use: climb, over: {{{DOP}: [1, 9]}}, maximise: success, points: 3", f"{DOP} is a list"),
        (
            f"use: climb, over: {{{DOP}: {{from: 9, to: 1}}}}, maximise: success, points: 3",
            "goes from 9 to 1",
        ),
        (
            f"use: climb, over: {{{DOP}: {{from: 0, to: 9}}}}, maximise: success, points: 3",
            f"from the scan of '{DOP}'",
        ),
        (f"use: climb, {OVER}, minimise: success, points: 3", "'maximise' and 'minimise' are both given"),
        (
            f"use: climb, over: {{{DOP}: {{from: 1, to: 9 ms}}}}, maximise: success, points: 3",
            "'9 ms' and 1 have different dimensions; expected a number without a unit",
        ),
        (
            f"use: climb, over: {{{DOP}: {{{BOTH}, steps: 3}}}}, maximise: success, points: 3",
            "3 equal steps from 1 to 9 are not whole numbers; expected a number of steps that divides 8",
        ),
        (
            f"use: climb, over: {{grid.rows: {{{BOTH}}}}}, maximise: success, points: 3",
            "there is no 'grid' in",
        ),
        (
            f"use: climb, over: {{{DOP}: {{{BOTH}}}}}, points: 3",
            "the scan has neither 'maximise' nor 'minimise'",
        ),
        (
            f"use: climb, over: {{{DOP}: {{{BOTH}}}}}, maximise: filling:aft, points: 3",
            "there is no image 'aft' for 'filling:aft' to optimise; expected",
        ),
        (f"use: scripted, then: refuse, {OVER}, points: 3", "it does not want to"),
    ],
)
def test_a_wrong_scan_is_refused_with_its_place(tmp_path: Path, scan: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, scan)
    lines = str(caught.value).replace(f"s.yaml:{N_LINES + 1}:", "s.yaml:1:")
    lines += str([problem.notes for problem in caught.value.problems])
    assert text in lines
    assert all(problem.line == N_LINES + 1 for problem in caught.value.problems), lines


def test_a_scan_whose_shots_were_all_skipped_is_complete_when_it_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = SEQUENCE.replace("500 ms}", "500 ms}\n    policy: {timeout: 1 ms, on_failure: skip_point}")
    monkeypatch.setattr("tests.session.scripted_scanner.SEQUENCE", late)
    done = run(tmp_path, f"use: scripted, dops: [3, 5], {OVER}, points: 5")
    assert (done.status, len(done.shots), [*done.skipped]) == ("complete", 0, [0, 1])
    assert [point[0] for point in done.scan["points"]] == [3, 5]
    state = json.loads((done.path / "STATE").read_text("utf-8"))  # as if it had died before its last word
    (done.path / "STATE").write_text(json.dumps({**state, "state": "failed"}), "utf-8")
    with labseq.Session.resume(done.path) as session:
        again = session.run()
    assert (again.status, again.skipped) == ("complete", done.skipped)
