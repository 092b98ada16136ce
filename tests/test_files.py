"""Files that survive a crash, and places."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq import files
from labseq.errors import RecordingError
from labseq.files import (
    LineLog,
    cache_root,
    data_root,
    explained,
    packaged_profiles_dir,
    read_lines,
    state_root,
    whole_file,
    write_file,
)


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


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_write_that_fails_leaves_the_older_file(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    write_file(path, b"one")

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(RecordingError, match=r"file: cannot be written: No space.*; the disk is full; free"):
        write_file(path, b"two")
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.EDQUOT, "quota"),
        (
            errno.EACCES,
            "has no permission to write there; .*choose another place with --output or LABSEQ_DATA",
        ),
        (errno.ENOTDIR, "a file is where a folder is needed"),
        (errno.EMFILE, "check the disk"),
    ],
)
def test_the_error_says_what_to_do(number: int, advice: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=advice) as caught, explained(tmp_path):
        raise OSError(number, os.strerror(number))
    assert caught.value.path == str(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="Windows opens no folders")
def test_a_folder_that_cannot_be_flushed_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.fsync

    def network_folder(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        real(handle)

    monkeypatch.setattr(os, "fsync", network_folder)
    write_file(tmp_path / "file", b"one")
    assert (tmp_path / "file").read_bytes() == b"one"


@given(st.binary(max_size=60).filter(lambda torn: b"\n" not in torn))
def test_no_torn_line_confuses_reader_or_log(tmp_path_factory: pytest.TempPathFactory, torn: bytes) -> None:
    path = tmp_path_factory.mktemp("log") / "log"
    log = LineLog(path)
    log.append({"µ": 1}, sync=False)
    path.write_bytes(path.read_bytes() + torn)
    assert read_lines(path) == ([{"µ": 1}], [])
    log.append({"b": "\n"}, sync=False)
    assert read_lines(path) == ([{"µ": 1}, {"b": "\n"}], [])
    assert path.read_bytes().endswith(b"\n")


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_an_append_that_fails_leaves_no_trace(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LineLog(tmp_path / "log")
    log.append({"a": 1}, sync=True)
    before = log.path.read_bytes()
    write = os.write

    def full(handle: int, data: bytes = b"") -> None:
        if data:
            write(handle, data[:5])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        with pytest.raises(RecordingError, match="disk is full"):
            log.append({"a": 2}, sync=True)
    assert log.path.read_bytes() == before
    log.append({"a": 3}, sync=True)
    assert read_lines(log.path)[0] == [{"a": 1}, {"a": 3}]


def test_packaged_profiles_of_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "__file__", str(tmp_path / "labseq" / "places.py"))
    assert packaged_profiles_dir() == tmp_path.resolve() / "hardware_profiles"
    inside = tmp_path / "labseq" / "config" / "hardware_profiles"
    inside.mkdir(parents=True)
    assert packaged_profiles_dir() == inside.resolve()


def test_the_data_root_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LABSEQ_DATA", raising=False)
    assert data_root() == Path("data")
    monkeypatch.setenv("LABSEQ_DATA", "")
    assert data_root() == Path("data")
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path))
    assert data_root() == tmp_path


@pytest.mark.parametrize("folder", [state_root, cache_root])
def test_the_users_folders_can_be_chosen(
    folder: Callable[[], Path | None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    for kind in ("STATE", "CACHE"):
        monkeypatch.setenv(f"XDG_{kind}_HOME", str(tmp_path / "xdg"))
        monkeypatch.setenv(f"LABSEQ_{kind}", "")
    if sys.platform == "linux":
        assert folder() == tmp_path / "xdg" / "labseq"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    assert cache_root() == tmp_path / "numba" / "labseq"
    for kind in ("STATE", "CACHE"):
        monkeypatch.setenv(f"LABSEQ_{kind}", "~/own")
    assert folder() == Path.home() / "own"


@pytest.mark.skipif(sys.platform == "win32", reason="on Windows every user has a home")
def test_a_user_without_a_home_has_no_state(monkeypatch: pytest.MonkeyPatch) -> None:
    import pwd

    def no_such_user(_: int) -> None:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", no_such_user)
    for name in ("HOME", "LABSEQ_STATE", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert state_root() is None
