"""Adaptive scans as ``labseq run``, ``show``, ``watch`` and ``export`` tell of them."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

import labseq
from labseq.analysis.scanned import ScanRequest
from labseq.cli.live import Picture, Tally, draw_scan
from labseq.cli.show import Tables, show_run
from labseq.console.arrays import UNICODE
from labseq.console.events import LogLines, event_text
from labseq.data.follower import Follower
from labseq.data.points import scan_points
from tests.session.small_runs import PROFILE

DOP = "planner.degree_of_parallelism"
SEQUENCE = """labseq: 1
name: climbs
profile: ./p.yaml
seed: 3
record_frames: none
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca, degree_of_parallelism: 2}
scan:
  use: climb
  over:
    planner.degree_of_parallelism: {from: 1, to: 9}
    shot.2.rearrange.window: {from: 10 ms, to: 60 ms}
  maximise: filling_fraction
  points: 5
repeats: 2
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms}
  - image: {exposure: 45 ms}
"""


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> tuple[labseq.Run, list[str]]:
    """A run, and the lines that it printed."""
    folder = tmp_path_factory.mktemp("climbs")
    (folder / "p.yaml").write_text(PROFILE, "utf-8")
    (folder / "s.yaml").write_text(SEQUENCE, "utf-8")
    stream = io.StringIO()
    with labseq.Session.open(folder / "s.yaml", output=folder, observer=LogLines(stream)) as session:
        return session.run(), stream.getvalue().splitlines()


def test_each_point_is_reported_with_the_best_so_far(printed: tuple[labseq.Run, list[str]]) -> None:
    lines = [line for line in printed[1] if line.startswith("point ")]
    assert len(lines) == 5
    assert lines[0].startswith(f"point 0 ({DOP} 2, shot.2.rearrange.window 60 ms): filling_fraction ")
    assert lines[0].endswith("best so far this")
    assert all("; best so far " in line for line in lines)
    assert printed[1][1].startswith("shot 0  degree_of_parallelism 2, window 60 ms  ")


def test_the_table_has_the_points_in_the_order_in_which_they_were_chosen(
    printed: tuple[labseq.Run, list[str]], capfd: pytest.CaptureFixture[str]
) -> None:
    show_run(printed[0].path, as_json=False, tables=Tables(scan=ScanRequest()))
    header, first, *rest = capfd.readouterr().out.splitlines()
    assert header.split()[:3] == [DOP, "shot.2.rearrange.window", "shots"]
    assert first.split()[:4] == ["2", "60", "ms", "2"]
    assert len(rest) == 4
    show_run(printed[0].path, as_json=True)
    points = json.loads(capfd.readouterr().out)["points"]
    assert points[0]["parameters"] == {DOP: 2, "shot.2.rearrange.window": 0.06}
    assert sum(point["shots"] for point in points) == 10


def test_the_run_ends_with_the_best_point_and_a_suggested_one(
    printed: tuple[labseq.Run, list[str]], capfd: pytest.CaptureFixture[str]
) -> None:
    run = printed[0]
    (result,) = [event["values"] for event in run.events if event["event"] == "scan_result"]
    fillings = {p.written[DOP]: run.quantity("filling").over(p.shots).value for p in scan_points(run)}
    assert result["value"] == pytest.approx(max(fillings.values()))
    assert set(result["suggested"]) == set(result["best"]) == {DOP, "shot.2.rearrange.window"}
    show_run(run.path, as_json=False)
    shown = " ".join(capfd.readouterr().out.split())
    assert f"best point {DOP} {result['best'][DOP]}, " in shown
    assert f"suggested {DOP} {result['suggested'][DOP]}, " in shown


def test_a_view_in_another_process_learns_the_points_and_the_best(
    printed: tuple[labseq.Run, list[str]],
) -> None:
    watched = Follower(printed[0].path)
    tally, lines = Tally(watched.now), list[str]()
    for event in watched.events():
        tally.add(event.name, event.values)
        lines.append(event_text(event.name, event.values, tally.record))
    assert [line for line in lines if line.startswith("point ")] == [
        line for line in printed[1] if line.startswith("point ")
    ]
    assert tally.scan is not None
    points = tally.scan.points()
    assert [len(lines) for _, lines in points] == [2] * 5
    assert points[0][0] == "2, 60 ms"
    assert draw_scan(tally.scan, tally.measured, 48, 8, UNICODE)
    console = Console(file=io.StringIO(), width=110, height=40)
    with console.capture() as shown:
        console.print(Picture(tally, [], UNICODE))
    assert f"best so far       {tally.best}" in shown.get()
    assert ", point " in tally.best
