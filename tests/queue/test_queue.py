"""What is queued is kept."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labseq.assembly.options import Options
from labseq.errors import ConfigError, RecordingError
from labseq.processes import Process
from labseq.queue.queue import Entry, Queue

from .queued import SEQUENCE, add, queue

__all__ = ["queue"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [(("shots: 3", "shots: many"), r"s\.yaml:5:8: shots is 'many'"), (("rows: 2", "rows: 20"), "20")],
)
def test_what_is_wrong_is_reported_at_once(queue: Queue, spoil: tuple[str, str], message: str) -> None:
    Path("s.yaml").write_text(SEQUENCE.replace(*spoil), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        add(queue)
    assert queue.entries() == []


def test_entries_are_removed_all_or_none(queue: Queue) -> None:
    for _ in range(3):
        add(queue)
    with pytest.raises(ConfigError, match="the queue has no entry 7; expected 1, 2, 3"):
        queue.remove([1, 7])
    assert len(queue.entries()) == 3
    queue.remove([1, 3])
    assert [entry.id for entry in queue.entries()] == [2]
    queue.remove([2])
    with pytest.raises(ConfigError, match="none: the queue is empty"):
        queue.remove([2])


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(moves=st.lists(st.tuples(st.integers(1, 4), st.integers(1, 4)), max_size=20))
def test_entries_move_as_in_a_list(
    tmp_path_factory: pytest.TempPathFactory, moves: list[tuple[int, int]]
) -> None:
    queue = Queue(tmp_path_factory.mktemp("data"))
    expected = [1, 2, 3, 4]
    queue.folder.mkdir()
    for number in expected:
        queue.write(Entry(number, Fraction(number), "2026-01-02T03:04:05+00:00", Path("s"), "", Options()))
    for number, before in moves:
        queue.move(number, before)
        if number != before:
            expected.remove(number)
            expected.insert(expected.index(before), number)
        assert [entry.id for entry in queue.entries()] == expected


def test_an_entry_reads_back(queue: Queue) -> None:
    entry = add(queue, shots=2, overrides=("attempts=5",), dry_run="fast", realtime=True)
    full = replace(entry, run_dir=Path("data/µ"), error="nein", status="failed", owner=Process.current())
    queue.write(full)
    (read,) = queue.entries()
    assert asdict(read) == asdict(full)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((text, "is not a queue entry of format 1") for text in ("", '{"format": 9}')),
        ('{"format": 1, "id": 1}', "is a damaged queue entry: position: "),
    ],
)
def test_a_damaged_entry_is_named(queue: Queue, content: str, message: str) -> None:
    add(queue)
    (queue.folder / "0001.json").write_text(content)
    with pytest.raises(RecordingError, match=rf"0001\.json: {message}"):
        queue.entries()


def test_a_new_field_of_a_later_labseq_is_no_damage(queue: Queue) -> None:
    add(queue)
    file = queue.folder / "0001.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "colour": "red"}))
    assert len(queue.entries()) == 1


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"position": "1e30000000"}, "position: "),
        ({"position": "1/0"}, "position: "),
        ({"id": 7}, "id: "),
        ({"options": {"output": "../../.."}}, "output: "),
        ({"run_dir": "../x"}, "run_dir: "),
        ({"added_utc": "yesterday"}, "Invalid isoformat string: 'yesterday'"),
        ({"begun_utc": "9999-12-31T23:59:59+00:00"}, "9999-12-31T23:59:59+00:00: expected a time of"),
        ({"expected_s": math.inf}, "expected_s: "),
        ({"text": "x" * (1 << 19)}, "text: it is longer than 256 KiB"),
    ],
    ids=str,
)
def test_an_entry_that_labseq_did_not_write_is_refused(
    queue: Queue, changes: dict[str, Any], what: str
) -> None:
    file = queue.folder / f"{add(queue).id:04d}.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    with pytest.raises(RecordingError) as caught:
        queue.entries()
    assert str(caught.value).startswith(f"{file}: is a damaged queue entry: {what}")
