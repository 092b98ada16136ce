"""Writing a run's folder, also after an interruption."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import stat
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.files import explained
from labseq.model import RunRecord
from labseq.recording.results import ResultsLog
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot


class FullDisk:
    """From the n-th call of write, fsync or replace on, ``n_failures`` calls fail."""

    def __init__(self, n_good: int, n_failures: int) -> None:
        self.n_good = n_good
        self.n_failures = n_failures
        self.n_calls = 0

    def may_go_on(self) -> bool:
        self.n_calls += 1
        return not self.n_good < self.n_calls <= self.n_good + self.n_failures

    @contextmanager
    def inserted(self, monkeypatch: pytest.MonkeyPatch) -> Generator[None]:
        real = {name: getattr(os, name) for name in ("write", "fsync", "replace")}

        def guarded(name: str) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                if self.may_go_on():
                    return real[name](*args, **kwargs)
                if name == "write":  # some of it still fits
                    real[name](args[0], bytes(args[1])[: len(args[1]) // 2])
                raise OSError(errno.ENOSPC, "No space left on device")

            return call

        with monkeypatch.context() as patch:
            for name in real:
                patch.setattr(os, name, guarded(name))
            yield


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_run_folder_holds_everything_from_the_start(tmp_path: Path) -> None:
    record = make_run()
    writer = RunWriter.create(tmp_path / "new" / "data", record, {"git.diff": "+ µ\r\n", "env.bin": b"\xff"})
    run_dir = writer.run_dir
    day = datetime.fromisoformat(record.t_start_utc).astimezone().date().isoformat()
    assert run_dir == tmp_path / "new" / "data" / day / "0001_compact-225"
    own = {"STATE", "events.jsonl", "index.jsonl", "profile.yaml", "run.json", "sequence.yaml"}
    assert files(run_dir) == own | {"env.bin", "git.diff"}
    assert (run_dir / "sequence.yaml").read_bytes() == record.sequence_text.encode()
    assert (run_dir / "git.diff").read_bytes() == "+ µ\r\n".encode()
    assert (run_dir / "env.bin").read_bytes() == b"\xff"
    state = json.loads((run_dir / "STATE").read_text())
    assert (state["state"], state["pid"]) == ("running", os.getpid())
    run = json.loads((run_dir / "run.json").read_text("utf-8"))
    assert run["run_id"] == f"{day}/0001_compact-225"
    assert run["target"]["fill"] == ["00000", "01110", "01110", "00000"]
    assert run["target"]["clear"] == ["11111", "00000", "00000", "00000"]
    assert run["sequence_sha256"] == hashlib.sha256(record.sequence_text.encode()).hexdigest()
    assert run["devices"]["laser/780 nm"] == {"power_w": 0.1}
    assert {*RunRecord.__slots__} <= run.keys()


def test_the_index_tells_each_shot_in_a_line(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    path = writer.run_dir / writer.write_shot(make_shot()).file
    row = json.loads((writer.run_dir / "index.jsonl").read_text("utf-8"))
    assert row == {
        "shot": 0,
        "attempt": 0,
        "counts": True,
        "file": "shots/shot_000000.h5",
        "status": "complete",
        "error": "",
        "t_start_utc": "2026-11-20T10:00:00.000000+00:00",
        "t_end_utc": "2026-11-20T10:00:01.250000+00:00",
        "success": True,
        "filling_fraction": 0.875,
        "seen_defect_free_cycle": 1,
        "n_cycles": 3,
        "n_images": 3,
        "n_batches": 2,
        "n_atom_moves": 3,
        "n_missing_atoms": 3,
        "stage_s": {"load": 0.5, "plan": pytest.approx(0.004), "prüfen": 1e-9},
        "parameters": {"shot.2.rearrange.window": 0.06, "ümlaut": [1, None]},
        "readings": {"laser.power_w": 0.1, "laser.locked": True},
        "calibrations": {"sites": "f102b3cd999c", "overlay": "a18d1601661e"},
        "images": {
            "cycle": [-1, 0, 1],
            "t_start_s": [0.0, 0.1, 0.2],
            "exposure_s": [0.0451, 0.0451, 0.0451],
            "n_atoms": [8, 8, 6],
            "n_defects": [2, 3, 3],
            "n_surplus": [1, 2, 1],
        },
        "cycles": {"n_batches": [3, 0, 1], "n_batches_played": [2, 0, 0], "n_atom_moves": [3, 0, 0]},
        "simulation": {},
        "measured": {},
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "bytes": path.stat().st_size,
    }


def test_attempts_that_failed_stand_beside_the_shot(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    writer.write_shot(make_shot(3, status="failed", error="no frame", filling_fraction=float("nan")))
    writer.write_shot(make_shot(3, attempt=1))
    writer.write_shot(make_shot(4, status="interrupted"))
    assert writer.n_written == 1
    assert files(writer.run_dir / "shots") == {
        "shot_000003.attempt_0.h5", "shot_000003.h5", "shot_000004.attempt_0.h5"
    }  # fmt: skip
    run = open_run(writer.run_dir)
    assert [(shot.index, shot.attempt) for shot in run.shots] == [(3, 1)]
    assert [(shot.index, shot.status) for shot in run.attempts] == [(3, "failed"), (4, "interrupted")]
    assert run.attempts[0].row.error == "no frame"
    assert math.isnan(run.attempts[0].row.filling_fraction)


def test_events_come_from_any_thread(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    threads = [
        threading.Thread(target=lambda: [writer.event("tick", text="x" * 500) for _ in range(50)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(open_run(writer.run_dir).events) == 200


def test_a_full_disk_loses_events_and_counts_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    with FullDisk(0, 99).inserted(monkeypatch):
        writer.event("lost")
        writer.event("lost")
    writer.event("back")
    writer.event("again")
    events = open_run(writer.run_dir).events
    assert [(event["event"], event.get("n_lost_before")) for event in events] == [
        ("back", 2),
        ("again", None),
    ]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
@pytest.mark.parametrize("mode", [0o755, 0o2775])
def test_a_run_takes_the_groups_permission_to_write_from_its_data_folder(tmp_path: Path, mode: int) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data").chmod(mode)
    run_dir = RunWriter.create(tmp_path / "data", make_run()).run_dir
    ResultsLog(run_dir / "analysis" / "mine.jsonl", {})
    shared = ("..", ".", "shots", "analysis", "index.jsonl", "events.jsonl", "analysis/mine.jsonl")
    modes = [(run_dir / name).stat().st_mode for name in shared]
    assert [bool(of_file & stat.S_IWGRP) for of_file in modes] == [mode == 0o2775] * len(shared)


def test_a_place_that_another_user_owns_says_whose_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(RecordingError) as caught, explained(tmp_path / "run" / "index.jsonl"):
        raise PermissionError(errno.EACCES, "Permission denied")
    assert f"{tmp_path} belongs to {tmp_path.owner()}, who can let the group write" in str(caught.value)
    assert f"chmod -R g+w {tmp_path}" in str(caught.value)


def test_a_place_that_cannot_be_written_to_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="choose another place with --output or LABSEQ_DATA"):
        RunWriter.create(tmp_path / "file", make_run())


def n_disk_calls(action: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> int:
    disk = FullDisk(10**9, 0)
    with disk.inserted(monkeypatch):
        action()
    return disk.n_calls


def test_a_run_that_finds_no_room_at_its_start_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = make_run()
    n_calls = n_disk_calls(lambda: RunWriter.create(tmp_path / "good", record), monkeypatch)
    assert n_calls > 15
    for n_good in range(n_calls):
        root = tmp_path / f"full{n_good}"
        with FullDisk(n_good, 99).inserted(monkeypatch), pytest.raises(RecordingError, match="disk is full"):
            RunWriter.create(root, record)
        assert files(root) == set()


@pytest.mark.parametrize("n_failures", [1, 99])
def test_a_full_disk_at_any_moment_of_a_shot_leaves_the_others_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_failures: int
) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    n_calls = n_disk_calls(lambda: writer.write_shot(make_shot(0)), monkeypatch)
    assert n_calls == 6  # write, fsync, replace, fsync of the folder; write, fsync of the index
    for index in range(1, 1 + n_calls):
        shot = make_shot(index)
        with (
            FullDisk(index - 1, n_failures).inserted(monkeypatch),
            pytest.raises(RecordingError, match=f"(shot_{index:06d}.h5|index.jsonl).*disk is full; free"),
        ):
            writer.write_shot(shot)
        run = open_run(writer.run_dir)
        assert [found.index for found in run.shots] == list(range(index))
        for found in run.shots:
            found.verify()
        assert not list(writer.run_dir.rglob("*.part"))
        writer.write_shot(shot)  # there is room again
    assert writer.n_written == 1 + n_calls
    for found in open_run(writer.run_dir).shots:
        assert len(found.record().images) == 3


def test_shots_that_are_skipped_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    n_calls = n_disk_calls(lambda: writer.skip([0], "no light"), monkeypatch)
    assert n_calls == 3  # write, fsync; fsync of the folder, to which the file is new


def test_devices_are_added_once_they_are_open(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    writer.set_devices({"camera": {"model": "iXon", "serial_number": "X-1"}})
    writer.write_shot(make_shot())
    run = open_run(writer.run_dir)
    assert run.record["devices"]["camera"]["serial_number"] == "X-1"
    assert run.shots[0].devices["camera"] == {"model": "iXon", "serial_number": "X-1"}


ONCE = {"t_utc": "2026-11-21T08:00:00+00:00", "first_shot": 1, "changes": [], "provenance": {}}


@pytest.fixture
def stopped_dir(tmp_path: Path) -> Path:
    """A run of which shot 0 is done and shot 1 was interrupted."""
    writer = RunWriter.create(tmp_path, make_run())
    writer.set_devices({"camera": {"model": "first"}})
    writer.write_shot(make_shot(0))
    writer.write_shot(make_shot(1, status="interrupted"))
    writer.finish("stopped", "stopped by Ctrl-C")
    return writer.run_dir


def reopen(stopped_dir: Path, run: RunRecord, n_written: int = 1) -> RunWriter:
    return RunWriter.reopen(stopped_dir, replace(run, resumed=(ONCE,)), n_written=n_written)


def test_a_run_goes_on_in_its_folder(stopped_dir: Path) -> None:
    writer = reopen(stopped_dir, make_run())
    assert open_run(stopped_dir).status == "running"
    writer.write_shot(make_shot(1))
    assert writer.n_written == 2
    writer.finish("complete")
    run = open_run(stopped_dir)
    assert [shot.index for shot in run.shots] == [0, 1]
    assert [(shot.index, shot.status) for shot in run.attempts] == [(1, "interrupted")]
    assert run.status == "complete"
    assert [e["values"]["n_shots"] for e in run.events if e["event"] == "run_finished"] == [1, 2]


def test_run_json_keeps_what_it_said(stopped_dir: Path) -> None:
    file = stopped_dir / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text(encoding="utf-8")), "of_later": 5}))
    before = open_run(stopped_dir).record
    reopen(stopped_dir, make_run(seed=8, plugins=())).set_devices({"camera": {"model": "second"}})
    assert open_run(stopped_dir).record == {**before, "resumed": [ONCE]}


def test_devices_of_a_run_that_had_not_come_so_far_are_noted(tmp_path: Path) -> None:
    stopped_dir = RunWriter.create(tmp_path, make_run(devices={})).run_dir
    reopen(stopped_dir, make_run(), 0).set_devices({"camera": {"model": "second"}})
    assert open_run(stopped_dir).record["devices"] == {"camera": {"model": "second"}}


def test_no_file_is_overwritten(stopped_dir: Path) -> None:
    before = {path: path.read_bytes() for path in (stopped_dir / "shots").iterdir()}
    for _ in range(2):
        writer = reopen(stopped_dir, make_run())
        writer.write_shot(make_shot(1, status="failed"))
        writer.write_shot(make_shot(0))  # its line might have been lost
    names = sorted(path.name for path in (stopped_dir / "shots").iterdir())
    first, attempt = "shot_000000", "shot_000001.attempt_0"
    assert names == sorted(
        f"{stem}{take}.h5" for stem in (first, attempt) for take in ("", ".take_2", ".take_3")
    )
    assert before.items() <= {path: path.read_bytes() for path in (stopped_dir / "shots").iterdir()}.items()
    run = open_run(stopped_dir)
    assert [shot.file.name for shot in run.shots] == [f"{first}.take_3.h5"]
    assert len(run.attempts) == 3
    for shot in (*run.shots, *run.attempts):
        shot.verify()


def test_a_stop_that_was_asked_for_is_over(stopped_dir: Path) -> None:
    (stopped_dir / "STOP").touch()
    writer = reopen(stopped_dir, make_run())
    assert not (stopped_dir / "STOP").exists()
    (stopped_dir / "STOP").touch()
    writer.finish("stopped")
    assert not (stopped_dir / "STOP").exists()


def test_a_damaged_run_is_left_alone(stopped_dir: Path) -> None:
    (stopped_dir / "run.json").write_text("{")
    state = (stopped_dir / "STATE").read_bytes()
    with pytest.raises(RecordingError, match="is damaged"):
        reopen(stopped_dir, make_run())
    assert (stopped_dir / "STATE").read_bytes() == state
