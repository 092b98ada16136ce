"""A run in progress, followed by its files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from labseq.data.follower import Follower
from labseq.files import NewLines
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot


@pytest.fixture
def writer(tmp_path: Path) -> RunWriter:
    return RunWriter.create(tmp_path, make_run())


def test_every_attempt_comes_once(writer: RunWriter) -> None:
    follower = Follower(writer.run_dir)
    assert follower.shots() == []
    writer.write_shot(make_shot(shot_index=0))
    writer.write_shot(make_shot(shot_index=1, status="failed"))
    assert [(shot.index, shot.row.counts) for shot in follower.shots()] == [(0, True), (1, False)]
    writer.write_shot(make_shot(shot_index=1, attempt=1))
    writer.write_shot(make_shot(shot_index=2))
    (one, two) = follower.shots()
    assert (one.index, one.attempt, two.index) == (1, 1, 2)
    assert len(two.occupancies) == len(make_shot().images)
    assert follower.shots() == []


def test_half_a_line_is_not_looked_at_before_it_is_whole(writer: RunWriter) -> None:
    writer.write_shot(make_shot(shot_index=0))
    index = writer.run_dir / "index.jsonl"
    whole = index.read_bytes()
    follower = Follower(writer.run_dir)
    index.write_bytes(whole[:40])
    assert follower.shots() == []
    index.write_bytes(whole)
    assert [shot.index for shot in follower.shots()] == [0]


def test_times_of_events_are_those_of_the_run_in_all_its_parts(writer: RunWriter) -> None:
    """A resumed run begins at 0 again; lines that are damaged are left out."""
    lines: list[Any] = [
        {"t_s": 2.0, "event": "run_starting", "values": {}},
        {"t_s": 70.0, "event": "shot_finished", "values": []},
        {"t_s": "late", "event": "warning", "values": {"text": "hot"}},
        {"t_s": 5.0, "event": "run_starting", "values": {}, "t_utc": "2026-11-20T10:00:00+00:00"},
    ]
    log = writer.run_dir / "events.jsonl"
    log.write_text("x\n" + "".join(f"{json.dumps(line)}\n" for line in lines), "utf-8")
    follower = Follower(writer.run_dir)
    events = list(follower.log())
    assert [(event.name, event.t_s) for event in events] == [
        ("run_starting", 2.0),
        ("warning", 70.0),
        ("run_starting", 75.0),
    ]
    assert events[-1].t_utc.startswith("2026-11-20")
    assert list(follower.log()) == []


def test_only_whole_lines_are_read_and_each_once(tmp_path: Path) -> None:
    tail = NewLines(tmp_path / "log")
    assert tail.read() == []
    (tmp_path / "log").write_text('{"a": 1}\n{"a"')
    assert tail.read() == [{"a": 1}]
    with (tmp_path / "log").open("a") as file:
        file.write(": 2}\n[]\n")
    assert tail.read() == [{"a": 2}]
    assert tail.read() == []
