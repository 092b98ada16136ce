"""What `labseq show` prints."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from labseq.analysis.scanned import ScanRequest
from labseq.cli.show import Tables, show_run
from labseq.cli.summary import MAX_ROWS, Summary
from labseq.console.report import aligned
from labseq.data.reader import open_run
from labseq.errors import ConfigError
from labseq.model import StageTiming
from labseq.recording.listing import newest_run
from labseq.recording.writer import RunWriter

NO_TERMINAL = pytest.mark.usefixtures("capsys")
"""Tables are as wide as the terminal."""


def write_run(root: Path, fake: Any, shots: Any, n_shots: int = 3) -> Path:
    writer = RunWriter.create(root, fake.run(n_shots=n_shots))
    for shot in shots:
        writer.write_shot(shot)
    writer.finish("complete" if len(shots) == n_shots else "stopped")
    return writer.run_dir


def test_table_and_summary(fake: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shots = [
        fake.shot(0),
        fake.shot(1, status="failed", error="TransientError: no light"),
        fake.shot(1, success=False, seen=-1, filling=223 / 225, attempt=1),
        fake.shot(2, success=False, seen=-1, filling=math.nan),
    ]
    folder = write_run(tmp_path, fake, shots)
    show_run(folder, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert [" ".join(line.split()) for line in lines[1:4]] == [
        "0 defect-free after 2 cycles 100.0 % 1.9 s",
        "1 2 defects 99.1 % 1.9 s",
        "2 not judged: no image - 1.9 s",
    ]
    assert "shots             3 of 3, 1 attempt kept that did not complete" in lines
    assert "defect-free       1 of 2 (50.0 %), 21.6 to 78.4 %" in lines  # one was not judged
    assert "filling           99.6(4) %" in lines
    folder = write_run(tmp_path / "c d", fake, shots[:1])
    summary = Summary.of(open_run(folder))
    assert summary.as_text()[-1] == f'resume it with: labseq resume "{folder}"'
    failed = replace(summary, status="failed", shots=0)
    assert failed.as_text()[-1] == "correct the cause, then run the sequence again"


def test_json(fake: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    show_run(folder, as_json=True)
    answer = json.loads(capsys.readouterr().out)
    statistics = answer.pop("statistics")
    assert statistics["defect_free"] == {
        "n": 1,
        "n_trials": 1,
        "rate": 1.0,
        "interval": [pytest.approx(0.462, abs=1e-3), 1.0],
    }
    assert statistics["filling"] == {"mean": 1.0, "error": None}
    expected = {
        "run_dir": str(folder),
        "shots": 1,
        "skipped": 0,
        "defect_free": 1.0,
        "filling_fraction": 1.0,
        "status": "stopped",
    }
    assert answer.items() >= expected.items()


@pytest.mark.parametrize("n_rows", [MAX_ROWS, MAX_ROWS + 1])
def test_a_long_table_is_cut_in_the_middle(n_rows: int) -> None:
    lines = aligned([["shot"], *([str(i)] for i in range(n_rows))], most=MAX_ROWS)
    assert (lines[1], lines[-1]) == ("0", str(n_rows - 1))
    assert len(lines) == 1 + MAX_ROWS + ("..." in lines)
    assert ("..." in lines) is (n_rows > MAX_ROWS)


def test_the_newest_run_has_the_newest_day_and_the_highest_counter(tmp_path: Path) -> None:
    for name in (
        "2026-01-02/0009_a",
        "2026-01-03/0002_b",
        "2026-01-03/9999_a",
        "2026-01-03/10000_a",
        "2025-12-31/0100_z",
    ):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "run.json").touch()
    (tmp_path / "2026-01-03" / "10001_dead").mkdir()
    assert newest_run(tmp_path) == tmp_path / "2026-01-03" / "10000_a"


def test_show_finds_the_newest_run_itself(
    fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path))
    with pytest.raises(ConfigError, match="holds no runs"):
        show_run(None, as_json=True)
    assert json.loads(capsys.readouterr().out)["error"].startswith(f"{tmp_path}: holds no runs")
    write_run(tmp_path, fake, [])
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    show_run(None, as_json=True)
    assert json.loads(capsys.readouterr().out)["run_dir"] == str(folder)


@NO_TERMINAL
def test_why_a_run_failed_is_reported(fake: Any, tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, fake.run())
    writer.finish("failed", "DeviceError: camera: mute")
    assert (
        "status            failed: DeviceError: camera: mute"
        in Summary.of(open_run(writer.run_dir)).as_text()
    )


@NO_TERMINAL
def test_damaged_lines_are_reported(fake: Any, tmp_path: Path) -> None:
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    index = folder / "index.jsonl"
    index.write_text("{}\n" + index.read_text("utf-8"), "utf-8")
    assert "warning           1 line of the index cannot be read" in Summary.of(open_run(folder)).as_text()


SKIPPED_SCAN = {
    "addresses": ["planner.degree_of_parallelism"],
    "points": [[1], [4]],
    "written": [["1"], ["4"]],
    "repeats": 4,
    "order": "sequential",
    "point_of_shot": [0, 0, 0, 0, 1, 1, 1, 1],
}


@pytest.fixture
def skipped(fake: Any, tmp_path: Path) -> Path:
    """A run of eight shots that were all skipped, for two reasons."""
    writer = RunWriter.create(tmp_path, replace(fake.run(n_shots=8), scan=SKIPPED_SCAN))
    writer.skip([0, 1, 2, 3, 4, 5], "DeviceError: laser: went out of lock")
    writer.skip([6], "filling\nfraction")
    writer.skip([7], "filling\nfraction")
    writer.finish("complete")
    return writer.run_dir


def test_what_was_skipped_is_reported_with_the_reasons(
    skipped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show_run(skipped, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert "shots             0 of 8, 8 skipped" in lines
    assert "skipped           shots 0, 1, 2, 3, 4, ...: DeviceError: laser: went out of lock" in lines
    assert "skipped           shots 6, 7: filling fraction" in lines
    show_run(skipped, as_json=True)
    assert json.loads(capsys.readouterr().out)["skipped_shots"] == [
        {"shots": [0, 1, 2, 3, 4, 5], "why": "DeviceError: laser: went out of lock"},
        {"shots": [6, 7], "why": "filling\nfraction"},
    ]


def test_a_scan_whose_points_were_all_skipped_is_no_error(
    skipped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show_run(skipped, as_json=False, tables=Tables(scan=ScanRequest()))
    assert "all 8 shots were skipped" in capsys.readouterr().out
    show_run(skipped, as_json=True, tables=Tables(scan=ScanRequest()))
    assert json.loads(capsys.readouterr().out)["points"] == []


SCAN: dict[str, Any] = {
    "addresses": ["shot.2.rearrange.window"],
    "points": [[0.06], [0.1]],
    "written": [["60 ms"], ["100 ms"]],
    "point_of_shot": [0, 1, 1],
}


@pytest.fixture
def folder(tmp_path: Path, fake: Any) -> Path:
    devices = {"camera": {"model": "EMCCD", "em_gain": 300.0, "text": "a\x1bb"}, "laser": {}}
    run = replace(fake.run(n_shots=3), devices=devices, scan=SCAN)
    writer = RunWriter.create(tmp_path, run)
    for shot in (
        fake.shot(0),
        fake.shot(1, status="failed", error="TransientError: no light"),
        fake.shot(1, success=False, seen=-1, filling=223 / 225, attempt=1),
    ):
        shot.timing.insert(0, StageTiming("play", 0, 1, 0.0, 0.02, 0.001, 0.01))
        writer.write_shot(shot)
    writer.finish("stopped")
    return writer.run_dir


def shown(folder: Path, capsys: pytest.CaptureFixture[str], **tables: Any) -> list[str]:
    show_run(folder, as_json=False, tables=Tables(**tables))
    return capsys.readouterr().out.splitlines()


def as_json(folder: Path, capsys: pytest.CaptureFixture[str], **tables: Any) -> dict[str, Any]:
    show_run(folder, as_json=True, tables=Tables(**tables))
    return json.loads(capsys.readouterr().out)


def test_every_shot_and_every_attempt_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(folder, capsys, shots=True)
    assert lines[0].split()[:2] == ["shot", "shot.2.rearrange.window"]
    assert [" ".join(line.split()) for line in lines[1:]] == [
        "0 60 ms defect-free after 2 cycles 100.0 % 1.9 s",
        "1 100 ms attempt 0 failed: TransientError: no light 100.0 % 1.9 s",
        "1 100 ms 2 defects 99.1 % 1.9 s",
    ]


def test_each_stage_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [" ".join(line.split()) for line in shown(folder, capsys, timing=True)]
    assert lines[0] == "stage a shot budget modelled p50 p99 host p50 p99 share over budget"
    assert lines[1] == "play 1 10 ms 20 ms 20 ms 1 ms 1 ms 1.1 % 2 of 2"
    assert lines[-1] == "shot: 1.9 s (p50), 1.9 s (p99), of 2 of 2 shots"


def test_each_point_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(folder, capsys, scan=ScanRequest())
    assert [line.split()[:3] for line in lines[1:]] == [["60", "ms", "1"], ["100", "ms", "1"]]


def test_devices_tell_of_themselves(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(folder, capsys, devices=True) == [
        "camera: EMCCD",
        "  em_gain 300.0, text a\\x1bb",
        "laser: model unknown",
    ]


def test_json_holds_the_same(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = as_json(folder, capsys, shots=True, timing=True, scan=ScanRequest(), devices=True)
    assert (answer["run_dir"], answer["status"]) == (str(folder), "stopped")
    assert [(shot["index"], shot["status"]) for shot in answer["shot_list"]] == [
        (0, "complete"),
        (1, "failed"),
        (1, "complete"),
    ]
    (play, *_) = answer["timing"]["stages"]
    assert (play["stage"], play["n_over"], play["session_s"]) == ("play", 2, {"p50": 0.02, "p99": 0.02})
    assert [point["parameters"] for point in answer["points"]] == [
        {"shot.2.rearrange.window": 0.06},
        {"shot.2.rearrange.window": 0.1},
    ]
    assert answer["devices"]["camera"]["em_gain"] == 300.0


@pytest.mark.parametrize(
    ("table", "printed", "json_wanted"),
    [
        (Tables(scan=ScanRequest()), "the run has no shots yet", True),
        (Tables(timing=True), "no readable file of a shot yet", False),
    ],
)
def test_a_table_without_data_is_reported(
    tmp_path: Path,
    fake: Any,
    capsys: pytest.CaptureFixture[str],
    table: Tables,
    printed: str,
    json_wanted: bool,
) -> None:
    run_dir = RunWriter.create(tmp_path, fake.run()).run_dir
    with pytest.raises(ConfigError, match=printed):
        show_run(run_dir, as_json=json_wanted, tables=table)
    out = capsys.readouterr().out
    assert not json_wanted or printed in json.loads(out)["error"]
