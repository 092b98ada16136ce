"""Processes and locks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from labseq.processes import Holder, Lock, Process
from tests.locking import held_elsewhere


def test_it_comes_back_from_plain_values() -> None:
    owner = Process.current()
    assert Process.from_plain(asdict(owner)) == owner
    assert Process.from_plain({}) is None
    assert Process.from_plain({"pid": "12"}) is None
    assert Process.from_plain({"pid": -1}) is None


def test_a_killed_process_that_nobody_has_waited_for_is_not_running() -> None:
    code = "print(flush=True); input()"
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child:
        assert child.stdout is not None
        child.stdout.readline()
        child.kill()
        child.stdout.read()  # ends when the child's descriptors are closed, which is when it dies
        owner = replace(Process.current(), pid=child.pid, started=0.0)
        for _ in range(100_000):  # its state changes a moment later
            if not owner.is_running:
                break
        assert not owner.is_running


def test_a_later_process_of_the_same_number_is_another_one() -> None:
    owner = replace(Process.current(), started=Process.current().started - 60)
    assert not owner.is_running


def test_a_lock_has_one_holder(tmp_path: Path) -> None:
    first, second = (
        Lock(tmp_path / "new" / "lab.lock", "labseq devices"),
        Lock(tmp_path / "new/lab.lock", "me"),
    )
    assert first.take() is None
    holder = second.take()
    assert holder is not None
    assert (holder.purpose, holder.process) == ("labseq devices", Process.current())
    first.describe("the run data/1")
    assert str(second.take()).startswith(f"the run data/1 (process {os.getpid()} on ")
    second.release()  # it holds nothing
    assert second.take() is not None
    first.release()
    first.release()
    assert second.take() is None
    second.release()
    assert not list(tmp_path.rglob("*.holder"))


def test_a_holder_that_is_killed_loses_its_lock(tmp_path: Path) -> None:
    path = tmp_path / "lab.lock"
    mine = Lock(path, "mine")
    with held_elsewhere(path, "the run µ") as child:
        holder = mine.take()
        assert holder is not None
        assert holder.process is not None
        assert (holder.purpose, holder.process.pid) == ("the run µ", child.pid)
        child.kill()
        child.wait()
        assert mine.take() is None
    mine.release()


@pytest.mark.parametrize("content", [None, b"[]", b'{"what": "x"}'])
def test_a_holder_that_cannot_be_read_is_still_one(tmp_path: Path, content: bytes | None) -> None:
    first, second = Lock(tmp_path / "a.lock", "x"), Lock(tmp_path / "a.lock", "y")
    first.take()
    about = tmp_path / "a.lock.holder"
    about.unlink() if content is None else about.write_bytes(content)
    assert second.take() == Holder()
    assert str(second.take()) == "an unknown process"
    first.release()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
def test_a_folder_without_locks_is_told_from_one_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    warnings: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr("fcntl.flock", refuse)
        with pytest.raises(OSError, match=os.strerror(number)):
            Lock(tmp_path / "a.lock", "x").take()
        assert Lock(tmp_path / "a.lock", "x").take(warnings.append) is None
    (warning,) = warnings
    assert warning.startswith(f"{tmp_path} does not support file locks")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"Not a directory|exists"):
        Lock(tmp_path / "file" / "a.lock", "x").take(warnings.append)
