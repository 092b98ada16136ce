from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from labseq.files import Holder, Lock, knows_no_locks

HOLD = """
import sys
from pathlib import Path
from labseq.files import Lock
lock = Lock(Path(sys.argv[1]), "the run µ")
assert lock.take() is None
print("held", flush=True)
input()
"""


def test_a_lock_has_one_holder(tmp_path: Path) -> None:
    first, second = (
        Lock(tmp_path / "new" / "lab.lock", "labseq devices"),
        Lock(tmp_path / "new/lab.lock", "me"),
    )
    assert first.take() is None
    holder = second.take()
    assert holder is not None
    assert (holder.what, holder.pid) == ("labseq devices", os.getpid())
    first.tell("the run data/1")
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
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        holder = mine.take()
        assert holder is not None
        assert (holder.what, holder.pid) == ("the run µ", child.pid)
        child.kill()
        child.wait()
        assert mine.take() is None
    mine.release()


@pytest.mark.parametrize("content", [None, b"", b"[]", b'{"what": "x"}', b"\xff"])
def test_a_holder_that_cannot_be_read_is_still_one(tmp_path: Path, content: bytes | None) -> None:
    first, second = Lock(tmp_path / "a.lock", "x"), Lock(tmp_path / "a.lock", "y")
    first.take()
    about = tmp_path / "a.lock.holder"
    about.unlink() if content is None else about.write_bytes(content)
    assert second.take() == Holder("", 0, "", "")
    assert str(second.take()) == "a process that has not said what it does"
    first.release()


def test_an_odd_time_is_told_as_it_is() -> None:
    assert str(Holder("a run", 5, "pc", "yesterday")) == "a run (process 5 on pc, since yesterday)"


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_folder_without_locks_is_told_from_one_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    fcntl = pytest.importorskip("fcntl")
    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", refuse)
        with pytest.raises(OSError, match=r".") as caught:
            Lock(tmp_path / "a.lock", "x").take()
    assert knows_no_locks(caught.value)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r".") as caught:
        Lock(tmp_path / "file" / "a.lock", "x").take()
    assert not knows_no_locks(caught.value)


def test_an_older_package_says_it_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotImplementedError("FileSystem does not appear to support flock")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    with pytest.raises(OSError, match="support flock") as caught:
        Lock(tmp_path / "a.lock", "x").take()
    assert knows_no_locks(caught.value)
