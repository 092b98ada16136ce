import io
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.cli.output import columns, say
from labseq.errors import RecordingError

CELLS = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=8)


@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1), st.sets(st.integers(0, 2)))
def test_columns_keep_every_cell_in_its_column(rows: list[tuple[str, ...]], right: set[int]) -> None:
    lines = columns(rows, right=sorted(right))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row, line in zip(rows, lines, strict=True):
        start = 0
        for i, cell in enumerate(row):
            field = line[start : start + widths[i]]
            assert field.strip() == cell
            assert field.startswith(cell) or i in right
            start += widths[i] + 2


def test_say_prints_whole_lines() -> None:
    stream = io.StringIO()
    say("a", "b", stream=stream)
    say(stream=stream)
    assert stream.getvalue() == "a\nb\n"


def test_say_tells_when_nothing_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.touch()
    with path.open(encoding="utf-8") as stream, pytest.raises(RecordingError, match="out: cannot be written"):
        say("a", stream=stream)


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-", "--json >&-", "--json >&- 2>&-"])
def test_closed_streams_change_no_exit_code(tmp_path: Path, closed: str) -> None:
    command = f'"$1" -m labseq check gone.yaml {closed}'
    shell = ["/bin/sh", "-c", command, "sh", sys.executable]
    done = subprocess.run(shell, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "internal error" not in done.stderr
    assert list(tmp_path.iterdir()) == []
