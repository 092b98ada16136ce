from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from labseq.errors import RecordingError
from labseq.recording import clear_active, find_dead_run, mark_active, marker_roots, runs_in_progress

MARK = """
import sys
from pathlib import Path
from labseq.recording import mark_active
mark_active([Path(sys.argv[1])], sys.argv[2], Path(sys.argv[3]))
"""


def mark_in_a_process_that_ends(root: Path, key: str, run_dir: Path) -> None:
    subprocess.run([sys.executable, "-c", MARK, root, key, run_dir], check=True)


def test_a_run_whose_process_is_gone_has_died(tmp_path: Path) -> None:
    key, run_dir = "/prüf/lab.yaml", tmp_path / "run µ"
    mark_in_a_process_that_ends(tmp_path, key, run_dir)
    assert find_dead_run([tmp_path], key) == run_dir
    assert find_dead_run([tmp_path], "/other/lab.yaml") is None
    mark_active([tmp_path], key, tmp_path / "next")
    assert find_dead_run([tmp_path], key) == run_dir  # until the hardware is safe
    clear_active([tmp_path], key)
    assert find_dead_run([tmp_path], key) is None


def test_clearing_leaves_what_belongs_to_others(tmp_path: Path) -> None:
    mark_active([tmp_path], "lab", tmp_path / "run")
    mark_active([tmp_path], "virtual", tmp_path / "run")
    living = next(path for path in (tmp_path / ".active").iterdir() if path.name.startswith("lab"))
    values = json.loads(living.read_text())
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        other = living.with_name(living.name.replace(f".{values['pid']}.", f".{child.pid}."))
        other.write_text(json.dumps({**values, "pid": child.pid, "started": 0.0}))
        clear_active([tmp_path], "lab")
        assert find_dead_run([tmp_path], "lab") is None
        assert sorted(path.name for path in (tmp_path / ".active").iterdir() if "lab" in path.name) == [
            other.name
        ]
    assert find_dead_run([tmp_path], "lab") == tmp_path / "run"
    assert len(list((tmp_path / ".active").glob("virtual*"))) == 1


@pytest.mark.parametrize("content", [b"", b'{"pid": true}'])
def test_a_damaged_marker_counts_as_a_run_that_died(tmp_path: Path, content: bytes) -> None:
    mark_active([tmp_path], "lab", tmp_path / "run")
    (marker,) = (tmp_path / ".active").iterdir()
    marker.write_bytes(content)
    assert find_dead_run([tmp_path], "lab") == marker
    clear_active([tmp_path], "lab")
    assert find_dead_run([tmp_path], "lab") is None


def test_a_run_that_died_is_found_from_another_data_root(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LABSEQ_STATE", str(tmp_path / "state"))
    first, second = marker_roots(tmp_path / "first"), marker_roots(tmp_path / "second")
    mark_active(first, "lab", tmp_path / "run")
    markers = [marker for root in first for marker in (root / ".active").iterdir()]
    assert len(markers) == 2
    assert find_dead_run(second, "lab") is None
    for marker in markers:
        marker.write_text(json.dumps({**json.loads(marker.read_text()), "host": "another"}))
    assert find_dead_run(second, "lab") == find_dead_run(first, "lab") == tmp_path / "run"
    clear_active(second, "lab")
    assert find_dead_run(second, "lab") is None
    assert find_dead_run(first, "lab") == tmp_path / "run"
    clear_active(first, "lab")
    assert find_dead_run(first, "lab") is None


def test_a_state_folder_that_cannot_be_used_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "state").write_text("a file, not a folder")
    monkeypatch.setenv("LABSEQ_STATE", str(tmp_path / "state"))
    roots = marker_roots(tmp_path / "data")
    mark_active(roots, "lab", tmp_path / "run")
    assert find_dead_run(roots, "lab") is None
    assert len(list((tmp_path / "data" / ".active").iterdir())) == 1
    clear_active(roots, "lab")
    assert list((tmp_path / "data" / ".active").iterdir()) == []


def test_the_folder_may_change_during_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LABSEQ_STATE", "state")
    monkeypatch.chdir(tmp_path)
    roots = marker_roots(Path("data"))
    assert roots == (tmp_path / "data", tmp_path / "state")


def test_a_marker_that_cannot_be_removed_keeps_no_other(tmp_path: Path) -> None:
    roots = [tmp_path / "data", tmp_path / "state"]
    mark_active(roots, "lab", tmp_path / "run")
    (marker,) = (roots[0] / ".active").iterdir()
    marker.unlink()
    marker.mkdir()
    with pytest.raises(RecordingError, match="data"):
        clear_active(roots, "lab")
    assert list((roots[1] / ".active").iterdir()) == []


def test_a_run_of_a_living_process_is_in_progress(tmp_path: Path) -> None:
    roots = marker_roots(tmp_path)
    assert runs_in_progress(roots) == {}
    mark_in_a_process_that_ends(tmp_path, "lab", tmp_path / "dead")
    assert runs_in_progress(roots) == {}
    mark_active(roots, "lab", tmp_path / "run")
    mark_active(roots, "virtual", tmp_path / "other")
    assert runs_in_progress(roots) == {tmp_path / "run": "lab", tmp_path / "other": "virtual"}
    for marker in (tmp_path / ".active").iterdir():
        marker.write_bytes(b"damaged")
    assert set(runs_in_progress(roots)) == {tmp_path / "run", tmp_path / "other"}  # of the user's own folder
