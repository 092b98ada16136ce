import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.console.output import discard_unwritten, say
from labseq.console.report import aligned
from labseq.errors import RecordingError

FULL = Path("/dev/full")
PLAN = "plan random:20x20@0.75 --target compact_225 --step"
COMMANDS = [("runs", False), (f"{PLAN} --json -", True)]
"""Each with whether Python buffers what it prints."""

CELLS = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=8)


@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1), st.sets(st.integers(0, 2)))
def test_columns_keep_every_cell_in_its_column(rows: list[tuple[str, ...]], right: set[int]) -> None:
    lines = aligned(rows, right=sorted(right))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row, line in zip(rows, lines, strict=True):
        start = 0
        for i, cell in enumerate(row):
            field = line[start : start + widths[i]]
            assert field.strip() == cell
            assert field.startswith(cell) or i in right
            start += widths[i] + 2


def test_a_table_that_is_too_wide_for_the_terminal_is_wrapped(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [("name", "n", "reason"), ("camera", "12", "raised OSError: no such port")]
    wide = aligned(rows, right=[1])
    monkeypatch.setenv("COLUMNS", "24")
    assert aligned(rows, right=[1]) == wide, "in a pipe every row stays one line"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    lines = aligned(rows, right=[1])
    assert lines[0] == wide[0]
    assert len(lines) > 2
    assert max(map(len, lines)) <= 24
    assert all(line.startswith((" " * 12, "name", "camera  12")) for line in lines)


def test_rows_that_several_columns_tell_apart_keep_them_in_a_second_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = [
        ("degree", "speed", "shots", "filling", "defects"),
        ("15", "130 um/ms", "5", "97.3 %", "6"),
        ("15", "355 um/ms", "5", "57.0 %", "97"),
    ]
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert aligned(rows, right=range(5), keys=2) == [
        "degree      speed  shots",
        "    15  130 um/ms      5",
        "    15  355 um/ms      5",
        "",
        "degree      speed  filling",
        "    15  130 um/ms   97.3 %",
        "    15  355 um/ms   57.0 %",
        "",
        "degree      speed  defects",
        "    15  130 um/ms        6",
        "    15  355 um/ms       97",
    ]


def test_say_prints_whole_lines() -> None:
    stream = io.StringIO()
    say("a", "b", stream=stream)
    say(stream=stream)
    assert stream.getvalue() == "a\nb\n"


def test_say_reports_when_nothing_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.touch()
    with path.open(encoding="utf-8") as stream, pytest.raises(RecordingError, match="out: cannot be written"):
        say("a", stream=stream)


def test_closed_streams_change_no_exit_code(tmp_path: Path) -> None:
    command = '"$1" -m labseq check gone.yaml --json <&- >&- 2>&-'
    shell = ["/bin/sh", "-c", command, "sh", sys.executable]
    done = subprocess.run(shell, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "internal error" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def perform(command: str, stdout: int, buffered: bool) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    arguments = [sys.executable, "-m", "labseq", *command.split()]
    return subprocess.run(
        arguments, stdout=stdout, stderr=subprocess.PIPE, env=environment, text=True, check=False
    )


@pytest.mark.parametrize(("command", "buffered"), COMMANDS)
def test_a_reader_that_went_away_is_no_error(command: str, buffered: bool) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = perform(command, writer, buffered)
    os.close(writer)
    assert done.returncode == 0
    assert "Error" not in done.stderr
    assert "error" not in done.stderr


@pytest.mark.skipif(not FULL.exists(), reason="no full device")
@pytest.mark.parametrize(("command", "buffered"), [("runs", False), ("--help", True)])
def test_a_full_disk_is_reported_in_a_line(command: str, buffered: bool) -> None:
    with FULL.open("w", encoding="utf-8") as full:
        done = perform(command, full.fileno(), buffered)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("cannot be written: No space left on device")
    assert "internal" not in done.stderr
    assert "Exception" not in done.stderr


def test_what_cannot_be_written_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        say("nobody reads this")
        say("nor this")
        stream.write("nor what a plugin left in the buffer")
        discard_unwritten()
