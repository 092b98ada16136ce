"""Damage is found, repaired without guessing, or moved aside; nothing is deleted."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labseq.data.reader import open_run
from labseq.recording import doctor, mark_active
from labseq.recording.doctor import examine
from labseq.recording.writer import RunWriter
from tests.locking import held_elsewhere

from .damages import (
    LOST,
    N_SHOTS,
    REPAIRABLE,
    contents,
    copied,
    damaged_line,
    damaged_state,
    dead_run,
    empty_file,
    flipped_bit,
    foreign_skip,
    line_of_no_shot,
    lines_of,
    lost_file,
    lost_line,
    part_left,
    reported,
    rewrite_state,
    shot_of_another_run,
    torn_events,
)
from .records import make_run, make_shot


@pytest.mark.parametrize("plant", [*REPAIRABLE, *LOST], ids=lambda plant: plant.__name__)
def test_a_damage_is_found_and_nothing_is_deleted(run_dir: Path, plant: Callable[[Path], None]) -> None:
    root = run_dir.parents[1]
    rows = open_run(run_dir).to_dataframe()
    plant(run_dir)
    before, lines = contents(root), lines_of(root)
    only_reported = examine(root, dry_run=True)
    assert only_reported.findings
    assert all(one.left for one in only_reported.findings)
    assert (contents(root), lines_of(root)) == (before, lines)
    assert not list(root.rglob("quarantine"))
    report = examine(root)
    assert reported(report) == reported(only_reported)
    assert not any(one.left for one in report.findings), report.findings
    assert {*before} <= {*contents(root)} | {b"", b"\0\0"}
    assert {*lines} <= {*lines_of(root)}
    assert examine(root).findings == []  # all is well now
    run = open_run(run_dir)
    whole = list(range(N_SHOTS)) if plant in REPAIRABLE else [0, 2, 3]
    assert [shot.index for shot in run.shots] == whole
    table = run.to_dataframe()
    assert table.equals(rows.loc[whole, [*table.columns]])
    assert [shot.index for shot in run.attempts] == [2]
    for shot in (*run.shots, *run.attempts):
        shot.verify()
    assert report.n_runs == 1
    assert report.n_shots == len(whole) + 1


@pytest.mark.parametrize(
    ("plant", "what", "where"),
    [
        (flipped_bit, "checksum", "shot_000001.h5"),
        (lost_file, "missing", "shot_000001.h5"),
        (damaged_line, "line 2 is damaged", "index.jsonl"),
        (line_of_no_shot, "describes no shot", "index.jsonl"),
        (damaged_state, "damaged", "STATE"),
        (shot_of_another_run, "2020-01-01/0001_other", "shot_000001.h5"),
        (foreign_skip, "torn last line", "skipped.jsonl"),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_a_damage_is_named(run_dir: Path, plant: Callable[[Path], None], what: str, where: str) -> None:
    plant(run_dir)
    found = reported(examine(run_dir, dry_run=True))
    assert [text for text, name in found if what in text and name == where], found


@pytest.mark.parametrize("has_line", [True, False])
def test_a_file_of_absurd_size_is_reported_without_reading_it(run_dir: Path, has_line: bool) -> None:
    with (run_dir / "shots" / "shot_000001.h5").open("ab") as file:
        file.truncate(1 << 40)  # its checksum would take hours
    index = run_dir / "index.jsonl"
    if not has_line:
        lines = index.read_text("utf-8").splitlines(keepends=True)
        index.write_text("".join(line for line in lines if "shot_000001.h5" not in line), "utf-8")
    found = reported(examine(run_dir, dry_run=True))
    what = "checksum" if has_line else "1099511627776 bytes"
    assert [text for text, name in found if what in text and name == "shot_000001.h5"], found


def test_a_whole_run_is_left_as_it_is(run_dir: Path) -> None:
    (run_dir / "notes.txt").write_text("my own")
    (run_dir / "shots" / "my notes.h5").write_bytes(b"\0")
    before = {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")}
    report = examine(run_dir.parents[1])
    assert (report.findings, report.n_runs, report.n_shots) == ([], 1, N_SHOTS + 1)
    assert {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")} == before


@pytest.mark.parametrize("mode", ["r+", "a"])
def test_what_a_viewer_has_open_for_writing_stays(run_dir: Path, mode: Literal["r+", "a"]) -> None:
    files = sorted((run_dir / "shots").glob("*.h5"))
    before, index = [file.read_bytes() for file in files], (run_dir / "index.jsonl").read_bytes()
    with ExitStack() as stack:
        viewed = [stack.enter_context(h5py.File(file, mode)) for file in files]
        report = examine(run_dir)
        assert (report.findings, report.n_in_use) == ([], len(files))
        for shot in open_run(run_dir).shots:
            shot.verify()
        viewed[0]["entry"].attrs["comment"] = "seen"
        viewed[0].flush()
        (changed,) = examine(run_dir).findings
        assert (changed.where, changed.left) == (files[0], True)
        assert "close it" in changed.done
    assert (run_dir / "index.jsonl").read_bytes() == index
    assert [file.read_bytes() for file in files[1:]] == before[1:]
    (quarantined,) = examine(run_dir).findings  # what was changed and is closed
    assert quarantined.where == files[0]


def test_a_file_that_is_put_back_counts_again(run_dir: Path) -> None:
    lost_file(run_dir)
    examine(run_dir)
    assert len(open_run(run_dir).shots) == N_SHOTS - 1
    (run_dir.parents[1] / "elsewhere.h5").rename(run_dir / "shots" / "shot_000001.h5")
    examine(run_dir)
    assert len(open_run(run_dir).shots) == N_SHOTS


def test_what_is_quarantined_says_where_it_came_from(run_dir: Path) -> None:
    flipped_bit(run_dir)
    examine(run_dir)
    place = run_dir / "quarantine"
    assert sorted(path.name for path in place.iterdir()) == ["doctor.jsonl", "index.jsonl", "shot_000001.h5"]
    first = json.loads((place / "doctor.jsonl").read_text("utf-8").splitlines()[0])
    assert first["from"] == str(run_dir / "shots" / "shot_000001.h5")
    assert first["what"].startswith("the checksum does not match")


def test_what_is_moved_to_quarantine_is_on_the_disk(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(doctor, "sync_folder", synced.append)
    (run_dir / "shots" / "half.part").write_bytes(b"")
    examine(run_dir)
    assert synced == [run_dir / "shots", run_dir / "quarantine"]


def test_two_files_of_a_name_are_both_kept(run_dir: Path) -> None:
    for content in (b"first", b"second"):
        (run_dir / "shots" / "shot_000009.h5.part").write_bytes(content)
        examine(run_dir)
    kept = [(run_dir / "quarantine" / f"shot_000009.h5.part{end}").read_bytes() for end in ("", ".2")]
    assert kept == [b"first", b"second"]


def test_an_earlier_take_of_a_shot_does_not_replace_the_later(run_dir: Path) -> None:
    lost_line(run_dir)
    writer = RunWriter.reopen(run_dir, make_run(n_shots=N_SHOTS), n_written=3)
    later = run_dir / writer.write_shot(make_shot(1, success=False)).file
    writer.finish("complete")
    assert later.name == "shot_000001.take_2.h5"
    with h5py.File(later, "r+") as file:
        run_id = json.loads((run_dir / "run.json").read_text("utf-8"))["run_id"]
        file["entry/run"].attrs["run_id"] = np.bytes_(run_id.encode())
    rows = [json.loads(line) for line in (run_dir / "index.jsonl").read_bytes().splitlines()]
    rows[-1]["sha256"] = hashlib.sha256(later.read_bytes()).hexdigest()
    (run_dir / "index.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows), "utf-8")
    ((what, name),) = reported(examine(run_dir))
    assert (name, "shot_000001.take_2.h5" in what) == ("shot_000001.h5", True)
    assert not open_run(run_dir).shots[1].success
    shots = [json.loads(line)["shot"] for line in (run_dir / "index.jsonl").read_bytes().splitlines()]
    assert shots.count(1) == 1
    (run_dir / "quarantine" / "shot_000001.h5").rename(run_dir / "shots" / "shot_000001.h5")
    (run_dir / "index.jsonl").write_bytes(b"")
    examine(run_dir)
    assert not open_run(run_dir).shots[1].success, "of two takes without a line the later counts"


damages = st.lists(st.sampled_from([*REPAIRABLE, *LOST]), max_size=4, unique=True)
cuts = st.tuples(
    st.sampled_from(["index.jsonl", "events.jsonl", "STATE", "shots/shot_000003.h5"]), st.floats(0, 1)
)


@settings(max_examples=8, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(damages, st.lists(cuts, max_size=2))
def test_any_damages_together_are_repaired_in_one_round(
    template: Path, tmp_path_factory: pytest.TempPathFactory, plants: list[Any], cut: list[tuple[str, float]]
) -> None:
    run_dir = copied(template, tmp_path_factory.mktemp("data"))
    for plant in plants:
        try:
            plant(run_dir)
        except (OSError, KeyError, IndexError, ValueError):  # an earlier damage is in its way
            continue
    for name, part in cut:
        if (path := run_dir / name).exists():
            path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    report = examine(run_dir.parents[1])
    assert not any(one.left for one in report.findings), report.findings
    assert examine(run_dir.parents[1]).findings == []
    run = open_run(run_dir)
    assert run.n_damaged_lines == 0
    for shot in (*run.shots, *run.attempts):
        shot.verify()
        assert shot.record().shot_index == shot.index
    assert {0, 2} <= {shot.index for shot in run.shots}
    shutil.rmtree(run_dir.parents[1])


LONG_AGO = 1e9


def test_a_run_without_shots_or_run_file_goes_to_the_quarantine_of_its_day(run_dir: Path) -> None:
    dead = run_dir.parent / "0002_dead"
    (dead / "shots").mkdir(parents=True)
    shutil.copy(run_dir / "STATE", dead)
    rewrite_state(dead, state="running", pid=2**22 + 1, started=0.0)
    root = run_dir.parents[1]
    report = examine(root)
    assert report.in_progress == [dead]  # it may just be being made
    os.utime(dead, (LONG_AGO, LONG_AGO))
    assert [name for _, name in reported(examine(root))] == ["0002_dead"]
    assert (run_dir.parent / "quarantine" / "0002_dead" / "STATE").exists()
    assert examine(root).findings == []


def test_shots_without_a_run_file_are_left(run_dir: Path) -> None:
    (run_dir / "run.json").unlink()
    os.utime(run_dir, (LONG_AGO, LONG_AGO))
    (found,) = examine(run_dir).findings
    assert (found.what, found.left) == ("run.json is missing", True)
    assert "restore it from a backup" in found.done
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
        file.attrs["format_version"] = np.bytes_(b"5.0")
    (found,) = examine(run_dir).findings
    assert found.left
    assert "update labseq" in found.done


def other_grid(file: Any) -> None:
    del file["entry/detection/occupancy"]
    file["entry/detection/occupancy"] = np.ones((3, 9, 9), np.uint8)


def list_of_readings(file: Any) -> None:
    del file["entry/readings"]
    file["entry/readings"] = np.bytes_(b"[1]")


@pytest.mark.parametrize("plant", [other_grid, list_of_readings])
def test_a_file_that_gives_no_line_goes_to_quarantine(run_dir: Path, plant: Callable[[Any], None]) -> None:
    lost_line(run_dir)
    path = run_dir / "shots" / "shot_000001.h5"
    with h5py.File(path, "r+") as file:
        plant(file)
    (found,) = examine(run_dir).findings
    assert found.what.startswith("no line in the index, and is damaged: ")
    assert (run_dir / "quarantine" / path.name).exists()


def test_a_run_in_progress_is_not_touched(run_dir: Path) -> None:
    root = run_dir.parents[1]
    for plant in (lost_line, part_left, torn_events, empty_file):
        plant(run_dir)
    rewrite_state(run_dir, state="running", pid=os.getpid(), started=0.0)
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    report = examine(root)
    assert (report.findings, report.in_progress) == ([], [run_dir])
    rewrite_state(run_dir, state="running", pid=2**22 + 1, host="another")  # it cannot be known here
    assert examine(run_dir).in_progress == [run_dir]
    rewrite_state(run_dir, state="complete")
    before[run_dir / "STATE"] = (run_dir / "STATE").read_bytes()
    mark_active("lab", [], run_dir)  # its devices are not safe yet
    assert examine(root).in_progress == [run_dir]
    assert examine(run_dir).in_progress == [run_dir]
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


def test_a_run_that_somebody_goes_on_with_is_not_touched(run_dir: Path) -> None:
    lost_line(run_dir)
    with held_elsewhere(run_dir / ".lock", "labseq resume"):
        assert examine(run_dir).in_progress == [run_dir]
    found = reported(examine(run_dir))  # it was killed, or so its note says
    assert found[-1] == ("no line in the index", "shot_000001.h5")


def test_marks_of_runs_that_left_hardware_unsafe_stay(run_dir: Path) -> None:
    root = run_dir.parents[1]
    code = "import sys; from pathlib import Path; from labseq.recording import mark_active as m; "
    code += "m('lab', [], Path(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, run_dir], check=True)
    (found,) = examine(root).findings
    assert found.left
    assert "'labseq safe lab'" in found.done
    assert found.where.exists()
    (root / "elsewhere").mkdir()
    assert examine(root / "elsewhere").findings == []  # a folder of another user is not to blame


def test_claims_are_moved_away(run_dir: Path) -> None:
    root = run_dir.parents[1]
    claim = run_dir.parent / ".0007.claim"
    claim.mkdir()
    assert examine(root).findings == []  # somebody may be at it
    os.utime(claim, (LONG_AGO, LONG_AGO))
    assert [name for _, name in reported(examine(root))] == [".0007.claim"]
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
