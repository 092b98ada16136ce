from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from labseq.console.output import check_different, check_writable, json_writer
from labseq.errors import ConfigError


def test_json_for_a_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write = json_writer(str(path))
    assert not path.exists()
    write({"a": [1, 2]})
    assert path.read_text("utf-8").count("\n") == 1
    assert json.loads(path.read_text("utf-8")) == {"a": [1, 2]}


@pytest.mark.parametrize("name", ["gone/a.json", ".", "a" * 300])
def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="it cannot be written: "):
        json_writer(str(tmp_path / name))


def test_the_proof_leaves_an_older_file_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old", "utf-8")
    check_writable(path)
    assert path.read_text("utf-8") == "old"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes in folders")
def test_the_proof_does_not_wait_for_the_reader_of_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    check_writable(tmp_path / "pipe")


def test_a_file_that_is_named_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    check_different(None, "-", tmp_path / "a", str(tmp_path / "b"), "-", None)
    for other in (tmp_path / "a", tmp_path / "c" / ".." / "a", tmp_path / "link"):
        with pytest.raises(
            ConfigError, match="this file is given for two outputs, and one would replace the other"
        ):
            check_different(str(tmp_path / "a"), other)
