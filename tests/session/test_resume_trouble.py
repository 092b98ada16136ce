"""Disks that are full or read-only, clocks that go back, long and foreign names."""

from __future__ import annotations

import errno
import os
import re
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.analysis.timing import writing_s
from labseq.cli.live import Tally
from labseq.cli.summary import Summary
from labseq.data.follower import Follower
from labseq.errors import RecordingError
from labseq.model import RunRecord
from labseq.plain import to_plain
from labseq.session import provenance as recording_of
from labseq.testing.fakes import RecordingObserver

from .small_runs import (
    Interrupting,
    Wholes,
    interrupted,
    resumed,
    stopped,
    stopped_home,
    table,
    wholes,
    write,
)

__all__ = ["stopped", "stopped_home", "wholes"]


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


DAY_S, YEAR_S = 86400, 31536000


def recorded(run: labseq.Run) -> list[Any]:
    """All that the index and the files of shots hold, apart from time stamps and measured durations."""
    stamped = {"t_start_utc", "t_end_utc", "sha256", "bytes", "stage_s"}
    plain: list[dict[str, Any]] = [to_plain(shot.row) for shot in run.shots]
    rows = [{name: row[name] for name in row.keys() - stamped} for row in plain]
    return [*table(run), *rows]


@pytest.mark.parametrize(("during_s", "before_s"), [(-DAY_S, 0), (YEAR_S, -DAY_S)])
def test_a_clock_that_is_set_changes_nothing_but_time_stamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, during_s: int, before_s: int, undisturbed: labseq.Run
) -> None:
    """During a run, and before it is resumed."""
    wall_s, ahead_s = time.time, [0]
    monkeypatch.setattr(time, "time", lambda: wall_s() + ahead_s[0])

    class SettingClock(Interrupting):
        def event(self, name: str, values: Any) -> None:
            if (name, values.get("shot")) == ("shot_started", 1):
                ahead_s[0] = during_s
            super().event(name, values)

    run_dir = interrupted(write(tmp_path), "shot_started", 4, kind=SettingClock)
    ahead_s[0] = before_s
    run = resumed(run_dir)
    starts = [datetime.fromisoformat(shot.row.t_start_utc).timestamp() for shot in run.shots]
    assert [round((t_s - starts[0]) / DAY_S) for t_s in starts] == [
        round(s / DAY_S) for s in (0, 0, during_s, *[before_s] * 3)
    ]
    assert recorded(run) == recorded(undisturbed)
    assert max(writing_s(run)) < DAY_S / 2
    stamped = ("run ", "computer time ", "resumed ", "warning")
    shown, expected = (
        [line for line in Summary.of(each).as_text() if not line.startswith(stamped)]
        for each in (run, undisturbed)
    )
    assert shown == expected
    (wall_time,) = (line for line in Summary.of(run).as_text() if line.startswith("computer time "))
    assert re.fullmatch(r"computer time +[\d.]+ m?s", wall_time)
    watched = Follower(run.path)
    tally = Tally(watched.now)
    for event in watched.events():
        tally.add(event.name, event.values)
    assert (tally.n_before, tally.n_done) == (0, len(run.shots))
    assert 0 <= watched.now() < DAY_S / 2


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    return resumed(interrupted(write(tmp_path_factory.mktemp("run")), "shot_started", 4))


def test_a_run_on_an_earlier_day_than_others_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, sequence = RecordingObserver(), write(tmp_path)
    monkeypatch.setattr(time, "time", lambda: 1.7e9)
    for day, number in (("2099-01-01", 3), ("2099-01-02", 0)):
        (tmp_path / "data" / day / f"{number:04}_x").mkdir(parents=True)
    (tmp_path / "data" / "2099-01-03").mkdir()  # without runs
    options: Any = {"seed": 5, "shots": 1, "output": tmp_path / "data", "observer": seen}
    for _ in range(2):
        with labseq.Session.open(sequence, **options) as session:
            session.run()
    texts = [values["text"] for values in seen.of("warning")]
    assert len(texts) == 2
    assert all(str(tmp_path / "data") in text and "2099-01-02" in text for text in texts)
    assert [path.name[:4] for path in sorted((tmp_path / "data").glob("2023-11-1*/*"))] == ["0001", "0002"]


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
        code = recording_of.code_of(session.assembly, Path("/then"))
        record = recording_of.run_record(session.assembly, 1, {}, Path("/then"), code)
    assert isinstance(record, RunRecord)
    assert record.provenance["folder"] == str(Path("/then"))
    assert record.sequence_path == str(tmp_path / "no_scan.yaml")
