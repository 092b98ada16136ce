"""What is in use, and what only the user can mend, is left as it is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest

from labseq.recording import mark_active
from labseq.recording.doctor import Report, examine

from .damages import (
    N_SHOTS,
    MakeRun,
    MakeShot,
    copied,
    dead_run,
    empty_file,
    lost_line,
    part_left,
    rewrite_state,
    told,
    torn_events,
    write_whole_run,
)

LONG_AGO = 1e9


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory, make_run: MakeRun, make_shot: MakeShot) -> Path:
    return write_whole_run(tmp_path_factory.mktemp("made"), make_run, make_shot)


@pytest.fixture
def run_dir(template: Path, tmp_path: Path) -> Path:
    return copied(template, tmp_path / "data")


def test_a_run_without_shots_or_run_file_goes_to_the_quarantine_of_its_day(run_dir: Path) -> None:
    dead = run_dir.parent / "0002_dead"
    (dead / "shots").mkdir(parents=True)
    shutil.copy(run_dir / "STATE", dead)
    rewrite_state(dead, state="running", pid=2**22 + 1, started=0.0)
    root = run_dir.parents[1]
    report = examine(root)
    assert report.in_progress == [dead]  # it may just be being made
    os.utime(dead, (LONG_AGO, LONG_AGO))
    assert told(examine(root)) == [("the run died while its folder was made; it holds no shots", "0002_dead")]
    assert (run_dir.parent / "quarantine" / "0002_dead" / "STATE").exists()
    assert examine(root).findings == []


def test_shots_without_a_run_file_are_left(run_dir: Path) -> None:
    (run_dir / "run.json").unlink()
    os.utime(run_dir, (LONG_AGO, LONG_AGO))
    (found,) = examine(run_dir).findings
    assert (found.what, found.left) == ("run.json is missing", True)
    assert "take it from a backup" in found.done
    assert len(list((run_dir / "shots").iterdir())) == N_SHOTS + 1


@pytest.mark.parametrize("content", [b"", b'{"format": "labseq-run", "format_version": "2.0"}'])
def test_a_run_file_that_cannot_be_read_is_left(run_dir: Path, content: bytes) -> None:
    (run_dir / "run.json").write_bytes(content)
    part_left(run_dir)
    assert [one.left for one in examine(run_dir).findings] == [True]
    assert (run_dir / "run.json").read_bytes() == content


def test_a_shot_of_a_newer_labseq_is_left(run_dir: Path) -> None:
    lost_line(run_dir)
    with h5py.File(run_dir / "shots" / "shot_000001.h5", "r+") as file:
        file.attrs["format_version"] = "3.0"
    (found,) = examine(run_dir).findings
    assert found.left
    assert "update labseq" in found.done


def test_a_run_in_progress_is_not_touched(run_dir: Path) -> None:
    root = run_dir.parents[1]
    for plant in (lost_line, part_left, torn_events, empty_file):
        plant(run_dir)
    rewrite_state(run_dir, state="running", pid=os.getpid(), started=0.0)
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    report = examine(root)
    assert (report.findings, report.in_progress) == ([], [run_dir])
    rewrite_state(run_dir, state="running", pid=2**22 + 1, host="another")  # nobody here can tell
    assert examine(run_dir).in_progress == [run_dir]
    rewrite_state(run_dir, state="complete")
    before[run_dir / "STATE"] = (run_dir / "STATE").read_bytes()
    mark_active([root], "lab", run_dir)  # its devices are not safe yet
    before |= {path: path.read_bytes() for path in (root / ".active").iterdir()}
    assert examine(root).in_progress == [run_dir]
    assert examine(run_dir).in_progress == [run_dir]
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


LOCK = """
import sys
from pathlib import Path
from labseq.files import Lock
lock = Lock(Path(sys.argv[1]), "labseq resume")
assert lock.take() is None
print("taken", flush=True)
input()
"""


def test_a_run_that_somebody_goes_on_with_is_not_touched(run_dir: Path) -> None:
    lost_line(run_dir)
    command = [sys.executable, "-c", LOCK, run_dir / ".lock"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert examine(run_dir).in_progress == [run_dir]
    found = told(examine(run_dir))  # it was killed, or so its note says
    assert found[-1] == ("no line in the index", "shot_000001.h5")


def test_marks_of_runs_that_left_hardware_unsafe_stay(run_dir: Path) -> None:
    root = run_dir.parents[1]
    code = "import sys; from pathlib import Path; from labseq.recording import mark_active as m; "
    code += "m([Path(sys.argv[1])], 'lab', Path(sys.argv[2]))"
    subprocess.run([sys.executable, "-c", code, root, run_dir], check=True)
    (found,) = examine(root).findings
    assert (found.what, found.left) == ("a run died here without making its hardware safe", True)
    assert "'labseq safe lab'" in found.done
    assert found.where.exists()


def test_claims_and_half_written_marks_are_moved_away(run_dir: Path) -> None:
    root = run_dir.parents[1]
    claim, part = run_dir.parent / ".0007.claim", root / ".active" / "lab.json.part"
    claim.mkdir()
    part.parent.mkdir()
    part.touch()
    assert examine(root).findings == []  # somebody may be at it
    for path in (claim, part):
        os.utime(path, (LONG_AGO, LONG_AGO))
    assert [name for _, name in told(examine(root))] == [".0007.claim", "lab.json.part"]
    assert examine(root).findings == []


def test_what_cannot_be_read_is_left(run_dir: Path) -> None:
    path = run_dir / "shots" / "shot_000001.h5"
    path.unlink()
    path.mkdir()  # reading it fails for every user
    part_left(run_dir)
    found = {one.where.name: one.left for one in examine(run_dir).findings}
    assert found == {"shot_000001.h5": True, "shot_000009.h5.part": False, "STATE.part": False}


def test_a_day_that_cannot_be_looked_into_hides_no_other(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part_left(run_dir)
    closed = run_dir.parents[1] / "2026-01-01"
    closed.mkdir()
    listed = Path.iterdir

    def forbidden(self: Path) -> Iterator[Path]:
        if self == closed:
            raise PermissionError(13, "Permission denied")
        return listed(self)

    monkeypatch.setattr(Path, "iterdir", forbidden)
    found = [(one.what, one.where.name, one.left) for one in examine(run_dir.parents[1]).findings]
    assert found == [
        ("cannot be read: Permission denied", "2026-01-01", True),
        ("half-written", "STATE.part", False),
        ("half-written", "shot_000009.h5.part", False),
    ]


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="nothing is forbidden to this user")
def test_what_may_not_be_read_or_written_is_left(run_dir: Path) -> None:
    (run_dir / "shots" / "shot_000001.h5").chmod(0)
    lost_line(run_dir)
    run_dir.chmod(0o500)
    try:
        findings = examine(run_dir).findings
    finally:
        run_dir.chmod(0o700)
    assert findings
    assert all(one.left for one in findings)


def test_a_disk_that_takes_nothing_leaves_all_as_it_was(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    lost_line(run_dir)
    dead_run(run_dir)
    before = {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file()}
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        report = examine(run_dir)
    assert all(one.left and "the disk is full" in one.done for one in report.findings)
    assert {p: p.read_bytes() for p in run_dir.rglob("*") if p.is_file() and p.name != ".lock"} == before


def test_a_folder_without_runs_is_well(tmp_path: Path) -> None:
    (tmp_path / "pictures" / "of a cat").mkdir(parents=True)
    (tmp_path / "a.txt").touch()
    assert examine(tmp_path) == Report()
