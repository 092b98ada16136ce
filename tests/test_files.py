from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from labseq.files import whole_file


def test_an_older_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old", "utf-8")
    with whole_file(path) as file:
        file.write(b"new")
        assert path.read_text("utf-8") == "old"
    assert path.read_text("utf-8") == "new"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_what_is_broken_off_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    def break_off() -> None:
        with whole_file(tmp_path / "a.txt") as file:
            file.write(b"half")
            raise error

    with pytest.raises(error):
        break_off()
    assert [*tmp_path.iterdir()] == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows wants a privilege for links")
def test_a_link_leads_to_the_file_that_is_written(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a.txt")
    with whole_file(tmp_path / "link") as file:
        file.write(b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a.txt").read_bytes() == b"new"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no /dev/fd")
def test_a_pipe_is_written_to_directly() -> None:
    read, write = os.pipe()
    try:
        with whole_file(Path(f"/dev/fd/{write}")) as file:
            file.write(b"through")
        assert os.read(read, 100) == b"through"
    finally:
        os.close(read)
        os.close(write)


def test_who_writes_alone_refuses_a_second_one(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with whole_file(path, alone=True) as file:
        with pytest.raises(FileExistsError, match=r"a\.txt\.part"), whole_file(path, alone=True):
            pass
        file.write(b"first")
    with whole_file(path, alone=True) as file:
        file.write(b"second")
    assert path.read_bytes() == b"second"
    assert [*tmp_path.iterdir()] == [path]
