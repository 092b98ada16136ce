"""Scans as ``labseq check`` and ``show`` tell of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from labseq.cli.check import check_sequence
from labseq.cli.show import show_run
from labseq.session.session import Session

ROOT = Path(__file__).parents[2]
SCAN = ROOT / "sequences" / "scan_dop.yaml"
DOPS = "3 5 7 15"
PROFILE = str(ROOT / "hardware_profiles" / "virtual.yaml")


def test_check_reports_points_shots_and_time(capfd: pytest.CaptureFixture[str]) -> None:
    check_sequence(SCAN, PROFILE, (), "off", as_json=False)
    printed = capfd.readouterr().out
    assert "4 values of planner.degree_of_parallelism 3 to 15" in printed
    assert "4 points, 10 shots of each, shuffled" in printed
    assert "4 points, 40 shots, " in printed


def test_check_says_that_an_option_replaces_the_scan(capfd: pytest.CaptureFixture[str]) -> None:
    overrides = ["planner.degree_of_parallelism=7"]
    check_sequence(SCAN, PROFILE, overrides, "off", as_json=True)
    answer = json.loads(capfd.readouterr().out)
    assert (answer["points"], answer["shots"]) == (1, 10)
    (warning,) = answer["warnings"]
    assert "replaces the scan of 'planner.degree_of_parallelism'" in warning["what"]


def test_a_run_of_the_first_shots_and_the_table_of_its_points(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    frames = ["record_frames=none"]
    with Session.open(SCAN, profile=PROFILE, shots=8, seed=1, output=tmp_path, overrides=frames) as session:
        folder = session.run().path
    show_run(folder, as_json=False)
    lines = capfd.readouterr().out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("planner.degree_of_parallelism"))
    assert lines[start].split() == ["planner.degree_of_parallelism", "shots", "filling", "defect-free"]
    assert [line.split()[:2] for line in lines[start + 1 : start + 5]] == [[dop, "2"] for dop in DOPS.split()]
    show_run(folder, as_json=True)
    points = json.loads(capfd.readouterr().out)["points"]
    assert [point["parameters"]["planner.degree_of_parallelism"] for point in points] == [
        *map(int, DOPS.split())
    ]
    assert {point["shots"] for point in points} == {2}
