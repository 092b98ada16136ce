from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.errors import RecordingError
from labseq.recording.folders import find_run, make_run_folder, slug

NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)

MAKE = """
import sys
from datetime import datetime
from pathlib import Path
from labseq.recording.folders import make_run_folder
noon = datetime.fromisoformat("2026-11-20T12:00:00+00:00")
input()
for i in range(10):
    print(make_run_folder(Path(sys.argv[1]), sys.argv[2], noon))
"""


def test_counters_go_on_whatever_the_name(tmp_path: Path) -> None:
    made = [make_run_folder(tmp_path, name, NOON).name for name in ("a", "b", "größe 2/3", "")]
    assert made == ["0001_a", "0002_b", "0003_größe_2_3", "0004_run"]
    day = NOON.astimezone().date().isoformat()
    assert {path.name for path in tmp_path.iterdir()} == {day}


def test_a_claim_left_by_a_killed_process_is_stepped_over(tmp_path: Path) -> None:
    day = make_run_folder(tmp_path, "a", NOON).parent
    (day / ".0002.claim").mkdir()
    assert make_run_folder(tmp_path, "b", NOON).name == "0003_b"


def test_processes_never_share_a_counter(tmp_path: Path) -> None:
    children = [
        subprocess.Popen(
            [sys.executable, "-c", MAKE, tmp_path, f"run{i}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for i in range(3)
    ]
    for child in children:  # all are imported and waiting before the first one starts
        assert child.stdin is not None
        child.stdin.write("\n")
        child.stdin.flush()
    made = [line for child in children for line in child.communicate()[0].split()]
    assert len(made) == 30
    assert len({Path(path).name[:4] for path in made}) == 30
    assert not list(tmp_path.glob("*/.*"))


@given(st.text())
def test_every_slug_is_a_plain_file_name(name: str) -> None:
    made = slug(name)
    assert made == Path(made).name
    assert made[0] not in ".-"
    assert len(made) <= 60
    assert not set(made) & set('<>:"/\\|?*\0 ')


def make_finished(tmp_path: Path, name: str) -> Path:
    run = make_run_folder(tmp_path, name, NOON)
    (run / "run.json").write_text("{}")
    (run / "shots").mkdir()
    (run / "shots" / "shot_000000.h5").touch()
    return run


def test_any_path_in_a_run_finds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make_finished(tmp_path, "a")
    for path in (run, run / "run.json", run / "shots", run / "shots" / "shot_000000.h5"):
        assert find_run(path) == run
    monkeypatch.chdir(run / "shots")
    assert find_run(Path()) == run


def test_a_folder_of_runs_names_its_latest(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no run\.json"):
        find_run(tmp_path)
    make_finished(tmp_path, "a")
    with pytest.raises(RecordingError, match=r"contains 1 run but is not a run itself; .*0001_a"):
        find_run(tmp_path)
    latest = make_finished(tmp_path, "b")
    for folder in (tmp_path, latest.parent):
        with pytest.raises(RecordingError, match=r"contains 2 runs but is not a run itself; .*0002_b"):
            find_run(folder)


def test_a_run_that_died_at_birth_is_explained(tmp_path: Path) -> None:
    run = make_run_folder(tmp_path, "a", NOON)
    (run / "STATE").write_text("{}")
    with pytest.raises(RecordingError, match="died while its folder was created"):
        find_run(run / "STATE")


def test_a_run_that_lost_its_run_file_is_not_to_be_deleted(tmp_path: Path) -> None:
    run = make_finished(tmp_path, "a")
    (run / "STATE").write_text("{}")
    (run / "run.json").unlink()
    for path in (run, run / "shots" / "shot_000000.h5"):
        with pytest.raises(RecordingError, match=r"run\.json is gone; restore"):
            find_run(path)
