"""``labseq stop`` from Python: which run is meant, and how it ends."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError, RecordingError, StopRequested
from labseq.files import write_file
from labseq.recording import mark_active
from labseq.recording.run_file import encode_state
from labseq.session.stopping import ask_to_stop, find_running, is_running, owner_text
from labseq.testing.fakes import RecordingObserver

from .small_runs import interrupted, write


class Asking(RecordingObserver):
    """Does something once, at an event of the run."""

    def __init__(self, name: str, act: Any) -> None:
        super().__init__()
        self._name, self._act = name, act

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        super().event(name, values)
        if name == self._name and self._act is not None:
            act, self._act = self._act, None
            act()


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


def run(sequence: Path, event: str, act: Any) -> tuple[Path, RecordingObserver]:
    observer = Asking(event, act)
    with labseq.Session.open(sequence, seed=1, observer=observer) as session:
        with pytest.raises(StopRequested) as caught:
            session.run()
        assert caught.value.after_shot
        assert session.run_dir is not None
        return session.run_dir, observer


@pytest.mark.parametrize(("event", "n_shots"), [("run_started", 0), ("image", 1)])
def test_the_shot_in_progress_is_taken_to_its_end(data: Path, event: str, n_shots: int) -> None:
    run_dir, observer = run(write(data.parent), event, lambda: ask_to_stop(find_running()))
    found = labseq.open_run(run_dir)
    assert (found.status, found.error) == ("stopped", "stopped by 'labseq stop'")
    assert (len(found.shots), len(found.attempts)) == (n_shots, 0)
    assert all(values["ok"] for values in observer.of("safe_state"))
    assert not (run_dir / "STOP").exists()


def test_a_run_is_found_by_folder_profile_or_as_the_only_one(data: Path) -> None:
    found: list[Any] = []

    def look() -> None:
        (folder,) = (state.parent for state in data.glob("*/*/STATE"))
        found.extend([folder, find_running(), find_running(folder / "run.json"), owner_text(folder)])
        found.append(find_running(profile="./p.yaml"))
        with pytest.raises(ConfigError, match="no run is in progress on the profile virtual"):
            find_running(profile="virtual")
        ask_to_stop(folder)

    run_dir, _ = run(write(data.parent), "shot_started", look)
    assert found[:3] == [run_dir] * 3
    assert found[3].startswith("process ")
    assert found[4] == run_dir
    assert not is_running(run_dir)
    with pytest.raises(ConfigError, match="the run is not in progress"):
        find_running(run_dir)


def test_of_several_runs_one_must_be_named(data: Path) -> None:
    runs = [interrupted(write(data.parent), "shot_started", 1) for _ in range(2)]
    for run_dir in runs:
        write_file(run_dir / "STATE", encode_state("running"))
        mark_active(f"profile of {run_dir}", [], run_dir)
    with pytest.raises(ConfigError, match=r"2 runs are in progress; expected one of .*, "):
        find_running()
    assert find_running(runs[1]) == runs[1]


def test_without_a_run_there_is_nothing_to_stop(data: Path) -> None:
    with pytest.raises(ConfigError, match=r"^no run is in progress$"):
        find_running()
    interrupted(write(data.parent), "shot_started", 1)
    with pytest.raises(ConfigError, match=r"^no run is in progress$"):
        find_running()
    with pytest.raises(RecordingError, match="no such file"):
        find_running(data / "nowhere")
