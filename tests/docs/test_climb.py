"""The how-to of adaptive scans does what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import labseq
from labseq.analysis.scanned import ScanRequest
from labseq.cli.check import check_sequence
from labseq.cli.show import Tables, show_run
from labseq.recording.points import scan_points

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "climb.md"
SEQUENCE = ROOT / "sequences" / "climb_dop_speed.yaml"
PROFILE = str(ROOT / "hardware_profiles" / "virtual.yaml")


def test_the_scan_of_the_page_is_that_of_the_sequence() -> None:
    (shown,) = re.findall(r"^```yaml\n(planner:.*?)^```$", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    file = "\n".join(line.partition("#")[0].rstrip() for line in SEQUENCE.read_text("utf-8").splitlines())
    for line in shown.splitlines():
        assert line in file.splitlines()


def test_the_climb_of_the_page(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    check_sequence(SEQUENCE, PROFILE, (), "off", as_json=False)
    reported = capfd.readouterr().out
    assert "planner.degree_of_parallelism from 2 to 15" in reported
    assert "points chosen during the run by climb, at most 30, 5 shots of each" in reported
    assert "at most 30 points, 150 shots" in reported
    few = ["repeats=2", "scan.points=12"]
    with labseq.Session.open(SEQUENCE, profile=PROFILE, seed=1, overrides=few, output=tmp_path) as session:
        run = session.run()
    points = scan_points(run)
    assert 5 < len(points) <= 12
    assert len(run.shots) == 2 * len(points)
    filling = [sum(shot.filling_fraction for shot in point.shots) for point in points]
    assert points[0].written == {
        "planner.degree_of_parallelism": "15",
        "profile.mobile_tweezers.speed": "130 um/ms",
    }
    assert max(filling[1:]) > filling[0]
    show_run(run.path, as_json=False, tables=Tables(scan=ScanRequest()))
    lines = capfd.readouterr().out.splitlines()
    assert lines[1].split()[:3] == ["15", "130", "um/ms"]
    assert len(lines) == 1 + len(points)
