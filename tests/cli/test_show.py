from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.show import MAX_ROWS, newest_run, shot_table, show_run, summary_lines
from labseq.errors import ConfigError
from labseq.recording import RunWriter, open_run


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
        fake.shot(1, success=False, seen=0, filling=223 / 225, attempt=1),
        fake.shot(2, success=False, seen=0, filling=math.nan),
    ]
    folder = write_run(tmp_path, fake, shots)
    show_run(folder, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[1:4]] == [
        ["1", "defect-free", "in", "cycle", "2", "100.0", "%", "0", "0", "1.9", "s"],
        ["2", "2", "defects", "99.1", "%", "0", "0", "1.9", "s"],
        ["3", "not", "judged:", "no", "image", "-", "0", "0", "1.9", "s"],
    ]
    assert "shots             3 of 3, 1 attempt kept that did not complete" in lines
    assert "defect-free       1 of 2 (50.0 %), 21.6 to 78.4 %" in lines  # one was not judged
    assert "filling           99.6(4) %" in lines


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
    assert answer == {
        "run_dir": str(folder),
        "shots": 1,
        "skipped": 0,
        "defect_free": 1.0,
        "filling_fraction": 1.0,
        "status": "stopped",
    }


def test_a_run_without_shots(fake: Any, tmp_path: Path) -> None:
    run = open_run(write_run(tmp_path, fake, []))
    assert len(shot_table(run)) == 1
    lines = summary_lines(run)
    assert "defect-free       0 of 0" in lines
    assert "filling           -" in lines
    assert "duration          -" in lines


@pytest.mark.parametrize("n_shots", [MAX_ROWS, MAX_ROWS + 1])
def test_a_long_table_is_cut_in_the_middle(fake: Any, tmp_path: Path, n_shots: int) -> None:
    lines = shot_table(open_run(write_run(tmp_path, fake, [fake.shot(i) for i in range(n_shots)], n_shots)))
    assert (lines[1].split()[0], lines[-1].split()[0]) == ("1", str(n_shots))
    assert len(lines) == 1 + MAX_ROWS + ("..." in lines)
    assert ("..." in lines) is (n_shots > MAX_ROWS)


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
    assert json.loads(capsys.readouterr().out)["error"].startswith(f"error: {tmp_path} holds no runs")
    write_run(tmp_path, fake, [])
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    show_run(None, as_json=True)
    assert json.loads(capsys.readouterr().out)["run_dir"] == str(folder)


@pytest.mark.parametrize(
    ("status", "shown"), [("stopped", "stopped"), ("failed", "failed: DeviceError: camera: mute")]
)
def test_why_a_run_failed_is_told(fake: Any, tmp_path: Path, status: Any, shown: str) -> None:
    writer = RunWriter.create(tmp_path, fake.run())
    writer.finish(status, "DeviceError: camera: mute")
    assert f"status            {shown}" in summary_lines(open_run(writer.run_dir))


def test_damaged_lines_are_told(fake: Any, tmp_path: Path) -> None:
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    index = folder / "index.jsonl"
    index.write_text("{}\n" + index.read_text("utf-8"), "utf-8")
    assert "warning           1 line of the index cannot be read" in summary_lines(open_run(folder))


@pytest.mark.parametrize("value", [None, "x", [], {"step 0 load": "x"}])
def test_stage_times_that_are_none_are_left_out(fake: Any, tmp_path: Path, value: object) -> None:
    folder = write_run(tmp_path, fake, [fake.shot(0)])
    index = folder / "index.jsonl"
    row = {**json.loads(index.read_text("utf-8")), "stage_s": value, "t_end_utc": "2026-11-21T12:00:00"}
    index.write_text(json.dumps(row) + "\n", "utf-8")
    run = open_run(folder)
    assert shot_table(run)[1].endswith("-")
    assert "duration          -" in summary_lines(run)
