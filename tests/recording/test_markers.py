from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from labseq.errors import RecordingError
from labseq.files import devices_root
from labseq.recording import clear_active, find_dead_run, mark_active, markers, runs_in_progress

MARK = """
import sys
from pathlib import Path
from labseq.recording import mark_active
mark_active(sys.argv[1], sys.argv[2].split(), Path(sys.argv[3]))
"""


def mark_in_a_process_that_ends(profile: str, hardware: str, run_dir: Path) -> None:
    subprocess.run([sys.executable, "-c", MARK, profile, hardware, run_dir], check=True)


def test_a_run_whose_process_is_gone_has_died_for_its_profile_and_for_its_hardware(tmp_path: Path) -> None:
    key, run_dir = "/prüf/lab.yaml", tmp_path / "run µ"
    mark_in_a_process_that_ends(key, "card radio", run_dir)
    assert find_dead_run(key, []) == run_dir
    assert find_dead_run("/copy/lab.yaml", ["box", "card"]) == run_dir
    assert find_dead_run("/other/lab.yaml", ["box"]) is None
    mark_active(key, ["card"], tmp_path / "next")
    assert find_dead_run(key, []) == run_dir  # until the hardware is safe
    clear_active("/copy/lab.yaml", ["card"])
    assert find_dead_run("/copy/lab.yaml", ["card"]) is None
    assert find_dead_run("/copy/lab.yaml", ["radio"]) == run_dir  # which may still be on
    clear_active("/copy/lab.yaml", ["radio"])
    assert find_dead_run(key, ["card", "radio"]) is None


def test_a_marker_is_on_the_disk_before_the_run_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(markers, "sync_folder", synced.append)
    mark_active("lab", [], tmp_path / "run")
    assert synced == [devices_root()]


def test_clearing_leaves_what_belongs_to_others(tmp_path: Path) -> None:
    mark_active("lab", [], tmp_path / "run")
    mark_active("virtual", [], tmp_path / "run")
    living = next(path for path in devices_root().iterdir() if path.name.startswith("lab"))
    values = json.loads(living.read_text())
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        other = living.with_name(living.name.replace(f".{values['pid']}.", f".{child.pid}."))
        other.write_text(json.dumps({**values, "pid": child.pid, "started": 0.0}))
        clear_active("lab", [])
        assert find_dead_run("lab", []) is None
        assert [path.name for path in devices_root().iterdir() if "lab" in path.name] == [other.name]
    assert find_dead_run("lab", []) == tmp_path / "run"
    assert len(list(devices_root().glob("virtual*"))) == 1


def test_a_marker_of_an_earlier_start_of_the_computer_has_died(tmp_path: Path) -> None:
    mark_active("lab", [], tmp_path / "run")
    (marker,) = devices_root().iterdir()
    marker.write_text(json.dumps({**json.loads(marker.read_text()), "boot": "another"}))
    assert find_dead_run("lab", []) == tmp_path / "run"


@pytest.mark.parametrize("content", [b"", b'{"pid": true}'])
def test_a_damaged_marker_counts_as_a_run_that_died(tmp_path: Path, content: bytes) -> None:
    mark_active("lab", [], tmp_path / "run")
    (marker,) = devices_root().iterdir()
    marker.write_bytes(content)
    assert find_dead_run("another", ["card"]) == marker
    clear_active("another", ["card"])
    assert find_dead_run("lab", []) is None


def test_another_users_marker_is_cleared_though_it_cannot_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark_in_a_process_that_ends("lab", "card", tmp_path / "run")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setattr(Path, "replace", refuse)  # by the folder's sticky bit
    clear_active("other", ["card"])
    assert find_dead_run("lab", ["card"]) is None


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such permissions")
def test_every_user_may_use_the_folder(tmp_path: Path) -> None:
    mark_active("lab", [], tmp_path / "run")
    (marker,) = devices_root().iterdir()
    assert devices_root().stat().st_mode & 0o7777 == 0o1777
    assert marker.stat().st_mode & 0o777 == 0o666


def test_a_marker_that_cannot_be_removed_keeps_no_other(tmp_path: Path) -> None:
    mark_active("lab", ["card"], tmp_path / "run")
    (devices_root() / "a.json").mkdir()
    with pytest.raises(RecordingError, match=r"a\.json"):
        clear_active("lab", ["card"])
    assert [path.name for path in devices_root().iterdir()] == ["a.json"]


def test_a_run_of_a_living_process_is_in_progress(tmp_path: Path) -> None:
    assert runs_in_progress() == {}
    mark_in_a_process_that_ends("lab", "card", tmp_path / "dead")
    assert runs_in_progress() == {}
    mark_active("lab", [], tmp_path / "run")
    mark_active("virtual", [], tmp_path / "other")
    assert runs_in_progress() == {tmp_path / "run": "lab", tmp_path / "other": "virtual"}
