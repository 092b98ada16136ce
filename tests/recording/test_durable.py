from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.errors import RecordingError
from labseq.recording.durable import LineLog, explained, read_lines, write_file


def test_a_written_file_replaces_the_older_one(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_file(path, b"one")
    write_file(path, memoryview(b"two"))
    assert path.read_bytes() == b"two"
    assert list(tmp_path.iterdir()) == [path]


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
        (errno.EACCES, "may not write there; choose another place with --output or LABSEQ_DATA"),
        (errno.EROFS, "read-only"),
        (errno.ENOTDIR, "a file is in the way"),
        (errno.EIO, "the disk reports a fault"),
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


def test_a_log_goes_on_after_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "log"
    LineLog(path).append({"a": 1}, sync=True)
    path.write_bytes(path.read_bytes() + b'{"a": 2, "torn')
    assert read_lines(path) == ([{"a": 1}], [])
    LineLog(path).append({"a": 3}, sync=False)
    assert read_lines(path) == ([{"a": 1}, {"a": 3}], [2])
    assert path.read_bytes() == b'{"a": 1}\n{"a": 2, "torn\n{"a": 3}\n'


@given(st.binary(max_size=60).filter(lambda torn: b"\n" not in torn))
def test_no_torn_line_of_a_process_that_is_gone_is_lost_or_glued(
    tmp_path_factory: pytest.TempPathFactory, torn: bytes
) -> None:
    path = tmp_path_factory.mktemp("log") / "log"
    path.write_bytes(b'{"a": 1}\n' + torn)
    for b in (2, 3):
        LineLog(path).append({"b": b}, sync=False)
    rest = torn + b"\n" if torn else b""
    assert path.read_bytes() == b'{"a": 1}\n' + rest + b'{"b": 2}\n{"b": 3}\n'


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


def test_damaged_lines_in_the_middle_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(b'{"a": 1}\n\x00\x00\n[1]\n{"a": 2}\n')
    assert read_lines(path) == ([{"a": 1}, {"a": 2}], [2, 3])


def test_a_log_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert read_lines(tmp_path / "log") == ([], [])


def test_a_log_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        read_lines(tmp_path)
