from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.data import MAX_ROWS
from labseq.recording.writer import RunWriter


@pytest.fixture
def run_dir(fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    writer = RunWriter.create(tmp_path / "data", fake.run(n_shots=2))
    for index in range(2):
        writer.write_shot(fake.shot(index))
    writer.finish("complete")
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    return writer.run_dir


def test_an_intact_run_takes_two_lines(run_dir: Path, call: Any) -> None:
    intact = (0, "1 run checked, 2 shots intact\nno damage found\n", "")
    assert call("doctor") == call("doctor", str(run_dir)) == intact


def test_a_dry_run_only_reports_and_the_next_repairs(run_dir: Path, call: Any) -> None:
    parts = [run_dir / "shots" / f"{number}.part" for number in range(MAX_ROWS + 5)]
    for part in parts:
        part.touch()
    code, out, _ = call("doctor", "--dry-run")
    lines = out.splitlines()
    assert code == 1
    assert lines[0].split() == ["what", "where", "to", "do"]
    where = parts[0].relative_to(run_dir.parents[1])
    assert lines[1].split("  ")[0] == "half-written"
    assert str(where) in out
    assert "and 5 more" in lines
    assert lines[-1] == f"{MAX_ROWS + 5} defects found; nothing was changed"
    assert all(part.exists() for part in parts)
    code, out, _ = call("doctor", str(run_dir))
    lines = out.splitlines()
    assert code == 0
    assert lines[0].split() == ["what", "where", "done"]
    assert lines[1].split("  ")[-1] == "moved to quarantine"
    assert lines[-1] == f"{MAX_ROWS + 5} defects found: {MAX_ROWS + 5} repaired, 0 left"


def test_what_is_left_makes_the_exit_code(run_dir: Path, call: Any) -> None:
    (run_dir / "run.json").write_bytes(b"")
    code, out, _ = call("doctor")
    assert code == 1
    assert "restore it from a backup" in out
    assert out.endswith("1 defect found: 0 repaired, 1 left\n")


def test_runs_in_progress_are_counted(run_dir: Path, fake: Any, call: Any) -> None:
    RunWriter.create(run_dir.parents[1], fake.run())
    code, out, _ = call("doctor")
    assert code == 0
    assert "1 run in progress not checked" in out


def test_findings_as_json(run_dir: Path, call: Any) -> None:
    (run_dir / "run.json.part").touch()
    code, out, _ = call("doctor", "--json")
    (found,) = json.loads(out)["findings"]
    assert code == 0
    assert found == {
        "what": "half-written",
        "where": str(run_dir / "run.json.part"),
        "done": "moved to quarantine",
        "left": False,
    }


def test_a_folder_that_does_not_exist_is_a_mistake(tmp_path: Path, call: Any) -> None:
    code, _, err = call("doctor", str(tmp_path / "no"))
    assert code == 2
    assert "no such file or folder, and no run of this name or number in" in err
