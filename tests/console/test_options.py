"""What the shell offers at the tab key."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from labseq.cli import main
from labseq.console.options import MAX_RUNS, profile_names, run_folders


def completed(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The completions that bash gets for a line whose last word is not finished."""
    monkeypatch.setenv("_LABSEQ_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    capsys.readouterr()
    with pytest.raises(SystemExit) as leaving:
        main([])
    assert leaving.value.code == 0
    return capsys.readouterr().out.split()


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LABSEQ_DATA", raising=False)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("labseq ne", ["new"]),
        ("labseq calibration l", ["list"]),
        ("labseq new det", ["detector"]),
        ("labseq schema p", ["profile"]),
        ("labseq run a.yaml --profile vir", ["virtual"]),
        ("labseq safe prac", ["practice"]),
        ("labseq plugins --profile prac", ["practice"]),
        ("labseq run a.yaml --shot", ["--shots"]),
        ("labseq nonsense x", []),
    ],
)
def test_words_are_completed(
    line: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert completed(line, monkeypatch, capsys) == offered


def test_runs_are_completed(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for day in range(1, 4):
        run = here / "data" / f"2026-11-0{day}" / "0001_x"
        run.mkdir(parents=True)
        (run / "run.json").touch()
    offered = [str(Path("data") / f"2026-11-0{day}" / "0001_x") for day in (3, 2, 1)]
    assert run_folders("") == offered
    for command in ("show", "resume", "stop"):
        assert sorted(completed(f"labseq {command} data", monkeypatch, capsys)) == sorted(offered)


def test_not_too_many_runs_are_offered(here: Path) -> None:
    for number in range(MAX_RUNS + 5):
        run = here / "data" / "2026-11-01" / f"{number:04}_x"
        run.mkdir(parents=True)
        (run / "run.json").touch()
    assert len(run_folders("")) == MAX_RUNS
    assert run_folders("")[0].endswith("0024_x")


def test_runs_where_none_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_folders("") == []
    monkeypatch.setenv("LABSEQ_DATA", os.devnull)
    assert run_folders("") == []


def test_own_profiles_are_offered_too(here: Path) -> None:
    (here / "hardware_profiles").mkdir()
    (here / "hardware_profiles" / "our_lab.yaml").touch()
    (here / "hardware_profiles" / "notes.txt").touch()
    assert profile_names("our") == ["our_lab"]
    assert {"our_lab", "virtual"} <= {*profile_names("")}
    assert "notes" not in profile_names("")


@pytest.mark.parametrize("shell", ["bash", "zsh", "pwsh"])
def test_every_shell_gets_its_script(
    shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_LABSEQ_COMPLETE", f"source_{shell}")
    with pytest.raises(SystemExit) as leaving:
        main([])
    assert leaving.value.code == 0
    assert "_LABSEQ_COMPLETE" in capsys.readouterr().out


def test_completion_imports_nothing_heavy(here: Path) -> None:
    environment = {
        **os.environ,
        "_LABSEQ_COMPLETE": "complete_bash",
        "COMP_WORDS": "labseq run --profile v",
        "COMP_CWORD": "3",
    }
    command = [sys.executable, "-X", "importtime", "-m", "labseq"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd=here)
    assert done.stdout.split() == ["virtual"]
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert imported.isdisjoint({"numpy", "yaml", "h5py", "numba", "pluggy"})  # pydantic is typer's own
