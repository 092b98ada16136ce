from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main
from labseq.cli.data import MAX_ROWS
from labseq.recording import RunWriter


@pytest.fixture
def run_dir(fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    writer = RunWriter.create(tmp_path / "data", fake.run(n_shots=2))
    for index in range(2):
        writer.write_shot(fake.shot(index))
    writer.finish("complete")
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    return writer.run_dir


def called(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["doctor", *arguments])
    return int(str(ended.value.code or 0))


def test_an_intact_run_takes_two_lines(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called() == called(str(run_dir)) == 0
    assert capsys.readouterr().out == "1 run checked, 2 shots intact\nno damage found\n" * 2


def test_a_dry_run_only_reports(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = run_dir / "shots" / "shot_000002.h5.part"
    part.touch()
    assert called("--dry-run") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["what", "where", "to", "do"]
    where = part.relative_to(run_dir.parents[1])
    assert lines[1].split("  ") == ["half-written", str(where), "moved to quarantine"]
    assert lines[-1] == "1 defect found; nothing was changed"
    assert part.exists()


def test_what_is_repaired_is_reported(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "shots" / "shot_000002.h5.part").touch()
    (run_dir / "run.json.part").touch()
    assert called(str(run_dir)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["what", "where", "done"]
    assert lines[1].split("  ")[-1] == "moved to quarantine"
    assert lines[-1] == "2 defects found: 2 repaired, 0 left"


def test_what_is_left_makes_the_exit_code(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "run.json").write_bytes(b"")
    assert called() == 1
    out = capsys.readouterr().out
    assert "take it from a backup" in out
    assert out.endswith("1 defect found: 0 repaired, 1 left\n")


def test_runs_in_progress_are_reported(run_dir: Path, fake: Any, capsys: pytest.CaptureFixture[str]) -> None:
    RunWriter.create(run_dir.parents[1], fake.run())
    assert called() == 0
    assert "1 run in progress not checked" in capsys.readouterr().out


def test_findings_are_reported_as_json(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "run.json.part").touch()
    assert called("--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["findings"]
    assert found == {
        "what": "half-written",
        "where": str(run_dir / "run.json.part"),
        "done": "moved to quarantine",
        "left": False,
    }


def test_of_very_many_findings_the_first_are_reported(
    run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(MAX_ROWS + 5):
        (run_dir / "shots" / f"{number}.part").touch()
    assert called("--dry-run") == 1
    assert "and 5 more" in capsys.readouterr().out.splitlines()


def test_a_folder_that_is_not_there_is_a_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(str(tmp_path / "no")) == 2
    assert "no: there is no such folder; give a data folder" in capsys.readouterr().err
