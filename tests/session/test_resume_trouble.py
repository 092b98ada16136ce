"""Disks that are full or read-only, clocks that go back, long and foreign names."""

from __future__ import annotations

import errno
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import RecordingError
from labseq.model import RunRecord
from labseq.session import provenance as recording_of
from labseq.testing.fakes import RecordingObserver

from .small_runs import Wholes, interrupted, no_git, resumed, stopped, stopped_home, table, wholes, write

__all__ = ["no_git", "stopped", "stopped_home", "wholes"]


def fill_disk(patch: pytest.MonkeyPatch, n_good: int, number: int = errno.ENOSPC) -> None:
    """Let the disk of runs take so many more writes, and half of the next one."""
    write_some, left = os.write, [n_good]

    def limited(handle: int, data: bytes) -> int:
        left[0] -= 1
        if left[0] >= 0:
            return write_some(handle, data)
        if left[0] == -1:
            write_some(handle, bytes(data)[: len(data) // 2])
        raise OSError(number, os.strerror(number))

    patch.setattr(os, "write", limited)


@pytest.mark.parametrize("n_good", [13, 15])
def test_a_run_is_resumed_once_there_is_space(
    tmp_path: Path, wholes: Wholes, n_good: int, monkeypatch: Any
) -> None:
    sequence = write(tmp_path)
    seen = RecordingObserver()
    with monkeypatch.context() as patch:
        fill_disk(patch, n_good)
        with labseq.Session.open(sequence, seed=5, output=tmp_path, observer=seen) as session:
            with pytest.raises(RecordingError, match="the disk is full"):
                session.run()
            run_dir = session.run_dir
    assert run_dir is not None
    assert seen.of("safe_state")
    assert all(values["ok"] for values in seen.of("safe_state"))
    for shot in labseq.open_run(run_dir).shots:
        shot.verify()
    state = (run_dir / "STATE").read_text().replace('"state": "running"', '"state": "failed"')
    (run_dir / "STATE").write_text(state)  # where it did not fit: this process is not gone, as it would be
    run = resumed(run_dir)
    assert (run.status, len(run.shots)) == ("complete", 6)
    assert table(run) == wholes("no scan")


@pytest.mark.parametrize(
    ("number", "message"), [(errno.ENOSPC, "the disk is full"), (errno.EROFS, "the disk is read-only")]
)
def test_a_run_that_cannot_be_written_to_is_left_as_it_was(
    stopped: Path, number: int, message: str, monkeypatch: Any
) -> None:
    before = labseq.open_run(stopped)
    with monkeypatch.context() as patch, labseq.Session.resume(stopped) as session:
        fill_disk(patch, 0, number)
        with pytest.raises(RecordingError, match=message):
            session.run()
    after = labseq.open_run(stopped)
    assert (after.status, after.record, len(after.shots)) == (before.status, before.record, len(before.shots))
    assert resumed(stopped).status == "complete"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_that_forbids_writing_is_explained(stopped: Path) -> None:
    stopped.chmod(0o500)
    try:
        with pytest.raises(RecordingError, match="may not write there"):
            labseq.Session.resume(stopped)
    finally:
        stopped.chmod(0o700)


def test_a_clock_that_was_set_back_changes_nothing(
    stopped: Path, wholes: Wholes, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Yesterday(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return datetime.now(UTC) - timedelta(days=1)

    from labseq.recording import writer
    from labseq.sequencer import run as sequencing

    for module in (recording_of, writer, sequencing):
        monkeypatch.setattr(module, "datetime", Yesterday)
    run = resumed(stopped)
    monkeypatch.undo()
    assert [shot.index for shot in run.shots] == list(range(6))
    assert run.shots[3].row["t_start_utc"] < run.shots[2].row["t_start_utc"]
    assert run.record["resumed"][0]["t_utc"] < run.record["t_start_utc"]
    assert table(run) == wholes("no scan")


def test_long_and_foreign_names(tmp_path: Path) -> None:
    name = "原子の配列 größer " + "x" * 60
    folder = tmp_path / "меню 原子" / ("y" * 80)
    folder.mkdir(parents=True)
    sequence = write(folder)
    text = sequence.read_text(encoding="utf-8").replace("name: small µ", f"name: '{name}'")
    sequence.write_text(text, encoding="utf-8")
    run_dir = interrupted(sequence, "shot_started", 2)
    run = resumed(run_dir)
    assert (run.name, run.status, len(run.shots)) == (name, "complete", 6)


def test_a_record_of_a_run_needs_no_present_folder(tmp_path: Path) -> None:
    with labseq.Session.open(write(tmp_path)) as session:
        record = recording_of.run_record(session.assembly, 1, {}, {}, Path("/then"))
    assert isinstance(record, RunRecord)
    assert record.provenance["folder"] == str(Path("/then"))
    assert record.sequence_path == str(tmp_path / "no_scan.yaml")
